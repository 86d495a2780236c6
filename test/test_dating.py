"""Messages without stamps: dated by their receipt, or by others that waited with them."""

import numpy as np
import pytest
from bag_tools import START, joint, number, write_mcap
from hypothesis import given, settings
from hypothesis import strategies as st

from eha_monitor.recordings.align import Dating, beside
from eha_monitor.recordings.read import read_recording
from eha_monitor.settings import settings_from_tree

STEP = 2_000_000  # ns
CHANNELS = {"channels": {"omega": {"topic": "/motor", "field": "data"}},
            "rig": {"sample_time": 0.002}}


def received(sent, waits):
    """Return when messages came that were held up together, in order."""
    return np.maximum.accumulate(sent + 300_000 + waits) + 5_000 * np.arange(len(sent))


@given(st.lists(st.integers(0, 60_000_000), min_size=50, max_size=50))
@settings(max_examples=50)
def test_what_waited_together_has_stamps_of_its_own_to_within_a_sample(waits):
    sent = START + STEP * np.arange(50)
    came = received(sent, np.array(waits))
    dated = beside(came + 1_000, came, sent)
    assert np.abs(dated - sent).max() <= STEP


def blocks(count, size):
    """Return times that come ``size`` at once, when the last of them is due."""
    sent = START + STEP * np.arange(count)
    return received(sent, STEP * (size - 1 - np.arange(count) % size))


@pytest.mark.parametrize("held_up", ["both", "the position", "neither"])
def test_the_more_even_is_taken_as_they_come(held_up):
    count, size = 400, 40
    sent = START + STEP * np.arange(count)
    smooth, late = received(sent, np.zeros(count, dtype=int)), blocks(count, size)
    position = smooth if held_up == "neither" else late
    motor = (late if held_up == "both" else smooth) + 1_000
    dating, dated = Dating(), []
    for first in range(0, count, size):
        rows = slice(first, first + size)
        dating.learn(position[rows], sent[rows])
        dated.append(dating.dated("motor", motor[rows]))
    # After some of them.
    off = np.abs(np.concatenate(dated[2:]) - sent[2 * size:])
    assert off.max() <= (STEP if held_up == "both" else 5e6)
    assert np.diff(np.concatenate(dated[2:])).max() < 2.5 * STEP


def test_a_bag_of_a_busy_machine_keeps_its_motor(tmp_path):
    count = 2000
    came, omega = blocks(count, 50), 100.0 * np.sin(0.01 * np.arange(count))
    messages = []
    for k in range(count):
        messages += [("/eha/joint_states", "sensor_msgs/msg/JointState", int(came[k]),
                      joint(START + STEP * k, position=[0.01 * np.sin(0.005 * k)])),
                     ("/motor", "std_msgs/msg/Float64", int(came[k]) + 1_000, number(omega[k]))]
    found = read_recording(write_mcap(tmp_path / "a.mcap", messages),
                           settings_from_tree(CHANNELS, "rig.yaml"))
    values = found.channels["omega"]
    assert np.isfinite(values).mean() > 0.99
    assert np.nanmax(np.abs(values - omega[:len(values)])) < 2.0  # two samples of its steepest
    assert any("received in bursts" in one for one in found.losses)
