"""Thousands of messages at a time into an mcap file, byte for byte as one by one.

``mcap`` builds each message's record in Python, which takes longer than all else that writing a
simulated recording does.  Here the records of a stretch are made as one array; file, chunks,
compression and summary stay the library's.
"""

from dataclasses import dataclass, field

import numpy as np
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import MessageIndex
from mcap.writer import Writer

HEAD = np.dtype([("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"),
                 ("log_time", "<u8"), ("publish_time", "<u8")])


@dataclass
class _Index(MessageIndex):
    """A message index that holds most of its records as arrays, (k, 2) time and offset each."""

    blocks: list[np.ndarray] = field(default_factory=list)

    def write(self, stream: RecordBuilder) -> None:
        """Write the record."""
        single = np.array(self.records, dtype="<u8").reshape(-1, 2)
        data = np.concatenate([*self.blocks, single]).astype("<u8").tobytes()
        stream.start_record(Opcode.MESSAGE_INDEX)
        stream.write2(self.channel_id)
        stream.write4(len(data))
        stream.write(data)
        stream.finish_record()


@dataclass(frozen=True)
class Messages:
    """Messages of one channel at rising times: ids of mcap, (m,) ns, (m, length) uint8."""

    channel_id: int
    times: np.ndarray
    data: np.ndarray

    def records(self) -> np.ndarray:
        """Return the mcap records, (m, HEAD + length) uint8."""
        head = np.zeros(len(self.times), dtype=HEAD)
        head["opcode"] = Opcode.MESSAGE
        head["length"] = HEAD.itemsize - 9 + self.data.shape[1]
        head["channel"] = self.channel_id
        head["log_time"] = head["publish_time"] = self.times
        return np.hstack([head.view(np.uint8).reshape(-1, HEAD.itemsize), self.data])


class BulkWriter(Writer):
    """An mcap writer that also takes messages by the thousand."""

    def add_messages(self, channels: list[Messages]) -> None:
        """Add messages of several channels in the order of time, then of the list."""
        channels = [one for one in channels if len(one.times)]
        if not channels:
            return
        data, times, which, ends = _in_order(channels)
        # What mcap keeps private: the chunk in progress, its largest size, the statistics.
        builder, size = self._Writer__chunk_builder, self._Writer__chunk_size
        statistics = self._Writer__statistics
        if statistics.message_count == 0:
            statistics.message_start_time = int(times[0])
        statistics.message_start_time = min(int(times[0]), statistics.message_start_time)
        statistics.message_end_time = max(int(times[-1]), statistics.message_end_time)
        statistics.message_count += len(times)
        for one in channels:
            statistics.channel_message_counts[one.channel_id] += len(one.times)
        first, begin = 0, 0
        while first < len(times):
            # A chunk ends with the message that makes it larger than its size.
            last = int(np.searchsorted(ends, begin + size - builder.count, side="right")) + 1
            last = min(last, len(times))
            stop = int(ends[last - 1])
            starts = np.concatenate([[begin], ends[first:last - 1]]) - begin + builder.count
            if builder.num_messages == 0:
                builder.message_start_time = int(times[first])
            builder.message_start_time = min(builder.message_start_time, int(times[first]))
            builder.message_end_time = max(builder.message_end_time, int(times[last - 1]))
            builder.num_messages += last - first
            self._note(builder, channels, times[first:last], which[first:last], starts)
            builder.record_writer.write(data[begin:stop].tobytes())
            first, begin = last, stop
            self._Writer__maybe_finalize_chunk()

    @staticmethod
    def _note(builder, channels: list[Messages], times: np.ndarray, which: np.ndarray,
              starts: np.ndarray) -> None:
        """Enter messages into the indices of the chunk, in the order of their coming."""
        places, first = np.unique(which, return_index=True)
        for place in places[np.argsort(first)].tolist():
            channel_id = channels[place].channel_id
            index = builder.message_indices.get(channel_id)
            if not isinstance(index, _Index):
                index = _Index(channel_id, index.records if index else [])
                builder.message_indices[channel_id] = index
            if index.records:
                index.blocks.append(np.array(index.records, dtype="<u8"))
                index.records = []
            mine = which == place
            index.blocks.append(np.column_stack([times[mine], starts[mine]]).astype("<u8"))


def _in_order(channels: list[Messages]):
    """Return all records as bytes, their times and channels (place in the list), their ends."""
    records = [one.records() for one in channels]
    lengths = np.array([part.shape[1] for part in records])
    same = all(np.array_equal(one.times, channels[0].times) for one in channels[1:])
    if same and (np.diff(channels[0].times) > 0).all():  # row by row, each channel once
        rows = len(channels[0].times)
        data = np.hstack(records).reshape(-1)
        which = np.tile(np.arange(len(channels)), rows)
        times = np.repeat(channels[0].times, len(channels))
        return data, times, which, np.cumsum(np.tile(lengths, rows))
    times = np.concatenate([one.times for one in channels])
    which = np.concatenate([np.full(len(one.times), i) for i, one in enumerate(channels)])
    order = np.lexsort((which, times))
    times, which = times[order], which[order]
    ends = np.cumsum(lengths[which])
    data = np.empty(int(ends[-1]), dtype=np.uint8)
    for place, part in enumerate(records):
        starts = ends[which == place] - lengths[place]
        data[starts[:, None] + np.arange(lengths[place])] = part
    return data, times, which, ends
