"""Directions along which no recording can tell one machine from another."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import minimize_scalar

from eha_monitor.concealed.cases import Case
from eha_monitor.concealed.generate import nominal_config, recording_of
from eha_monitor.mismatch.data.experiment import experiment_of
from eha_monitor.mismatch.likelihood.fit import (
    filtered,
    log_likelihood_of,
    prior_exponent,
    with_unknowns,
)
from eha_monitor.mismatch.likelihood.invariance import (
    BEYOND_ONE,
    PRESSURE,
    at_prior,
    consistent,
    directions,
    tangents,
)
from eha_monitor.mismatch.name.nominal import with_rig
from eha_monitor.mismatch.name.refit import (
    Slopes,
    at_likeliest_kilogram,
    polished,
    unfitted,
)
from eha_monitor.mismatch.name.starts import starts_of, with_effect
from eha_monitor.mismatch.show.model import robust
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.physics.parameters import place_of
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.load import settings_from_tree

FITTED = sorted(name for name, effect in CATALOGUE.items()
                if any(p.fitted for p in effect.parameters) and name != "position_quantisation")
# What stands for a number of the rig is fitted in its place, not beside it.
REPLACING = ("added_mass", "cross_port_leakage", "pump_flow_gain")


@pytest.fixture(scope="module")
def experiment():
    case = Case("case", (), motion="short")
    tree = nominal_config(case)
    return experiment_of([Recording(1e-3, recording_of(case)[0], start_ns=0)],
                         settings_from_tree(tree, "case"))


def with_all_free(experiment, *names, **values):
    """Return a model that has effects, with every number of the rig free beside theirs."""
    fit = unfitted(experiment)
    for name in names:
        fit = with_effect(fit, starts_of(name, experiment)[0], (1.0,))
    fit = with_rig(experiment, fit)
    theta = fit.theta.copy()
    for name, value in values.items():
        theta[place_of(name.replace("__", "."))] = value
    return with_unknowns(experiment, replace(fit, theta=theta))


def shown(experiment, fit, theta):
    """Return what a model shows when nothing corrects it."""
    stretch = experiment.stretches[0]
    return filtered(experiment, stretch, theta, fit.active, np.zeros_like(fit.gains),
                    free=np.ones(len(stretch), dtype=np.bool_))[0][:, experiment.columns]


@pytest.mark.parametrize("name", FITTED)
def test_a_machine_moved_along_a_direction_shows_the_same(experiment, name):
    fit = with_all_free(experiment, name)
    ways = directions(fit.free, fit.theta, fit.active)
    assert len(ways) == (1 if name in REPLACING else 2)
    plain = shown(experiment, fit, fit.theta)
    for moved in ways:
        theta = fit.theta.copy()
        for place, power in moved.items():
            theta[place] *= 1.2**power
        assert_allclose(shown(experiment, fit, theta), plain, rtol=1e-6,
                        atol=1e-7 * np.nanmax(np.abs(plain)))


@pytest.mark.parametrize("beside", [(), ("coulomb_friction", "pressure_offset"),
                                    ("spring_load", "relief_valve", "turbulent_leakage")])
def test_the_scales_of_both_pressure_sensors_make_up_for_another_kilogram(experiment, beside):
    fit = with_all_free(experiment, "pressure_scale", *beside, pressure_scale__k_1=0.02)
    (moved,) = directions(fit.free, fit.theta, fit.active, [PRESSURE])
    theta = fit.theta.copy()
    for place, power in moved.items():
        one = float(place in BEYOND_ONE)
        theta[place] = (one + theta[place]) * 1.1**power - one
    plain = shown(experiment, fit, fit.theta)
    assert_allclose(shown(experiment, fit, theta), plain, rtol=1e-6,
                    atol=1e-7 * np.nanmax(np.abs(plain)))


def test_a_machine_in_another_kilogram_is_where_its_tolerances_are_likeliest(experiment):
    """Both sensors at -7 %, mass, spring and charge 7 % too large, were as good as a right one."""
    fit = with_all_free(experiment, "pressure_scale")
    (moved,) = directions(fit.free, fit.theta, fit.active, [PRESSURE])
    theta = fit.theta.copy()
    for place, power in moved.items():
        one = float(place in BEYOND_ONE)
        theta[place] = (one + theta[place]) * 1.08**power - one
    made = at_likeliest_kilogram(experiment, with_unknowns(experiment, replace(fit, theta=theta)))
    right = {name: fit.theta[place_of(name)] for name in ("mass", "charge_pressure")}
    assert {name: made.theta[place_of(name)] for name in right} == pytest.approx(right, rel=0.02)
    assert prior_exponent(fit.free, made.theta) > prior_exponent(fit.free, theta) + 1.0


def test_a_number_that_is_known_leaves_no_direction_that_moves_it(experiment):
    fit = with_all_free(experiment, "coulomb_friction")
    force = tuple(f for f in fit.free if f.name != "coulomb_friction.F_c")
    assert [place_of("bulk_modulus") in one for one in directions(
        force, fit.theta, fit.active)] == [True]
    assert not directions(tuple(f for f in fit.free if f.name != "rig.volume_1"), fit.theta,
                          fit.active)


def test_at_the_prior_is_where_the_priors_are_likeliest_and_the_recording_says_the_same(
        experiment):
    fit = with_all_free(experiment, "position_dependent_volume",
                        position_dependent_volume__A_v=1e-3, volume_1=7.5e-5, volume_2=7.3e-5)
    before = log_likelihood_of(shown(experiment, fit, fit.theta))
    (size, stiffness), made = directions(fit.free, fit.theta, fit.active), at_prior(
        fit.free, fit.theta, fit.active)

    def moved(factor):
        theta = fit.theta.copy()
        for place, power in stiffness.items():
            theta[place] *= np.exp(power * factor)
        return theta

    best = minimize_scalar(lambda s: -prior_exponent(fit.free, moved(s)), bounds=(-1, 1),
                           method="bounded", options={"xatol": 1e-9}).x
    assert size
    assert len(made) == 3
    assert_allclose(made[1], moved(best), rtol=1e-3)
    assert log_likelihood_of(shown(experiment, fit, made[1])) == pytest.approx(before, abs=1e-3)


def test_slopes_are_made_nil_along_a_direction_only_where_they_nearly_are(experiment):
    rng = np.random.default_rng(1)
    fit = with_all_free(experiment)
    along = tangents(fit.free, fit.theta, directions(fit.free, fit.theta, fit.active))
    slopes = rng.standard_normal((len(fit.free), 500))
    assert consistent(slopes, along) is slopes  # the data can tell
    u = along[1]
    i = int(np.flatnonzero(u)[0])
    slopes[i] -= (u @ slopes) / u[i] * (1.0 + 1e-3)
    made = consistent(slopes, along[1:])
    assert np.linalg.norm(u @ made) < 1e-9 * np.linalg.norm(slopes[i])
    assert np.linalg.norm(made - slopes) < 0.01 * np.linalg.norm(slopes)
    assert np.isfinite(made).all() and consistent(slopes, along[:0]) is slopes


def test_a_parameter_is_no_surer_than_the_tolerances_along_a_direction(experiment):
    fit = robust(experiment, polished(experiment, with_all_free(experiment),
                                      Slopes(experiment)))
    rig = experiment.settings.rig.tolerance
    # Closed form: what is known of the size are areas, displacement, mass and volumes; both areas
    # and both volumes have one error each.
    known = sum(rig.log_spread(key) ** -2.0
                for key in ("area_1", "pump_displacement", "mass", "volume_1"))
    assert fit.stddev("B") / fit.value("B") > 0.95 * known**-0.5
    assert fit.stddev("beta_e") / fit.value("beta_e") > 0.9 * rig.log_spread("volume_1")
