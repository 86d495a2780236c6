"""The framing of mcap records, walked by a compiled loop.

The library's reader makes a Python object of each message (figures in docs/dependencies.md).
"""

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


@njit
def walk_records(data, start, ids, times, begins, lengths, opcodes, other_begins, other_lengths):
    """Walk mcap records from ``start`` on, until an output array is full or the data end.

    Parameters
    ----------
    data : (n,) uint8.
    start : position of an opcode.
    ids, times, begins, lengths : (m,) int64, written: channel id, log time in ns, position and
        length of each message's payload.
    opcodes, other_begins, other_lengths : (k,) int64, written for every other record.

    Returns
    -------
    position, messages, others, ending : where the walk stopped, how many of each, and why.
    """
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
