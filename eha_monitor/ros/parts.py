"""Joints that come in messages of their own on one topic.

All arrays of a JointState have the same length or none, so joints of which different quantities
are measured, or which different drivers publish, come in messages of their own.  A message then
lacks an entry because another message brings it, which is no fault of the data.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from rclpy.serialization import deserialize_message

from eha_monitor.ros.inputs import Entry, Topic
from eha_monitor.ros.raw import RawReader

LAYOUTS = 8  # of messages on one topic; more are those of a publisher that changes them


@dataclass(frozen=True)
class Part:
    """What some messages brought of one entry.

    Attributes
    ----------
    places : (n,) which messages had it.
    stamps, values : (n,) ns, (n, k).
    others : names in the messages after the last that had it.
    """

    places: np.ndarray
    stamps: np.ndarray
    values: np.ndarray
    others: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Layout:
    """Messages with one list of names: the entries in them, and how they are read."""

    names: frozenset[str]
    entries: tuple[Entry, ...]
    reader: RawReader


class Parts:
    """Reads messages of a topic that do not all have the same joints.

    Parameters
    ----------
    topic : topic and its streams.
    type_name, kind : type of its messages, and their class.
    """

    def __init__(self, topic: Topic, type_name: str, kind: type):
        self._topic, self._type, self._kind = topic, type_name, kind
        self._named = "name" in kind.get_fields_and_field_types()
        self._layouts: list[_Layout] = []

    @property
    def several(self) -> bool:
        """Whether the joints have come in messages of their own."""
        return len(self._layouts) > 1

    def read_all(self, messages: Sequence[bytes]) -> list[Part] | None:
        """Return what came of each entry of the topic.

        None unless each message has a stamp, and a number of each entry that it or another
        message with one of its joints has had.
        """
        places: dict[int, list[int]] = {}
        for k, data in enumerate(messages):
            layout = self._layout_of(data) if self._named else None
            if layout is None:
                self._layouts = []
                return None
            places.setdefault(layout, []).append(k)
        if not self._apart():
            self._layouts = []
            return None
        found = {}
        for number, chosen in places.items():
            layout = self._layouts[number]
            read = layout.reader.read_all([messages[k] for k in chosen]) if layout.entries else (
                np.ones(1), [])
            if read is None or not read[0].all():
                return None
            for entry, values in zip(layout.entries, read[1], strict=True):
                found.setdefault(entry.source.name, []).append((np.array(chosen), read[0], values))
        parts = []
        for entry in self._topic.entries:
            part = _part(found.get(entry.source.name, []), len(entry.channels))
            last = part.places[-1] if len(part.places) else -1
            parts.append(replace(part, others=tuple(sorted({
                name for number, chosen in places.items() if chosen[-1] > last
                for name in self._layouts[number].names}))))
        return parts

    def _layout_of(self, data: bytes) -> int | None:
        """Return the number of the layout of a message, None of one that cannot be told."""
        for number, layout in enumerate(self._layouts):
            if layout.reader.fits(data):
                return number
        if len(self._layouts) == LAYOUTS:
            return None
        try:
            names = frozenset(deserialize_message(data, self._kind).name)
        except Exception:  # noqa: BLE001  rclpy has no class for what is no message
            return None
        entries = tuple(entry for entry in self._topic.entries if entry.name in names)
        reader = RawReader(Topic(self._topic.name, entries, self._topic.full_name), self._type)
        reader(data)
        if not reader.fits(data):
            return None
        self._layouts.append(_Layout(names, entries, reader))
        return len(self._layouts) - 1

    def _apart(self) -> bool:
        """Tell whether every entry has come, and no message lacks one beside its own joints."""
        for entry in self._topic.entries:
            with_it = [layout.names for layout in self._layouts if entry.name in layout.names]
            without = [layout.names for layout in self._layouts if entry.name not in layout.names]
            if not with_it or any(one & other for one in with_it for other in without):
                return False
        return True


def _part(found: list[tuple], channels: int) -> Part:
    """Join what messages of several layouts brought of an entry, in the order of the messages."""
    if not found:
        return Part(np.empty(0, int), np.empty(0, np.int64), np.empty((0, channels)))
    places, stamps, values = (np.concatenate(column) for column in zip(*found, strict=True))
    order = np.argsort(places, kind="stable")
    return Part(places[order], stamps[order], values[order])
