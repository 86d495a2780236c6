"""Exact sensitivities against differences of the filter, on recordings of another plant."""

from dataclasses import replace

import numpy as np
import pytest
from ruamel.yaml import YAML

from eha_monitor.concealed.cases import Case
from eha_monitor.concealed.generate import nominal_config, recording_of
from eha_monitor.mismatch.data.experiment import experiment_of
from eha_monitor.mismatch.data.inputs import FORCED, OPEN
from eha_monitor.mismatch.likelihood.fit import Fit, covariance_of, filtered, whitener
from eha_monitor.mismatch.likelihood.gains import Unknowns, gains_of, smallest_unknowns
from eha_monitor.mismatch.likelihood.tangents import Lane, along, can, lane_of
from eha_monitor.mismatch.name.columns import rig_free
from eha_monitor.mismatch.name.starts import (
    base_free,
    entered,
    free_of,
    own_sizes,
    starts_of,
    timing_free,
)
from eha_monitor.physics.effects import NAMES
from eha_monitor.physics.parameters import place_of
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.load import load_settings

LATE = 2e-5  # s of the small timing errors
ALL = ("x", "x_d", "omega", "p1", "p2")
RUBBED = {"coulomb_friction.F_c": 30.0}
LEAKING = {"turbulent_leakage.c": 2e-9, "drive_lag.tau": 2e-3}


def tangents(experiment, fit, names):
    """Return name -> (n, c) tangents for each stretch."""
    carried = along(experiment, fit, [lane_of(fit, name) for name in names])
    return {name: [part[:, :, i] for part in carried] for i, name in enumerate(names)}


def model_of(folder, effects=(), values=None, channels=ALL, **changes):
    """Return experiment and unfitted model of a recording that has the effects."""
    case = Case("case", tuple((name, 1.0) for name in effects), motion="short", channels=channels)
    config = nominal_config(case)
    rig = config["/**"]["ros__parameters"]["rig"]
    for key, value in changes.items():
        rig[key] = value
    with open(folder / "rig.yaml", "w") as file:
        YAML(typ="safe").dump(config, file)
    recorded, _ = recording_of(case)
    experiment = experiment_of([Recording(1e-3, recorded, start_ns=0)],
                               load_settings(folder / "rig.yaml"))
    theta, active = experiment.theta.copy(), experiment.active.copy()
    free = [*base_free(experiment), *timing_free(experiment), *rig_free(experiment)]
    for f in free:
        effect, dot, _ = f.name.partition(".")
        if dot and effect != "rig":
            active[NAMES.index(effect)], theta[f.place] = True, LATE
    for name in effects:
        start = starts_of(name, experiment)[0]
        theta, active = entered(theta, active, start)
        free += free_of(start)
    for name, value in (values or {}).items():
        theta[place_of(name)] = value
    return experiment, fit_at(experiment, theta, active, tuple(free))


def fit_at(experiment, theta, active, free):
    """Return an unfitted model at theta."""
    unknowns = Unknowns(*(10.0 * smallest_unknowns(experiment).as_array()))
    gains = gains_of(experiment, theta, active, unknowns)
    fit = Fit(theta, active, free, unknowns, gains, np.zeros((0, 0)), np.zeros((0, 0)), 0.0,
              np.zeros((len(free),) * 2))
    e = np.concatenate([one[stretch.counted] for one, stretch in zip(
        runs(experiment, fit, theta, active), experiment.stretches, strict=True)])
    return replace(fit, e=e, s=covariance_of(e))


def runs(experiment, fit, theta, active):
    return [filtered(experiment, stretch, theta, active, fit.gains)[0][:, experiment.columns]
            for stretch in experiment.stretches]


def off(experiment, fit, lane, found, both=True):
    """Return the relative error of a tangent, all channels whitened, against differences."""
    w = whitener(fit.s)
    back = 2.0 * fit.theta - lane.theta if both else fit.theta
    step = 2.0 * lane.step if both else lane.step
    ahead = runs(experiment, fit, lane.theta, lane.active)
    behind = runs(experiment, fit, back, lane.active if both else fit.active)
    error = size = 0.0
    for one, other, tangent, stretch in zip(ahead, behind, found, experiment.stretches,
                                            strict=True):
        exact = np.nan_to_num((one - other)[stretch.counted] / step) @ w.T
        error += np.sum((np.nan_to_num(tangent[stretch.counted]) @ w.T - exact) ** 2)
        size += np.sum(exact**2)
    return np.sqrt(error / size)


