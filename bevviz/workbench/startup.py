"""Start-up of a workbench session, and its bag. The page is served meanwhile and loads its viewer."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from bevviz.bags.source import BagSource
from bevviz.model.frame import Frame, LabelledBoxes3D, Scene
from bevviz.support.contexts import Closable

if TYPE_CHECKING:
    from bevviz.evaluate.ground_truth import TruthLookup
    from bevviz.workbench.session import WorkbenchSession


class SessionStartup(Closable):
    """Start-up that makes the workbench session in a thread of its own.

    Args:
        make: makes the session.
        failed: called from that thread if ``make`` raises.
    """

    def __init__(self, make: Callable[[], WorkbenchSession], failed: Callable[[], None]) -> None:
        self._make, self._failed = make, failed
        self._workbench: WorkbenchSession | None = None
        self._over = threading.Event()
        self._closed = False
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._open, name="opening", daemon=True)
        self.error: BaseException | None = None

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def _open(self) -> None:
        try:
            workbench = self._make()
        except BaseException as error:
            self.error = error
            self._over.set()
            self._failed()
            return
        with self._lock:
            self._workbench = workbench
            if self._closed:
                workbench.close()
                return
            workbench.start()
        self._over.set()

    async def session(self) -> WorkbenchSession | None:
        """Wait until the session is made, and return it. None: it could not be made."""
        while not self._over.is_set():
            await asyncio.sleep(0.02)
        return self._workbench

    def close(self) -> None:
        """Close the session, now or as soon as it is made."""
        with self._lock:
            self._closed = True
            if self._workbench is not None:
                self._workbench.close()


class LabelledSource(BagSource):
    """Bag whose frames carry the ground truth of a topic or of label files.

    Attributes:
        truth_of: returns the ground truth of a frame. None: the frames stay as they are.
    """

    truth_of: TruthLookup | None = None

    @property
    def scene(self) -> Scene:
        """Names that entities and blueprints are made from."""
        return super().scene if self.truth_of is None else replace(super().scene, truth=True)

    def __iter__(self) -> Iterator[Frame]:
        return map(self._labelled, super().__iter__())

    def frame(self, number: int) -> Frame | None:
        """Return a frame with its ground truth."""
        frame = super().frame(number)
        return None if frame is None else self._labelled(frame)

    def _labelled(self, frame: Frame) -> Frame:
        truth = None if self.truth_of is None else self.truth_of(frame)
        if truth is None:
            return frame
        scores = np.ones(len(truth.labels), np.float32)
        boxes = LabelledBoxes3D(
            "",
            frame.stamp,
            frame.points_frame,
            truth.boxes,
            truth.labels,
            scores,
            frame.pose,
            ids=truth.ids,
            image=truth.image,
        )
        return replace(frame, truth=boxes)
