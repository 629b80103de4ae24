"""Check of the sensors of a drive: frames are read and compared, and no stage runs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

from bevviz.anomalies.sensors import SensorWatch
from bevviz.bags.source import BagSource
from bevviz.config import Config
from bevviz.model.frame import Frame
from bevviz.model.results import FrameResult
from bevviz.support import progress
from bevviz.support.numba_kernel import thread_clock

FIRST_FRAMES = 100  # frames that are checked without an option
FIRST_SECONDS = 2.0  # seconds after which that check ends


class SensorCheck:
    """Collector of the faults of sensors in consecutive frames."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._watch = SensorWatch()
        self._first: dict[str, str] = {}  # subject -> sentence of the first fault
        self._onsets: set[tuple[str, int]] = set()

    def add(self, frame: Frame) -> None:
        """Check the next frame."""
        for fault in self._watch.update(FrameResult.unprocessed(frame, self._config)):
            self._first.setdefault(fault.subject, fault.text)
            self._onsets.add((fault.subject, fault.since))

    @property
    def warnings(self) -> list[str]:
        """One sentence for each kind of fault of each sensor, with the first time."""
        count = Counter(subject for subject, _ in self._onsets)
        return [
            f"{text}; {count[subject]} times in all" if count[subject] > 1 else text
            for subject, text in self._first.items()
        ]


def first_frames(source: BagSource, least: int, whole: bool) -> Iterator[Frame]:
    """Yield the frames that the sensors are checked on.

    Args:
        source: an open drive.
        least: frames that are yielded at any rate. Unrelated single frames are not compared, so no more come.
        whole: yield all frames.
    """
    if whole:
        yield from progress.bar(source, total=source.total, unit="scan", desc="check sensors")
        return
    start = thread_clock()
    for count, frame in enumerate(source, 1):
        yield frame
        if count >= least and (
            count >= FIRST_FRAMES or source.recording.single_frames or thread_clock() - start > FIRST_SECONDS
        ):
            return
