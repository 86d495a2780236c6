"""``python -m eha_monitor <command>``, and ``eha-monitor <command>``."""

import sys


def main() -> int:
    """Import the command line and run it; Ctrl-C ends the import as quietly as a command."""
    try:
        from eha_monitor.cli import main as run
    except KeyboardInterrupt:
        return 130
    return run()


if __name__ == "__main__":
    sys.exit(main())
