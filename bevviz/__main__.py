"""The command ``bevviz``, and ``python -m bevviz``."""

import _signal  # type: ignore[import-not-found]
import sys

# Until ``main`` has its own way an interrupt just ends the process, as SIGTERM does, and does so before
# anything is imported that takes time, as ``signal`` itself: Python's own answer is a traceback.
if _signal.getsignal(_signal.SIGINT) != _signal.SIG_IGN:
    _signal.signal(_signal.SIGINT, _signal.SIG_DFL)
# SIGUSR1 asks a live run to save. One that comes before the run can answer must not end the process.
if hasattr(_signal, "SIGUSR1"):
    _signal.signal(_signal.SIGUSR1, lambda number, stack: None)

from bevviz.cli import main

if __name__ == "__main__":
    sys.exit(main())
