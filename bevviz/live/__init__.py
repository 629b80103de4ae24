"""The live runtime: receiving, pipeline and logging decoupled, outputs that cannot stop each other."""

from bevviz.live.flight import FlightRecorder
from bevviz.live.notes import Notes
from bevviz.live.runtime import Live, Outputs, Status
from bevviz.live.settings import Settings

__all__ = ["FlightRecorder", "Live", "Notes", "Outputs", "Settings", "Status"]
