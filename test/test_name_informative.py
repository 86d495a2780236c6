"""The windows of a long recording on which effects are named."""


import numpy as np
import pytest
from rig_tools import MULTISINE, REST, settings, simulated

from eha_monitor.mismatch.data.experiment import BURN_IN, experiment_of
from eha_monitor.mismatch.name.before import informative, windows_of
from eha_monitor.mismatch.name.naming import Naming, on_all_of
from eha_monitor.mismatch.name.nominal import nominal_model

RESTING, MOVING = 9.0, 3.0


@pytest.fixture(scope="module")
def experiment():
    """Nine seconds at rest, then three of rich motion."""
    resting, moving = (simulated(shape, seconds).recording(seed) for seed, (shape, seconds) in
                       enumerate(((REST, RESTING), (MULTISINE, MOVING))))
    return experiment_of([resting, moving], settings())


def test_what_moves_tells_most(experiment):
    found = informative(experiment, most=2000, window=1000)
    assert [len(stretch) for stretch in found.stretches] == [1000] * 2
    assert all(np.ptp(stretch.z[:, 0]) > 1e-3 for stretch in found.stretches)
    assert found.dt == experiment.dt and found.used is experiment.used


def test_a_short_recording_is_used_whole(experiment):
    assert informative(experiment) is experiment


def test_windows_are_the_stretch_in_pieces(experiment):
    whole = experiment.stretches[0]
    parts = windows_of(whole, experiment.dt, 2000)
    assert sum(map(len, parts)) == len(whole)
    assert np.array_equal(np.concatenate([part.z for part in parts]), whole.z, equal_nan=True)
    burn = round(BURN_IN / experiment.dt)
    for part in parts:
        assert not part.counted[:burn].any()
        first = round((part.start - whole.start) / experiment.dt)
        assert np.array_equal(part.counted[burn:], whole.counted[first + burn : first + len(part)])


def test_what_was_named_on_windows_is_run_over_the_whole(experiment):
    part = informative(experiment, most=3000, window=1000)
    fit = nominal_model(part)
    found = on_all_of(experiment, Naming(part, fit, fit))
    counted = sum(int(stretch.counted.sum()) for stretch in experiment.stretches)
    assert found.experiment.stretches is experiment.stretches
    assert len(found.after.e) == counted > len(fit.e)
    assert np.array_equal(found.after.theta, fit.theta)
    assert found.after.covariance is fit.covariance
