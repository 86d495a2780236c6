"""A diagnosis as a bag that PlotJuggler and Foxglove plot: measured, modelled and missing.

<namespace>/measured/joint_states, pressure/chamber_1, ...   what the sensors showed
<namespace>/modelled/joint_states, pressure/chamber_1, ...   what the model shows
<namespace>/missing/<balance>/needed, explained, remaining   std_msgs/Float64
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from eha_monitor.mismatch.show.series import Series
from eha_monitor.recordings.bag_writer import BagWriter
from eha_monitor.recordings.recording import Recording
from eha_monitor.recordings.write import MessageStream, messages_of

FLOAT = "std_msgs/msg/Float64"
PARTS = ("needed", "explained", "remaining")
BETWEEN_NS = 1_000_000_000  # between recordings whose times overlap
LITTLE_ENDIAN = bytes([0, 1, 0, 0])  # head of a serialised message


def write_diagnosis_bag(path: Path, series: Sequence[Series], recordings: Sequence[Recording],
                        namespace: str) -> tuple[str, ...]:
    """Write the signals of a diagnosis as a bag; returns its topics.

    Time is that of the recordings; one that begins before another has ended is moved behind it.

    Raises
    ------
    InputError
        If the place is taken or cannot be written.
    """
    begins = _begins(recordings)
    whole = [_streams(one, begins[one.source], namespace.rstrip("/")) for one in series]
    types = {stream.topic: stream.msgtype for streams in whole for stream in streams}
    bag = BagWriter(path, types)
    try:
        for streams in whole:
            bag.write_many({stream.topic: (stream.stamps, stream.data) for stream in streams})
        bag.close()
    except KeyboardInterrupt:
        bag.discard()
        raise
    return tuple(types)


def _begins(recordings: Sequence[Recording]) -> dict[str, int]:
    """Return the time of the first sample of each recording, ns, none inside another."""
    found, end = {}, 0
    for one in sorted(recordings, key=lambda recording: recording.start_ns):
        begin = max(one.start_ns, end)
        found[one.source] = begin
        end = begin + round(one.duration * 1e9) + BETWEEN_NS
    return found


def _streams(one: Series, begin: int, namespace: str) -> list[MessageStream]:
    length = len(next(iter(one.measured.values())))
    stamps = begin + np.round((one.start + np.arange(length) * one.dt) * 1e9).astype(np.int64)
    found = []
    for part, channels in (("measured", one.measured), ("modelled", one.modelled)):
        if channels:
            found += messages_of(channels, stamps, f"{namespace}/{part}")
    for balance, lack in one.lacks.items():
        for part in PARTS:
            values = getattr(lack, part)
            there = np.isfinite(values)
            found.append(MessageStream(f"/{namespace.strip('/')}/missing/{balance}/{part}".replace(
                "//", "/"), FLOAT, stamps[there], _floats(values[there])))
    return found


def _floats(values: np.ndarray) -> np.ndarray:
    """Return std_msgs/Float64 messages in CDR, (n, 12) uint8."""
    rows = np.empty((len(values), 12), dtype=np.uint8)
    rows[:, :4] = np.frombuffer(LITTLE_ENDIAN, dtype=np.uint8)
    rows[:, 4:] = np.ascontiguousarray(values, dtype="<f8").view(np.uint8).reshape(-1, 8)
    return rows
