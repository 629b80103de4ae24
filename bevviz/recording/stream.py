"""Recording streams that threads may make and drop at the same time."""

from __future__ import annotations

import threading
from typing import Any

import rerun as rr

# The thread that drops a stream holds the lock of Rerun's list of streams, and needs Python's lock for the
# arrays that were logged. The thread that makes one holds Python's lock, and needs that of the list. So both
# wait for ever. Reentrant, as a garbage collection may drop a stream while another one is made.
_list_lock = threading.RLock()


class RecordingStream(rr.RecordingStream):
    """Recording stream of Rerun 0.41 that is never made while another thread drops one."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        with _list_lock:
            super().__init__(*args, **kwargs)

    def __del__(self) -> None:
        with _list_lock:
            super().__del__()
