"""Files: which kind they are, the order of their names, writing one whole or not at all.

And what the source of the program is: an answer that another source gave may be another one.
"""

import hashlib
import json
import math
import os
import re
import stat
import tempfile
from collections.abc import Callable, Iterable
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

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


def write_text(path: str | Path, text: str) -> None:
    """Write ``text`` in UTF-8 as :func:`write_bytes` does."""
    # File names in the text may hold bytes that are no text; they must not cost the answer.
    _write(Path(path), text, "w", encoding="utf-8", errors="replace")


def write_json(path: str | Path, tree: dict) -> None:
    """Write an answer as JSON for programs and for people; NaN must be null in it already."""
    write_text(path, json.dumps(tree, indent=1, ensure_ascii=False, allow_nan=False) + "\n")


def finite(tree: Any) -> Any:
    """Return the tree in plain types, with null for every number that is not finite.

    A record becomes a mapping of its fields, an array lists.
    """
    if is_dataclass(tree):
        tree = {one.name: getattr(tree, one.name) for one in fields(tree)}
    if isinstance(tree, dict):
        return {str(key): finite(value) for key, value in tree.items()}
    if isinstance(tree, (list, tuple)):
        return [finite(value) for value in tree]
    if hasattr(tree, "tolist"):  # numpy's
        return finite(tree.tolist())
    if isinstance(tree, float) and not math.isfinite(tree):
        return None
    return tree


def write_bytes(path: str | Path, content: bytes) -> None:
    """Write ``content`` to a temporary name beside ``path``, then rename it.

    What is there and no regular file (a device, a pipe) is written into, never replaced.

    Raises
    ------
    InputError
        If the place cannot be written; an older file there is untouched.
    """
    _write(Path(path), content, "wb")


def _write(path: Path, content: str | bytes, mode: str, **how: str) -> None:
    name = None
    try:
        if path.exists() and not path.is_file():
            with path.open(mode, **how) as stream:
                stream.write(content)
            return
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".tmp", dir=path.parent)
        with os.fdopen(handle, mode, **how) as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        umask = os.umask(0)
        os.umask(umask)
        Path(name).chmod(0o666 & ~umask)  # mkstemp makes it private
        Path(name).replace(path)
    except OSError as problem:
        raise InputError(f"{path}: cannot write: {problem.strerror}") from problem
    finally:
        if name is not None:
            Path(name).unlink(missing_ok=True)  # gone already after the rename


PACKAGE = Path(__file__).parent


def environment() -> dict[str, str]:
    """Return the environment of a process that is to run this very source."""
    known = filter(None, [os.environ.get("PYTHONPATH")])
    return os.environ | {"PYTHONPATH": os.pathsep.join([str(PACKAGE.parent), *known])}


def source_digest(rooms: Iterable[str], counts: Callable[[Path], bool] = lambda path: True) -> str:
    """Return a digest of the source files of some rooms (folders, or single files) that count."""
    digest = hashlib.sha256()
    for room in rooms:
        place = PACKAGE / room
        for path in [place] if place.is_file() else sorted(place.rglob("*.py")):
            if counts(path):
                digest.update(str(path.relative_to(PACKAGE)).encode() + path.read_bytes())
    return digest.hexdigest()[:16]
