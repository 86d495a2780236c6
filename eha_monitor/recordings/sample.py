"""Parts of a long recording that fit into memory."""

from dataclasses import replace

import numpy as np

from eha_monitor.recordings import columns
from eha_monitor.recordings.columns import let_go
from eha_monitor.recordings.recording import Recording

STRETCH = 4096  # rows of each stretch of a sample


def sample_of(recording: Recording) -> Recording:
    """Return stretches from all over a long recording, a missing row between two; or itself."""
    rows, count = len(recording), max(columns.IN_MEMORY // (STRETCH + 1), 1)
    if rows <= columns.IN_MEMORY:
        return recording
    starts = np.linspace(0, rows - STRETCH, count).astype(int)
    channels = {}
    for name, values in recording.channels.items():
        channels[name] = np.concatenate([
            part for start in starts.tolist()
            for part in (values[start:start + STRETCH], [np.nan])])
        let_go(values)
    return replace(recording, channels=channels)


def rows_of(recording: Recording, start: int, stop: int) -> Recording:
    """Return rows of a recording, in memory."""
    part = {name: values[start:stop].copy() for name, values in recording.channels.items()}
    let_go(*recording.channels.values())
    return replace(recording, channels=part, losses=())
