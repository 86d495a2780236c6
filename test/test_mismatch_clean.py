"""Clean records of the package's own simulator must name nothing, whatever gains on them."""

import numpy as np
import pytest
from eha_monitor.mismatch.choice import quiet_gain, take, weak
from rig_tools import TRIANGLE, settings, simulated

from eha_monitor.mismatch.data.experiment import experiment_of
from eha_monitor.mismatch.diagnose import diagnose
from eha_monitor.mismatch.name.base import Round, candidate_of, first_fit, settle, with_effect
from eha_monitor.mismatch.name.starts import Start, own_sizes

THRESHOLD = 12.0


@pytest.fixture(scope="module")
def triangle():
    return experiment_of([simulated(TRIANGLE, 12.0).recording(1)], settings(), False)


@pytest.fixture(scope="module")
def nominal(triangle):
    return first_fit(triangle)


def refitted(experiment, fit, effect, **values):
    start = Start(effect, tuple(values.items()))
    entered = with_effect(fit, start, (1.0,) * len(own_sizes(start)))
    return candidate_of(start, fit, settle(experiment, entered, 2, 4))


def test_what_quietens_the_filter_gains_on_any_record_and_is_not_taken(triangle, nominal):
    """A relief valve that just opens on each plateau (B v/A = 47.5 kPa) pins the pressure."""
    valve = refitted(triangle, nominal, "relief_valve", k=2e-10, p_c=47.6e3)
    assert valve.gain > THRESHOLD and weak(triangle, valve)
    assert quiet_gain(triangle, nominal, valve) < 3.0
    found = Round(nominal, (), (valve,))
    assert take(triangle, found, nominal, THRESHOLD) == (None, ())


def test_what_is_there_gains_more_with_a_quieter_filter():
    run = simulated(TRIANGLE, 12.0, effects={"cross_port_leakage": {"L": 4e-14}})
    experiment = experiment_of([run.recording(1)], settings(), False)
    fit = first_fit(experiment)
    leak = refitted(experiment, fit, "cross_port_leakage", L=1e-13)
    assert leak.gain > 3.0 * THRESHOLD and weak(experiment, leak)
    assert quiet_gain(experiment, fit, leak) > leak.gain


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_clean_triangles_of_drifting_rigs_name_nothing():
    """Of five such nights two named a relief valve, 26 log units each."""
    for night in range(6):
        rig = {"viscous_damping": 600.0 * (1.0 + 0.005 * night),
               "bulk_modulus": 6e8 * (1.0 - 0.004 * night)}
        run = simulated(TRIANGLE, 24.0, rig=rig)
        found = diagnose([run.recording(night)], settings(), calibrate=False)
        assert (found.verdict, found.effects) == ("consistent", ()), night
        assert np.isclose(found.after["B"].value, rig["viscous_damping"], rtol=0.01)