def all_off(experiment, fit):
    """Return name -> relative error of every free parameter's tangent."""
    names = [f.name for f in fit.free]
    found = tangents(experiment, fit, names)
    # Of a number at its lower bound there is no other side.
    return {f.name: off(experiment, fit, lane_of(fit, f.name), found[f.name],
                        both=fit.theta[f.place] > f.lower) for f in fit.free}


@pytest.mark.parametrize("effects, values, base, own", [
    ((), {}, 2e-3, 0.0),
    (("coulomb_friction",), RUBBED, 2e-2, 2e-2),
    (("turbulent_leakage", "drive_lag"), LEAKING, 2e-2, 4e-2)])
def test_tangents_are_the_slopes_of_the_filter(tmp_path, effects, values, base, own):
    experiment, fit = model_of(tmp_path, effects, values)
    for name, error in all_off(experiment, fit).items():
        # w acts in the few samples that creep, and has one side only where it is nil.
        assert error < (0.1 if name.endswith(".w") else own if name.partition(".")[0] in effects
                        else base), name


@pytest.mark.parametrize("mode", [OPEN, FORCED])
def test_tangents_where_the_pump_speed_or_the_force_is_the_input(tmp_path, mode):
    channels = ("x", "omega", "p1", "p2") if mode == OPEN else ("x", "p1", "p2")
    experiment, fit = model_of(tmp_path, ("coulomb_friction",), RUBBED, channels)
    assert experiment.mode == mode
    for name, error in all_off(experiment, fit).items():
        # v_e acts in the few samples that creep, on 1 % of what F_c does.
        assert error < (0.1 if name == "coulomb_friction.w" else
                        0.04 if name == "coulomb_friction.v_e" else 0.02), name


@pytest.mark.parametrize("name, tolerance", [
    ("constant_load", 0.01), ("quadratic_friction", 0.01), ("spring_load", 0.01),
    ("turbulent_leakage", 0.02), ("pressure_scale", 0.01), ("pressure_drift", 0.01),
    ("position_scale", 0.01), ("drive_gain", 0.01), ("pump_flow_gain", 0.01)])
def test_effect_that_enters_is_a_lane(tmp_path, name, tolerance):
    experiment, fit = model_of(tmp_path)
    start = starts_of(name, experiment)[0]
    share = 1e-3
    theta, active = entered(fit.theta, fit.active, replace(start, values=tuple(
        (key, share * value if f"{name}.{key}" in sizes(start) else value)
        for key, value in start.values)))
    lane = Lane(theta, active, share)
    assert can(experiment, fit, lane)
    found = [part[:, :, 0] for part in along(experiment, fit, [lane])]
    assert off(experiment, fit, lane, found, both=False) < tolerance


def sizes(start):
    return {f"{start.effect}.{p.name}" for p in own_sizes(start)}


def test_what_was_not_measured_has_no_tangent(tmp_path):
    experiment, fit = model_of(tmp_path)
    stretch = experiment.stretches[0]
    z = stretch.z.copy()
    z[::3, 2] = np.nan
    gappy = replace(experiment, stretches=(replace(stretch, z=z),))
    found = tangents(gappy, fit, ["B", "rig.mass"])
    missing = ~np.isfinite(runs(gappy, fit, fit.theta, fit.active)[0])
    assert np.array_equal(np.isnan(found["B"][0]), missing)
    assert off(gappy, fit, lane_of(fit, "B"), found["B"]) < 2e-3


def test_what_moves_by_itself_is_left_to_differences(tmp_path):
    experiment, fit = model_of(tmp_path)
    for name in ("line_dynamics", "backlash"):
        theta, active = entered(fit.theta, fit.active, starts_of(name, experiment)[0])
        assert not can(experiment, fit, Lane(theta, active, 1.0))
        with_it = replace(fit, theta=theta, active=active)
        assert not can(experiment, with_it, lane_of(with_it, "B"))
    two = fit.theta.copy()
    two[[place_of("viscous_damping"), place_of("command_delay.T")]] *= 1.01
    assert not can(experiment, fit, Lane(two, fit.active, 1.0))
