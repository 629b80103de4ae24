"""A synthetic drive: a street, its traffic, a LiDAR and a camera by ray casting, seeded and reproducible."""

from bevviz.sources.synthetic.bag import BagWriter, write_bag
from bevviz.sources.synthetic.drive import Snapshot, SyntheticSource
from bevviz.sources.synthetic.faults import FAULTS, SENSOR_FAULTS

__all__ = ["FAULTS", "SENSOR_FAULTS", "BagWriter", "Snapshot", "SyntheticSource", "write_bag"]
