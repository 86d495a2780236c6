"""Which files make a bag, and its messages as raw bytes."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from eha_monitor.errors import InputError
from eha_monitor.recordings.mcap_file import ZSTD_MAGIC, Block, McapFile
from eha_monitor.recordings.order import natural
from eha_monitor.regular import check_regular

LARGEST_METADATA = 2**24  # bytes


@dataclass(frozen=True)
class Topic:
    """A topic of a bag: message type, definition, messages found, QoS as YAML text."""

    name: str
    msgtype: str
    encoding: str
    definition: str
    count: int
    qos: str


class Bag:
    """A rosbag2 bag: a folder with metadata.yaml and .mcap files, or a single .mcap file."""

    def __init__(self, path: str | Path):
        self.path = Path(path)
        self.losses: list[str] = []
        paths, self.declared = _files_of(self.path, self.losses)
        self.files = []
        for part in paths:
            try:
                self.files.append(McapFile(part))
            except InputError as problem:
                if len(paths) == 1:
                    raise
                self.losses.append(f"left out: {problem}")
        if not self.files:
            raise InputError(f"{self.path}: {self.losses[-1]}")

    def blocks(self) -> Iterator[tuple[McapFile, Block]]:
        """Yield the messages of all files in order; channels are known when a block comes."""
        for file in self.files:
            for block in file.blocks():
                yield file, block

    def damage(self) -> list[str]:
        """Return what was lost, in sentences, once the blocks have been read."""
        sentences = list(self.losses)
        found = sum(file.found for file in self.files)
        for file in self.files:
            name = f"{file.path.name}: " if len(self.files) > 1 else ""
            if file.truncated_at is not None:
                sentences.append(f"{name}truncated at byte {file.truncated_at} of "
                                 f"{len(file.data)}")
            if file.damaged_chunks:
                reason = f" ({file.damage})" if file.damage else ""
                sentences.append(f"{name}{file.damaged_chunks} damaged chunk"
                                 f"{'s' * (file.damaged_chunks > 1)} left out{reason}")
            if file.declared is not None and file.declared != file.found:
                sentences.append(f"{name}the file declares {file.declared} messages, "
                                 f"{file.found} were found")
        if self.declared is not None and self.declared != found:
            sentences.append(f"metadata.yaml declares {self.declared} messages, "
                             f"{found} were found")
        return sentences


def _files_of(path: Path, losses: list[str]) -> tuple[list[Path], int | None]:
    """Return the files of a bag in order, and the message count that its metadata declares."""
    if not path.exists():
        raise InputError(f"{path}: no such bag")
    if not path.is_dir():
        return [path], None
    metadata = path / "metadata.yaml"
    inside = sorted((entry for entry in path.iterdir()
                     if entry.name.endswith((".mcap", ".mcap.zstd"))),
                    key=lambda entry: natural(entry.name))
    if not metadata.exists():
        if not inside:
            kind = "an sqlite3 bag, convert it with 'ros2 bag convert' or 'rosbags-convert'" if (
                any(path.glob("*.db3"))) else "neither metadata.yaml nor .mcap file"
            raise InputError(f"{path}: expected an mcap bag, found {kind}")
        return inside, None
    listed, count = _metadata(metadata, losses)
    if not inside and (any(path.glob("*.db3*")) or any(n.endswith(".db3") for n in listed)):
        raise InputError(f"{path}: expected an mcap bag, got sqlite3; convert it with "
                         "'ros2 bag convert' or 'rosbags-convert'")
    chosen = []
    for name in listed:
        for candidate in (path / name, path / f"{name}.zstd"):
            if candidate in inside:
                chosen.append(candidate)
                break
        else:
            losses.append(f"{name} is listed in metadata.yaml and is missing")
    if not chosen and not inside:
        raise InputError(f"{path}: expected the .mcap files that metadata.yaml lists, found none")
    return chosen or inside, count


def _metadata(path: Path, losses: list[str]) -> tuple[list[str], int | None]:
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    check_regular(path, "the metadata.yaml of a bag")
    try:
        if path.stat().st_size > LARGEST_METADATA:
            raise ValueError("not what a recorder writes")
        tree = YAML(typ="safe").load(path.read_text(encoding="utf-8"))
        information = tree["rosbag2_bagfile_information"]
        names = [Path(str(name)).name for name in information["relative_file_paths"]]
        count = information.get("message_count")
        return names, count if isinstance(count, int) else None
    except (OSError, YAMLError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        losses.append("metadata.yaml cannot be read, the .mcap files are taken as they are")
        return [], None


def topics(path: str | Path) -> dict[str, Topic]:
    """Return the topics of a bag that hold messages, by name.

    Raises
    ------
    InputError
        If there is no bag.
    """
    bag = Bag(path)
    counts: dict[tuple, int] = {}
    found: dict[str, Topic] = {}
    for file, block in bag.blocks():
        for channel_id, number in zip(*np.unique(block.ids, return_counts=True), strict=True):
            channel = file.channels.get(int(channel_id))
            schema = file.schemas.get(channel.schema_id) if channel else None
            if schema is None:
                continue
            counts[channel.topic] = counts.get(channel.topic, 0) + int(number)
            found[channel.topic] = Topic(
                channel.topic, schema.name, schema.encoding,
                schema.data.decode("utf-8", errors="replace"), counts[channel.topic],
                channel.metadata.get("offered_qos_profiles", ""))
    return found


def iter_raw(path: str | Path) -> Iterator[tuple[str, str, int, bytes]]:
    """Yield (topic, message type, log time in ns, serialised message) in order of time.

    The order holds within each chunk; chunks follow one another as they were written.  A
    truncated bag simply ends.

    Raises
    ------
    InputError
        If there is no bag.
    """
    import zstandard

    unpack = zstandard.ZstdDecompressor()
    for file, block in Bag(path).blocks():
        names = {}
        for channel_id in np.unique(block.ids).tolist():
            channel = file.channels.get(channel_id)
            schema = file.schemas.get(channel.schema_id) if channel else None
            if schema is not None:
                names[channel_id] = (channel.topic, schema.name)
        order = np.argsort(block.times, kind="stable")
        columns = (block.ids, block.times, block.begins, block.lengths)
        for channel_id, time, begin, length in zip(*(c[order].tolist() for c in columns),
                                                   strict=True):
            if channel_id not in names:
                continue
            raw = block.data[begin:begin + length].tobytes()
            if raw[:4] == ZSTD_MAGIC:
                try:
                    raw = unpack.decompress(raw, max_output_size=2**24)
                except (zstandard.ZstdError, MemoryError):
                    continue
            yield *names[channel_id], time, raw
