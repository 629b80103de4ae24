import sys

from bevviz.cli import main

sys.exit(main())
