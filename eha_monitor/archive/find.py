"""Which bags lie below a folder, and whether one has changed since it was read."""

import hashlib
import json
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from eha_monitor.output import natural

ENDINGS = (".mcap", ".mcap.zstd", ".db3")  # a .db3 is no bag for us, and a row says so
METADATA = "metadata.yaml"
# The parts of one bag as rosbag2 names them: night_0.mcap, night_1.mcap.
_PART = re.compile(r"(.+)_(\d+)\.(?:mcap|mcap\.zstd|db3)$")


@dataclass(frozen=True)
class Place:
    """A bag below a folder: its name there, with ``/``, and its path.

    ``problem`` says why nothing can be read there; ``path`` is then a folder without bags.
    """

    name: str
    path: Path
    problem: str = ""


def is_archive(path: Path, wanted: bool = False) -> bool:
    """Tell whether a path is no bag itself but a folder that holds bags.

    ``wanted`` : the command line asks for a table.  A folder with one .mcap file in it and no
    metadata.yaml, which else is read as a bag, is then an archive that has just begun.
    """
    if not path.is_dir() or (path / METADATA).exists():
        return False
    try:
        files = sorted(entry.name for entry in path.iterdir()
                       if entry.name.endswith(ENDINGS) and not entry.name.startswith("."))
        folders = any(entry.is_dir() for entry in path.iterdir())
    except OSError:
        return False  # the reading of bags has words for that
    if files and not folders and not wanted and (len(files) == 1 or _parts_of_one(files)):
        return False
    return any(not place.problem for place in bags_below(path, top=True))


def find_bags(folder: Path) -> list[Place]:
    """Return the bags below a folder, by name; a folder that cannot be listed is one of them."""
    found = {place.name: place for place in bags_below(folder, top=True)}
    return [found[name] for name in sorted(found, key=natural)]


def bags_below(folder: Path, name: str = "", seen: set | None = None, top: bool = False
               ) -> Iterator[Place]:
    """Yield the bags of a folder and of its subfolders, each once, also behind links."""
    seen = set() if seen is None else seen
    try:
        about = folder.stat()
        if (about.st_dev, about.st_ino) in seen:
            return
        seen.add((about.st_dev, about.st_ino))
        entries = sorted(entry for entry in folder.iterdir() if not entry.name.startswith("."))
        files = [entry for entry in entries if entry.name.endswith(ENDINGS) and entry.is_file()]
        folders = [entry for entry in entries if entry.is_dir()]
    except OSError as problem:
        yield Place(name, folder, f"{folder}: cannot list the folder: {problem.strerror}")
        return
    if not top and ((folder / METADATA).exists()
                    or (not folders and _parts_of_one([file.name for file in files]))):
        yield Place(name, folder)
        return
    for file in files:
        yield Place(_below(name, file.name), file)
    for inner in folders:
        yield from bags_below(inner, _below(name, inner.name), seen)


def of_a_bag(entry: Path) -> bool:
    """Tell whether a file has the name of a bag, or of a part of one."""
    return entry.name == METADATA or entry.name.endswith(ENDINGS)


def stamp_of(bag: Path) -> str:
    """Return what changes when a bag changes: a digest of names, sizes and times of its files.

    The contents are not read: that takes as long as the answer.
    """
    files = [bag]
    if bag.is_dir():
        files = sorted(filter(of_a_bag, bag.iterdir()))
    facts = []
    for file in files:
        about = file.stat()
        facts.append([file.name, about.st_size, about.st_mtime_ns])
    return hashlib.sha256(json.dumps(facts).encode()).hexdigest()[:16]


def _parts_of_one(names: list[str]) -> bool:
    """Tell whether files are the parts of one bag: one stem, counted from 0 without a gap."""
    parts = [_PART.match(name) for name in names]
    if not parts or not all(parts) or len({part[1] for part in parts}) > 1:
        return False
    return sorted(int(part[2]) for part in parts) == list(range(len(parts)))


def _below(name: str, inner: str) -> str:
    # A name with bytes that are no text must not stop the table.
    inner = os.fsencode(inner).decode("utf-8", errors="replace")
    return f"{name}/{inner}" if name else inner
