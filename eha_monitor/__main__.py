"""``python -m eha_monitor <command>``."""

import sys

from eha_monitor.cli import main

if __name__ == "__main__":
    sys.exit(main())
