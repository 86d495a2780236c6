"""Slopes of the innovations against central differences over other steps of time and number."""

from dataclasses import replace

import numpy as np
import pytest
from ruamel.yaml import YAML

from eha_monitor.concealed.cases import Case
from eha_monitor.concealed.generate import nominal_config, recording_of
from eha_monitor.mismatch.data.experiment import experiment_of
from eha_monitor.mismatch.data.inputs import CLOSED, FORCED, OPEN
from eha_monitor.mismatch.likelihood.fit import filtered, whitener, with_unknowns
from eha_monitor.mismatch.name.columns import columns_at
from eha_monitor.mismatch.name.refit import unfitted
from eha_monitor.mismatch.name.starts import starts_of, with_effect
from eha_monitor.physics.parameters import place_of
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.load import load_settings

CHANNELS = {CLOSED: ("x", "x_d", "omega", "p1", "p2"), OPEN: ("x", "omega", "p1", "p2"),
            FORCED: ("x", "p1", "p2")}
FARTHER = 5.0  # times the step of the code


def model_of(folder, mode, effects, values):
    """Return experiment and unfitted model of a recording that has the effects."""
    case = Case("case", tuple((name, 1.0) for name in effects), motion="short",
                channels=CHANNELS[mode])
    with open(folder / "rig.yaml", "w") as file:
        YAML(typ="safe").dump(nominal_config(case), file)
    experiment = experiment_of([Recording(1e-3, recording_of(case)[0], start_ns=0)],
                               load_settings(folder / "rig.yaml"))
    assert experiment.mode == mode
    fit = unfitted(experiment)
    for name in effects:
        fit = with_effect(fit, starts_of(name, experiment)[0], (1.0,))
    theta = fit.theta.copy()
    for name, value in values.items():
        theta[place_of(name)] = value
    return experiment, with_unknowns(experiment, replace(fit, theta=theta))


def central(experiment, fit, f):
    """Return a number's slope in its prior deviations, by differences over a longer step."""
    sides = []
    for sign in (1.0, -1.0):
        theta = fit.theta.copy()
        step = sign * FARTHER * (2e-5 if f.log else 1e-3 * f.spread)
        now = f.inward(theta[f.place])
        theta[f.place] = np.exp(now + step) if f.log else now + step
        sides.append(filtered(experiment, experiment.stretches[0], theta, fit.active,
                              fit.gains)[0][:, experiment.columns])
    return (sides[0] - sides[1]) / (2.0 * abs(step)) * f.spread


@pytest.mark.parametrize(("mode", "effects", "values"), [
    (CLOSED, (), {}),
    (CLOSED, ("coulomb_friction",), {"coulomb_friction.F_c": 30.0}),
    (CLOSED, ("turbulent_leakage", "drive_lag"),
     {"turbulent_leakage.c": 2e-9, "drive_lag.tau": 2e-3}),
    (OPEN, (), {}),
    (FORCED, (), {})])
def test_columns_are_the_slopes_of_the_filter(tmp_path, mode, effects, values):
    experiment, fit = model_of(tmp_path, mode, effects, values)
    columns = columns_at(experiment, fit, unnamed=False, suspects=False)
    w = whitener(fit.s)
    for place, column in enumerate(columns.what[:columns.values[0].shape[2] - 1]):
        if fit.theta[column.free.place] <= column.free.lower:  # there is no other side
            continue
        exact = np.nan_to_num(central(experiment, fit, column.free)) @ w.T
        off = np.nan_to_num(columns.values[0][:, :, 1 + place]) @ w.T - exact
        assert np.sum(off**2) < 0.03**2 * np.sum(exact**2), column.name


def test_what_was_not_measured_has_no_slope(tmp_path):
    experiment, fit = model_of(tmp_path, CLOSED, (), {})
    stretch = experiment.stretches[0]
    z = stretch.z.copy()
    z[::3, 2] = np.nan
    gappy = replace(experiment, stretches=(replace(stretch, z=z),))
    (values,) = columns_at(gappy, fit, unnamed=False, suspects=False).values
    channel = list(experiment.columns).index(2)
    assert np.isnan(values[::3, channel]).all() and np.isfinite(values[1::3, channel]).all()
