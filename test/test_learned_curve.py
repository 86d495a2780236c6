"""What no candidate makes, learned as a curve over one signal: of a motion made by arithmetic."""

import numpy as np
import pytest
from sprung_rig import DRY, LEAK, SETTINGS, B, one_wave, recorded

from eha_monitor.balances.answer import answered
from eha_monitor.balances.candidates import own_column
from eha_monitor.balances.changed import against
from eha_monitor.balances.machine import healthy_machine_of
from eha_monitor.balances.measured import courses_of

HEIGHT, PLACE, HALF = 90.0, 5e-3, 4e-3  # of a rough spot


def rough(t, x, v):
    """Return friction of a stretch of the cylinder with steep ends, N."""
    there = 1.0 / (1.0 + np.exp((np.abs(x - PLACE) - HALF) / 3e-4))
    return HEIGHT * there * np.tanh(v / 1e-3)


def after_a_turn(t, x, v):
    """Return a force that follows each reversal, whichever place it is at, N."""
    turned = np.maximum.accumulate(np.where(np.diff(np.sign(v), prepend=v[0]) != 0.0, t, 0.0))
    return HEIGHT * np.exp(-(t - turned) / 0.2) * np.sign(v)


def leaky(t, x, v, dp):
    """Return the leak of a worn stretch, m³/s."""
    return 4e-12 * np.exp(-(((x - PLACE) / HALF) ** 2)) * dp


@pytest.fixture(scope="module")
def machine():
    courses = courses_of([recorded(seed) for seed in range(5)], SETTINGS)[1]
    return healthy_machine_of(courses, SETTINGS)


def height_and_place(term):
    curve = np.abs(term.curve)  # a leak is less flow into chamber 1
    top = curve > 0.5 * curve.max()
    return curve[top].mean(), term.x[top].mean(), np.ptp(term.x[top])


def test_a_rough_spot_beside_a_machine_is_a_curve_over_the_place(machine):
    found = against(machine, [recorded(11, rough)], SETTINGS, ("healthy",))
    assert found.verdict == "unexplained" and not found.changes
    (term,) = found.learned
    assert (term.balance, term.of) == ("force", ("x", "v"))
    height, place, width = height_and_place(term)
    assert height == pytest.approx(HEIGHT, rel=0.08)
    assert place == pytest.approx(PLACE, abs=5e-4)
    assert width == pytest.approx(2.0 * HALF, rel=0.2)
    assert term.removed > 0.95
    # B is what it was, with a deviation that says so.
    now = found.after["B"]
    assert abs(now.value - B) < 3.0 * now.stddev < 0.3 * B
    # The error table is on blocks that were left out, and the picture has the force over x.
    assert found.signals["force"].after_rms < 0.2 * found.signals["force"].before_rms
    assert "position" in {curve.against for curve in found.curves}


def test_nothing_is_learned_of_a_healthy_recording(machine):
    found = against(machine, [recorded(12)], SETTINGS, ("healthy",))
    assert found.verdict == "consistent" and not found.learned


def test_a_leak_of_a_worn_stretch_is_a_curve_over_the_place(machine):
    found = against(machine, [recorded(13, leak=leaky)], SETTINGS, ("healthy",))
    (term,) = found.learned
    assert (term.balance, term.of) == ("flow", ("x", "dp"))
    height, place, _ = height_and_place(term)
    assert height == pytest.approx(4e-12 * 0.8, rel=0.15)  # mean above half of it
    assert place == pytest.approx(PLACE, abs=5e-4)


def test_beside_another_change_it_is_learned_as_well(machine):
    found = against(machine, [recorded(18, rough, leak=lambda t, x, v, dp: 4.0 * LEAK * dp)],
                    SETTINGS, ("healthy",))
    assert found.verdict == "mismatch"
    assert [one.what for one in found.changes] == ["cross_port_leakage"]
    (term,) = found.learned
    height, place, _ = height_and_place(term)
    assert height == pytest.approx(HEIGHT, rel=0.1) and place == pytest.approx(PLACE, abs=5e-4)


def test_a_friction_that_follows_each_reversal_is_no_place_beside_a_machine(machine):
    found = against(machine, [recorded(19, after_a_turn, motion=one_wave)], SETTINGS, ("healthy",))
    assert found.verdict != "consistent" and not found.learned


def test_what_follows_each_reversal_is_no_function_of_the_place():
    """On a motion that repeats, place and direction say when it is: half of it would fit."""
    found = answered([recorded(14, after_a_turn, motion=one_wave)], SETTINGS)
    assert not found.learned


def test_one_recording_alone_gives_the_spot_and_the_friction_beside_it():
    found = answered([recorded(15, rough)], SETTINGS)
    (term,) = found.learned
    height, place, _ = height_and_place(term)
    assert height == pytest.approx(HEIGHT, rel=0.1) and place == pytest.approx(PLACE, abs=5e-4)
    (effect,) = [one for one in found.effects if "F_c" in one.parameters]
    assert effect.parameters["F_c"].value == pytest.approx(DRY, rel=0.06)
    now = found.after["B"]
    assert abs(now.value - B) < 3.0 * now.stddev
    assert term.statement in found.message


def test_its_entry_in_a_config_is_what_was_concealed():
    """The next recording, with the entry as a known effect, has nothing to learn."""
    found = answered([recorded(15, rough)], SETTINGS)
    known = SETTINGS.model_copy(update={"effects": {"learned_force": found.learned[0].entry}})
    again = answered([recorded(16, rough)], known)
    assert not again.learned
    course = courses_of([recorded(17)], SETTINGS)[1][0]
    made = own_column(found.learned[0].entry, course, SETTINGS.rig)
    true = rough(None, course.x, course.v)
    moving = course.moving
    assert np.sqrt(np.mean((made - true)[moving] ** 2)) < 0.2 * np.sqrt(np.mean(true[moving] ** 2))
