"""Synthetic drive: a street, its traffic, and sensors by ray casting. It imports `bags` and below."""

from bevviz.synthetic.bag import BagWriter, write_bag
from bevviz.synthetic.drive import Snapshot, SyntheticSource
from bevviz.synthetic.faults import FAULTS, SENSOR_FAULTS

__all__ = ["FAULTS", "SENSOR_FAULTS", "BagWriter", "Snapshot", "SyntheticSource", "write_bag"]
