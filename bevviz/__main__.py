"""The command ``bevviz``, and ``python -m bevviz``."""

from __future__ import annotations

import signal
import sys

# Among the imports an interrupt just ends the process, as SIGTERM does; ``main`` has its own way then.
signal.signal(signal.SIGINT, signal.SIG_DFL)

from bevviz.cli import main  # noqa: E402

if __name__ == "__main__":
    sys.exit(main())
