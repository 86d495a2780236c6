"""Numbers straight out of serialised messages, where their layout is the one met before.

Most messages of a topic differ in nothing but stamp and numbers.  Where those stand is found once
(:mod:`eha_monitor.recordings.cdr`); messages whose lengths and names are the same are then read
all at once.  Any other is left to the decoders of whole messages.
"""

import math
import struct

import numpy as np
from rosbags.typesys import Stores, get_typestore

from eha_monitor.recordings.cdr import LITTLE_ENDIAN, STAMP, Layout, Want, has_stamp, locate
from eha_monitor.ros.inputs import Topic

_CODES = {"f4": "f", "f8": "d", "i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I",
          "i8": "q", "u8": "Q"}


class RawReader:
    """Reads the streams of one topic out of the bytes of its messages.

    Parameters
    ----------
    topic : topic and its streams.
    type_name : type of its messages.
    """

    def __init__(self, topic: Topic, type_name: str):
        self._types = get_typestore(Stores.ROS2_JAZZY).fielddefs
        self._type = type_name
        self._stamped = type_name in self._types and has_stamp(self._types, type_name)
        self._wants = [[(Want(channel.field, entry.name), channel.gain, channel.zero)
                        for _, channel in entry.channels] for entry in topic.entries]
        self._length, self._complete = -1, False
        self._fixed: list[tuple[slice, bytes]] = []
        self._stamp: struct.Struct | None = None
        self._stamp_at = 0
        self._numbers: list[list[tuple]] = []
        self._wanted: list[tuple[slice, np.ndarray]] = []  # the same for many messages at once
        self._columns: list[list[tuple]] = []

    def __call__(self, data: bytes) -> tuple[int, list[tuple[float, ...]]] | None:
        """Return the stamp in ns (0 without one) and the values of each stream, SI.

        None stands for a message that is better decoded as a whole: another layout, a wanted
        entry missing, or a stream without a number.
        """
        if len(data) != self._length:
            self._learn(data)
        else:
            for place, content in self._fixed:
                if data[place] != content:
                    self._learn(data)
                    break
        if not self._complete:
            return None
        stamp_ns = 0
        if self._stamp is not None:
            seconds, rest = self._stamp.unpack_from(data, self._stamp_at)
            stamp_ns = seconds * 1_000_000_000 + rest
        streams = []
        for numbers in self._numbers:
            values = tuple([scale * unpack(data, at)[0] + offset
                            for unpack, at, scale, offset in numbers])
            for value in values:
                if value - value == 0.0:  # finite
                    break
            else:
                return None
            streams.append(values)
        return stamp_ns, streams

    def fits(self, data: bytes) -> bool:
        """Tell whether a message is of the layout that was read last."""
        return len(data) == self._length and all(
            data[place] == content for place, content in self._fixed)

    def read_all(self, messages: list[bytes]) -> tuple[np.ndarray, list[np.ndarray]] | None:
        """Return (n,) stamps in ns and the (n, k) values of each stream, as one by one.

        None unless all messages are of one layout and each stream has a number in each.
        """
        length = len(messages[0])
        if self(messages[0]) is None or set(map(len, messages)) != {length}:
            return None
        raw, n = b"".join(messages), len(messages)
        table = np.frombuffer(raw, dtype=np.uint8).reshape(n, length)
        if any((table[:, place] != content).any() for place, content in self._wanted):
            return None
        stamps = np.zeros(n, dtype=np.int64)
        if self._stamp is not None:
            for dtype, at, unit in (("<i4", 0, 1_000_000_000), ("<u4", 4, 1)):
                stamps += _column(raw, n, length, self._stamp_at + at, dtype) * np.int64(unit)
        streams = []
        for places in self._columns:
            values = np.full((n, len(places)), np.nan)
            for k, (at, dtype, scale, offset) in enumerate(places):
                if dtype is not None:
                    values[:, k] = scale * _column(raw, n, length, at, dtype) + offset
            if not np.isfinite(values).any(axis=1).all():
                return None
            streams.append(values)
        return stamps, streams

    def _learn(self, data: bytes) -> None:
        """Find where everything stands in messages like this one."""
        self._length, self._complete = -1, False
        if data[:2] != LITTLE_ENDIAN:
            return
        wants = tuple(want for stream in self._wants for want, _, _ in stream)
        stamp = STAMP if self._stamped else ()
        try:
            layout = locate(data, self._types, self._type, (*wants, *stamp))
        except (ValueError, struct.error, KeyError, RecursionError):
            return
        self._length = len(data)
        self._fixed = [(place, bytes(data[place])) for place in layout.fixed]
        # An entry that is there may lack a number, as a list may be empty: that is a NaN.
        self._complete = all(any(want in layout.places for want, _, _ in stream)
                             for stream in self._wants)
        self._numbers = [[(*self._unpacker(layout, want), scale, offset)
                          for want, scale, offset in stream] for stream in self._wants]
        self._wanted = [(place, np.frombuffer(content, dtype=np.uint8))
                        for place, content in self._fixed]
        self._columns = [[(*layout.places.get(want, (0, None)), scale, offset)
                          for want, scale, offset in stream] for stream in self._wants]
        self._stamp = struct.Struct("<iI") if stamp else None
        self._stamp_at = layout.places[stamp[0]][0] if stamp else 0

    @staticmethod
    def _unpacker(layout: Layout, want: Want) -> tuple:
        """Return a function (message, offset) -> (number,) and the offset."""
        if want not in layout.places:
            return _nothing, 0
        offset, dtype = layout.places[want]
        return struct.Struct(f"<{_CODES[dtype.str[1:]]}").unpack_from, offset


def _column(raw: bytes, n: int, length: int, at: int, dtype) -> np.ndarray:
    """Return the numbers that stand at ``at`` in each of ``n`` messages of one length."""
    return np.ndarray((n,), dtype, raw, at, (length,))


def _nothing(data: bytes, offset: int) -> tuple[float]:
    return (math.nan,)
