"""Beyond the range of what was learned nothing is judged, from a recording and live."""

import re

import numpy as np
import pytest
from rig_tools import settings, simulated

from eha_monitor.estimation.model_watch import beyond, ranges_of, within
from eha_monitor.estimation.pipeline import estimate
from eha_monitor.estimation.results import ModelStatus
from eha_monitor.live.estimator import LiveEstimator
from eha_monitor.settings.own_terms import checked

TABLE = {"adds": "force", "of": "x", "first": -0.012, "last": 0.012,
         "values": [-30.0, -5.0, 0.0, 5.0, 30.0]}


def sine(amplitude):
    return {"kind": "sine", "amplitude": amplitude, "frequency": 1.0}


def run(amplitude, seconds=4.0):
    return simulated(sine(amplitude), seconds, effects={"learned_force": TABLE})


def live(one):
    """Return the last snapshot of a live estimator and all that was told."""
    recording, estimator, told = one.recording(seed=1), LiveEstimator(one.config), []
    n, dt = len(recording), recording.sample_time
    for first in range(0, n, 100):
        here = slice(first, min(first + 100, n))
        estimator.push_rows(np.arange(n)[here] * dt, {
            name: values[here] for name, values in recording.channels.items()})
        told += estimator.snapshot().events
    return estimator.snapshot(), told


@pytest.mark.parametrize(("amplitude", "status"), [(0.008, "consistent"), (0.03, "not_judged")])
def test_an_estimate_is_judged_where_something_was_learned(amplitude, status):
    found = estimate(run(amplitude).recording(seed=1), run(amplitude).config)
    assert found.model.status == status
    if status == "not_judged":
        assert "learned_force was learned from x = −12 mm to 12 mm" in found.model.message
        assert set(found.model.tainted) == {"B", "beta_e"}


def test_the_monitor_says_so_and_judges_again_when_the_motion_comes_back():
    inside, told = live(run(0.008))
    assert inside.model.status == "consistent" and not any("learned" in e.message for e in told)
    outside, told = live(run(0.03))
    assert outside.model.status == "not_judged" and "outside" in outside.model.message
    assert sum("learned_force was learned" in event.message for event in told) == 1


@pytest.mark.parametrize("of", ["x", "v", "dp", "p", "omega", "p1", "p2"])
def test_each_signal_is_read_from_the_channels(of):
    """A signal that rises linearly from 0 to 1: 10 % of it lie beyond 0.9."""
    rise = np.linspace(0.0, 1.0, 1001)
    channels = {"x": np.cumsum(rise) * 1e-3, "p1": rise, "p2": rise, "omega": rise}
    if of == "x":
        channels["x"] = rise
    if of == "dp":
        channels["p2"] = np.zeros(1001)
    entry = checked("mine", {**TABLE, "of": of, "first": 0.0, "last": 0.9})
    ranges = ranges_of(settings(effects={"mine": entry}))
    words = beyond(ranges, channels, 1e-3, None)
    assert re.search(r" (7\.8|8\.1)\d % of the samples", words), words  # 2 % past the end hold
    assert beyond(ranges, {"x": np.full(5, np.nan)}, 1e-3, None) == ""


def test_formulas_and_ripples_have_no_ends():
    assert ranges_of(settings(effects={
        "spot": {"adds": "force", "expression": "F*x", "F": 3.0},
        "ripple": {**TABLE, "adds": "flow", "of": "angle"}})) == ()
    status = ModelStatus("consistent", "fits")
    assert within(status, "", 0.0) is status
