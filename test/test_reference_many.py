"""Many short recordings are references each for itself, however long they are together."""

import numpy as np

from eha_monitor.mismatch.data.stretch import LOOKED, windows_of, windows_of_each
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings import Settings


def recording(rows, seed):
    rng = np.random.default_rng(seed)
    x = np.cumsum(rng.normal(0.0, 1e-5, rows))
    return Recording(1e-3, {"x": x, "p1": 2e6 + 1e8 * x, "p2": 2e6 - 1e8 * x}, 0, f"r{seed}")


def test_no_short_recording_is_left_out():
    many = [recording(3000, seed) for seed in range(LOOKED // 3000 + 2)]
    chosen = windows_of(many, Settings())  # that tell most, up to LOOKED samples
    assert sum(one.last - one.first for one in chosen) > 0.9 * LOOKED
    assert windows_of_each(many, Settings()) is None  # each whole


def test_each_long_recording_has_its_share():
    long = [recording(50_000, seed) for seed in range(3)]
    chosen = windows_of_each(long, Settings())
    assert {one.recording for one in chosen} == {0, 1, 2}
    for number in range(3):
        rows = sum(one.last - one.first for one in chosen if one.recording == number)
        assert 0.5 * LOOKED / 3 < rows < 1.5 * LOOKED / 3
