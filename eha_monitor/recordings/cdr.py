"""Where a value stands in a serialised ROS 2 message.

rosbags' type definitions give the layout; one message is walked, and the byte offset found
holds for every message that has the same lengths and names at the same places.
"""

import re
import struct
from dataclasses import dataclass, field

import numpy as np
from rosbags.interfaces import Nodetype

LITTLE_ENDIAN = b"\x00\x01"
ENCAPSULATION = 4  # bytes before the payload
SIZES = {"bool": "u1", "byte": "u1", "char": "u1", "octet": "u1",
         "int8": "i1", "uint8": "u1", "int16": "<i2", "uint16": "<u2",
         "int32": "<i4", "uint32": "<u4", "int64": "<i8", "uint64": "<u8",
         "float32": "<f4", "float64": "<f8"}
STAMP = ("header.stamp.sec", "header.stamp.nanosec")
_STEP = re.compile(r"(\w+)(?:\[(\d+)\])?")


@dataclass(frozen=True)
class Want:
    """A number wanted from a message: a field path, and a joint name where it has names."""

    field: str
    name: str = ""


@dataclass
class Layout:
    """Places in one message.

    Attributes
    ----------
    places : want -> (byte offset from the encapsulation on, dtype); absent if not in there.
    positions : byte offsets of everything that fixes the layout.
    """

    places: dict[Want, tuple[int, np.dtype]] = field(default_factory=dict)
    positions: list[int] = field(default_factory=lambda: [0, 1])


def steps_of(path: str) -> list[tuple[str, int | None]]:
    """Split ``pose.covariance[3].x`` into (("pose", None), ("covariance", 3), ("x", None)).

    Raises
    ------
    ValueError
        If it is no field path.
    """
    steps = []
    for part in path.split("."):
        match = _STEP.fullmatch(part)
        if match is None:
            raise ValueError(f"{path!r} is no field path")
        steps.append((match[1], None if match[2] is None else int(match[2])))
    return steps


def has_names(types: dict, msgtype: str) -> bool:
    """Tell whether the message carries a list of names, as JointState does."""
    fields = dict(types[msgtype][1])
    kind = fields.get("name")
    return bool(kind and kind[0] == Nodetype.SEQUENCE and kind[1][0] == (Nodetype.BASE,
                                                                         ("string", 0)))


def has_stamp(types: dict, msgtype: str) -> bool:
    """Tell whether the message starts with a std_msgs/Header."""
    fields = types[msgtype][1]
    return bool(fields and fields[0] == ("header", (Nodetype.NAME, "std_msgs/msg/Header")))


def missing_field(types: dict, msgtype: str, want: Want) -> str | None:
    """Return what is wrong with a wanted field, in words, or None if the type has it."""
    try:
        steps = steps_of(want.field)
    except ValueError as problem:
        return str(problem)
    kind = (Nodetype.NAME, msgtype)
    for i, (name, index) in enumerate(steps):
        fields = dict(types.get(kind[1], ([], []))[1]) if kind[0] == Nodetype.NAME else {}
        if name not in fields:
            return f"expected field '{want.field}', the type has " + (
                ", ".join(fields) if fields else "no such field")
        kind = fields[name]
        listed = kind[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE)
        by_name = bool(want.name) and i == len(steps) - 1 and has_names(types, msgtype)
        if listed and index is None and not by_name:
            return f"field '{want.field}' is a list, expected an index such as '{name}[0]'"
        if index is not None and not listed:
            return f"field '{name}' is no list, expected no index"
        if listed:
            kind = kind[1][0]
    if kind[0] != Nodetype.BASE or kind[1][0] not in SIZES:
        return f"field '{want.field}' is no number"
    return None


def locate(raw: bytes, types: dict, msgtype: str, wants: tuple[Want, ...]) -> Layout:
    """Walk one serialised message and return where the wanted numbers stand.

    Raises
    ------
    ValueError, struct.error, KeyError, RecursionError
        If the bytes are no little-endian message of this type.
    """
    if raw[:2] != LITTLE_ENDIAN:
        raise ValueError("not little-endian CDR")
    walker = _Walker(raw, types)
    walker.message(msgtype, [(steps_of(want.field), want) for want in wants])
    if walker.at > len(raw):
        raise ValueError("message ends early")
    return walker.layout


class _Walker:
    """Reads a message front to back, noting lengths and wanted places."""

    def __init__(self, raw: bytes, types: dict):
        self.raw, self.types = raw, types
        self.at = ENCAPSULATION
        self.layout = Layout()
        self.names: list[str] = []

    def align(self, size: int) -> None:
        self.at += -(self.at - ENCAPSULATION) % size

    def structural(self, size: int) -> None:
        self.layout.positions.extend(range(self.at, self.at + size))

    def count(self) -> int:
        self.align(4)
        self.structural(4)
        (value,) = struct.unpack_from("<I", self.raw, self.at)
        self.at += 4
        if value > len(self.raw) - self.at:
            raise ValueError("list longer than the message")
        return value

    def text(self, kept: bool = False) -> str:
        length = self.count()
        content = self.raw[self.at:self.at + max(length - 1, 0)]
        if kept:
            self.structural(length)
        self.at += length
        return content.decode() if kept else ""

    def message(self, msgtype: str, wants: list, depth: int = 0) -> None:
        fields = self.types[msgtype][1]
        for name, kind in fields:
            inner = [(steps, want) for steps, want in wants if steps and steps[0][0] == name]
            if kind[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE):
                self.items(name, kind, inner, depth)
            else:
                self.value(kind, [(steps[1:], want) for steps, want in inner], depth)

    def items(self, name: str, kind, wants: list, depth: int) -> None:
        element, count = kind[1]
        if kind[0] == Nodetype.SEQUENCE:
            count = self.count()
        names = (name == "name" and depth == 0
                 and element[0] == Nodetype.BASE and element[1][0] == "string")
        if names:
            self.names = [self.text(kept=True) for _ in range(count)]
            return
        chosen: dict[int, list] = {}
        for steps, want in wants:
            index = steps[0][1]
            if index is None and want.name in self.names:
                index = self.names.index(want.name)
            if index is not None and index < count:
                chosen.setdefault(index, []).append((steps[1:], want))
        if element[0] == Nodetype.BASE and element[1][0] in SIZES:
            dtype = np.dtype(SIZES[element[1][0]])
            if count:
                self.align(dtype.itemsize)
            for index, found in chosen.items():
                for _, want in found:
                    self.layout.places[want] = (self.at + index * dtype.itemsize, dtype)
            self.at += count * dtype.itemsize
        else:
            for index in range(count):
                self.value(element, chosen.get(index, []), depth)

    def value(self, kind, wants: list, depth: int) -> None:
        if kind[0] == Nodetype.NAME:
            self.message(kind[1], wants, depth + 1)
        elif kind[1][0] == "string":
            self.text()
        else:
            dtype = np.dtype(SIZES[kind[1][0]])
            self.align(dtype.itemsize)
            for _, want in wants:
                self.layout.places[want] = (self.at, dtype)
            self.at += dtype.itemsize
