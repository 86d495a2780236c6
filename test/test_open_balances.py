"""What is told of a balance that nothing describes: a boom whose load comes and goes."""

import numpy as np
import pytest
from sprung_rig import SETTINGS, recorded

from eha_monitor.balances.change_point import change_point
from eha_monitor.balances.changed import against
from eha_monitor.balances.machine import healthy_machine_of
from eha_monitor.balances.measured import courses_of


def load(seed):
    """Return a load of some kN that goes with the time, another in each recording."""
    phases = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, 4)

    def force(t, x, v):
        return 2500.0 * sum(np.sin(2.0 * np.pi * f * t + phase) for f, phase in zip(
            (0.05, 0.09, 0.16, 0.31), phases, strict=True))
    return force


@pytest.fixture(scope="module")
def boom():
    healthy = [recorded(seed, load(seed)) for seed in range(5)]
    return healthy_machine_of(courses_of(healthy, SETTINGS)[1], SETTINGS)


@pytest.mark.parametrize("seed", range(10, 13))
def test_a_balance_that_a_constant_describes_as_well_names_no_change(boom, seed):
    assert np.median(boom["force"].held) >= 1.0
    found = against(boom, [recorded(seed, load(seed))], SETTINGS, boom.sources)
    assert not [one for one in found.changes if one.balance == "force"]
    assert "a change of the force may be missed" in found.message


def test_a_leak_is_told_beside_it(boom):
    found = against(boom, [recorded(20, load(20), leak=lambda t, x, v, dp: 6e-13 * dp)],
                    SETTINGS, boom.sources)
    assert [one.balance for one in found.changes] == ["flow"]


@pytest.mark.parametrize("seed", range(30, 34))
def test_no_number_steps_in_a_balance_that_stays_open(seed):
    """"Damping fell by 590 kN s/m" where 109 % of the force was unexplained."""
    found = change_point(recorded(seed, load(seed)), SETTINGS)
    assert found is None or found.balance != "force"
