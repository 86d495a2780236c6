"""Play of the position sensor, which least squares read off the flow where the motion turns."""

import pytest
from sprung_rig import SETTINGS, B, recorded, strokes

from eha_monitor.balances.changed import against
from eha_monitor.balances.machine import healthy_machine_of
from eha_monitor.balances.measured import courses_of


@pytest.fixture(scope="module")
def machine():
    healthy = [recorded(seed, motion=strokes, noise=10.0) for seed in range(5)]
    courses = courses_of(healthy, SETTINGS)[1]
    return healthy_machine_of(courses, SETTINGS)


@pytest.mark.parametrize("width", [5e-5, 1e-4, 3e-4])
def test_play_that_has_come_is_called_so_beside_a_machine(machine, width):
    now = recorded(21, play=width, motion=strokes, noise=10.0)
    found = against(machine, [now], SETTINGS, ("healthy",))
    assert found.verdict == "mismatch"
    change = next(one for one in found.changes if one.what == "backlash")
    assert change.now.value == pytest.approx(width, rel=0.15)
    assert abs(change.now.value - width) < 3.0 * change.now.stddev
    assert {one.balance for one in found.changes} <= {"flow", "sensor"}  # no friction, no mass
    now = found.after["B"]
    assert abs(now.value - B) < 3.0 * now.stddev


def test_where_the_motion_turns_slowly_it_is_the_nearest(machine):
    """How the piston goes through the play is then most of what the flow shows of it."""
    found = against(machine, [recorded(23, play=1e-4, noise=10.0)], SETTINGS, ("healthy",))
    assert "play" in found.message and found.verdict in ("mismatch", "unexplained")
