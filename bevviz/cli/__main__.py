"""Entry point of ``python -m bevviz.cli``."""

import sys

from bevviz.cli import main

sys.exit(main())
