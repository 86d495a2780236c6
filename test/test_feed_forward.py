"""A drive whose command holds the velocity as well, of which the config knows nothing."""

import pytest
from sprung_rig import AREA, DISPLACEMENT, SETTINGS, recorded, strokes

from eha_monitor.balances.answer import answered
from eha_monitor.balances.changed import against
from eha_monitor.balances.machine import healthy_machine_of
from eha_monitor.balances.measured import courses_of

GAIN, FEED = 16000.0, 0.8 * AREA / DISPLACEMENT  # of 3125 rad/m that the piston takes
KNOWN = SETTINGS.model_copy(update={"rig": SETTINGS.rig.model_copy(update={
    "position_gain": 4.0 * GAIN})})  # what the speed over the position error would be


def driven(seed, gain=GAIN):
    return recorded(seed, motion=strokes, drive=(gain, FEED))


def test_it_is_named_and_the_gain_beside_it_is_right():
    found = answered([driven(seed) for seed in range(4)], KNOWN)
    effect = next(one for one in found.effects if one.name == "feed_forward")
    assert effect.balance == "drive"
    assert effect.parameters["k_v"].value == pytest.approx(FEED, rel=0.02)
    gain = next(one for one in found.rig_data if one.key == "position_gain")
    assert gain.found.value == pytest.approx(GAIN, rel=0.03)


def test_a_gain_that_changes_is_seen_beside_it():
    machine = healthy_machine_of(courses_of([driven(seed) for seed in range(5)], KNOWN)[1], KNOWN)
    assert not against(machine, [driven(6)], KNOWN, ("healthy",)).changes
    found = against(machine, [driven(7, 0.8 * GAIN)], KNOWN, ("healthy",))
    assert not found.blind
    assert [one.what for one in found.changes] == ["drive_gain"]
