"""A recorder whose zero of the position is not the controller's: found, told, and taken away."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from rig_tools import BETA, MULTISINE, settings, simulated, with_channels, without

from eha_monitor.api.config import Config
from eha_monitor.api.estimate import estimate
from eha_monitor.api.read import checked
from eha_monitor.api.recording import Recording
from eha_monitor.estimation.pipeline import estimate as estimated
from eha_monitor.estimation.zero import at_one_zero, zero_of
from eha_monitor.identify.experiment import SimulatedRig, bounds_of, identify
from eha_monitor.identify.plan import Planner
from eha_monitor.live.estimator import LiveEstimator
from eha_monitor.reports.diagnosis_words import channels_in_parts
from eha_monitor.settings.load import load_settings

SHAPE = {**MULTISINE, "frequency_end": 4.0}


def recorded(zero: float, seconds: float = 12.0, **effects):
    found = simulated(SHAPE, seconds, effects=effects).recording(0)
    return with_channels(found, x=found.channels["x"] + zero)


@pytest.mark.parametrize("zero", [2e-6, -1e-4, 3e-4])
def test_it_is_found_and_the_model_fits(zero):
    assert estimated(recorded(zero), settings()).model.status == "mismatch"
    right, (said,) = at_one_zero(recorded(zero), settings())
    moved = right.channels["x_d"] - recorded(0.0).channels["x_d"]
    assert np.ptp(moved) < 1e-12 and moved[0] == pytest.approx(zero, abs=1e-7)
    assert (said.kind, said.channels) == ("zero", ("x", "x_d"))
    assert ("more" if zero > 0.0 else "less") in said.finding
    parts = channels_in_parts(SimpleNamespace(channels=(said,)))
    assert parts == ((), (said.finding,))  # it is taken away, and stands against nothing
    found = estimated(right, settings())
    assert found.model.status == "consistent"
    assert found.parameters["beta_e"].value == pytest.approx(BETA, rel=0.03)


@pytest.mark.parametrize("effects", [
    {"drive_lag": {"tau": 0.004}}, {"coulomb_friction": {"F_c": 40.0}},
    {"cross_port_leakage": {"L": 1e-12}}, {"constant_load": {"F_0": 500.0}},
    {"drive_saturation": {"omega_max": 60.0}}], ids=lambda effects: next(iter(effects)))
def test_no_physics_is_a_zero_and_it_is_found_beside_all(effects):
    assert zero_of(recorded(0.0, **effects), settings()) is None
    value, stddev = zero_of(recorded(1e-4, **effects), settings())
    assert abs(value - 1e-4) < 3.0 * stddev < 3e-5


def test_a_gain_that_is_off_is_no_zero():
    off = settings(rig={"position_gain": 0.95 * settings().rig.position_gain})
    assert zero_of(recorded(0.0), off) is None
    value, stddev = zero_of(recorded(3e-4), off)
    assert abs(value - 3e-4) < 3.0 * stddev < 1e-6


def test_a_recording_that_cannot_say_it_stays_as_it_is():
    one = without(recorded(3e-4), "omega")
    assert at_one_zero(one, settings()) == (one, ())


def test_an_estimate_tells_it():
    one = recorded(3e-4)
    found = estimate(Recording.of(one, Config()), Config.of(settings()))
    assert any("x reads 300" in note for note in found.warnings)
    assert found.model.status == "consistent"


def test_the_monitor_finds_it_on_its_way():
    one, live = recorded(3e-4, 16.0), LiveEstimator(settings())
    for start in range(0, len(one), 50):
        live.push_rows(one.sample_time * np.arange(start, min(start + 50, len(one))), {
            name: values[start:start + 50] for name, values in one.channels.items()})
    found = live.snapshot()
    assert any("more than the drive's controller" in event.message for event in found.events)
    assert found.model.status == "consistent"
    assert found.parameters["beta_e"].value == pytest.approx(BETA, rel=0.03)


def test_an_experiment_on_a_rig_of_another_zero_decides_as_on_one_of_its_own():
    given = load_settings("config/identify.yaml")
    bounds = bounds_of(given, "config")

    class Recorded(SimulatedRig):
        def run(self, x_d, name):
            ran = super().run(x_d, name)
            return replace(ran, recording=with_channels(
                ran.recording, x=ran.recording.channels["x"] + 1e-4))

    def usable(recording):
        (mended,), said = checked([recording], given)
        return mended, said

    *_, last = identify(Recorded(given, bounds, 1), Planner(given, bounds, "config"), usable)
    assert (last.diagnosis.verdict, last.end) == ("consistent", "decided")
    assert [one.kind for one in last.diagnosis.channels].count("zero") == 1
