"""A command within limits of processor time and memory, that ends with whoever started it.

    python -m eha_monitor.limited PARENT NICENESS SECONDS BYTES COMMAND [ARGUMENT ...]

The limits are set by the process on itself, before anything is loaded: between fork and exec in a
program with threads, no Python may run.
"""

import ctypes
import os
import resource
import signal
import sys

PARENT_DEATH = 1  # PR_SET_PDEATHSIG


def main() -> int:
    """Set the limits and run the command; returns its exit status."""
    parent, niceness, seconds, size = map(int, sys.argv[1:5])
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PARENT_DEATH, signal.SIGKILL)
    if os.getppid() != parent:
        return 1  # it has ended meanwhile
    os.setpriority(os.PRIO_PROCESS, 0, os.getpriority(os.PRIO_PROCESS, 0) + niceness)
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 1))
    resource.setrlimit(resource.RLIMIT_AS, (size, size))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    from eha_monitor.cli import main as command

    return command(sys.argv[5:])


if __name__ == "__main__":
    sys.exit(main())
