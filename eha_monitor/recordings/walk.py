"""The framing of mcap records, walked by a compiled loop.

The library's reader makes a Python object of each message (figures in docs/dependencies.md).
"""

from typing import NamedTuple

import numpy as np

from eha_monitor.compiled import njit

# Why a walk ended.
AT_END, FULL, CUT, DAMAGED, FOOTER = range(5)

MESSAGE_OPCODE = 0x05
FOOTER_OPCODE = 0x02
PREFIX = 9  # opcode and record length
MESSAGE_HEAD = 22  # channel id, sequence, log time, publish time


@njit
def _little(data, position, size):
    value = np.uint64(0)
    for i in range(size):
        value |= np.uint64(data[position + i]) << np.uint64(8 * i)
    return np.int64(value)


class Messages(NamedTuple):
    """Of messages, (m,) int64: channel id, log time in ns, position and length of the payload."""

    ids: np.ndarray
    times: np.ndarray
    begins: np.ndarray
    lengths: np.ndarray


class Others(NamedTuple):
    """Of every other record, (k,) int64: opcode, position and length of its content."""

    opcodes: np.ndarray
    begins: np.ndarray
    lengths: np.ndarray


@njit
def walk_records(data, start, found, others_found):
    """Walk mcap records from ``start`` on, until an output array is full or the data end.

    Parameters
    ----------
    data : (n,) uint8.
    start : position of an opcode.
    found, others_found : :class:`Messages` and :class:`Others`, written.

    Returns
    -------
    position, messages, others, ending : where the walk stopped, how many of each, and why.
    """
    ids, times, begins, lengths = found
    opcodes, other_begins, other_lengths = others_found
    position = start
    messages = 0
    others = 0
    size = len(data)
    while True:
        if messages == len(ids) or others == len(opcodes):
            return position, messages, others, FULL
        if position == size:
            return position, messages, others, AT_END
        if position + PREFIX > size:
            return position, messages, others, CUT
        opcode = data[position]
        length = _little(data, position + 1, 8)
        if opcode == 0 or length < 0 or (opcode == MESSAGE_OPCODE and length < MESSAGE_HEAD):
            return position, messages, others, DAMAGED
        begin = position + PREFIX
        if length > size - begin:
            return position, messages, others, CUT
        if opcode == MESSAGE_OPCODE:
            ids[messages] = _little(data, begin, 2)
            times[messages] = _little(data, begin + 6, 8)
            begins[messages] = begin + MESSAGE_HEAD
            lengths[messages] = length - MESSAGE_HEAD
            messages += 1
        else:
            opcodes[others] = opcode
            other_begins[others] = begin
            other_lengths[others] = length
            others += 1
        position = begin + length
        if opcode == FOOTER_OPCODE:
            return position, messages, others, FOOTER
