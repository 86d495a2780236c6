"""Files: which kind they are, and the order of their names."""

import os
import re
import stat
from pathlib import Path

from eha_monitor.errors import InputError

# A shell's <(command) and a redirected input: somebody is at the other end already.
_OPEN_ALREADY = ("/dev/fd/", "/proc/self/fd/", "/dev/stdin")
_KINDS = {stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket", stat.S_IFCHR: "a device",
          stat.S_IFBLK: "a device", stat.S_IFDIR: "a folder"}


def check_regular(path: str | Path, expected: str, streams: bool = False) -> None:
    """Refuse what is there and no regular file, before it is opened.

    A pipe, socket or device in its place would hold the program for ever.

    Parameters
    ----------
    expected : what it should be, e.g. ``a config``.
    streams : whether an input that this process was started with may be read as well.

    Raises
    ------
    InputError
        One line that names the path, what was found and what was expected.
    """
    if streams and os.fspath(path).startswith(_OPEN_ALREADY):
        return
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):  # whoever opens it says why it cannot be
        return
    if not stat.S_ISREG(mode):
        found = _KINDS.get(stat.S_IFMT(mode), "no file")
        raise InputError(f"{path}: expected {expected}, found {found}")


def natural(name: str) -> list[str | int]:
    """Sort key of file names by which part 10 comes after part 9."""
    return [int(part) if i % 2 else part for i, part in enumerate(re.split(r"(\d+)", name))]
