"""What every model fits, and effects put in and taken out."""

import numpy as np
import pytest
from mismatch_tools import fitted
from rig_tools import settings

from eha_monitor.mismatch.likelihood.fit import with_unknowns
from eha_monitor.mismatch.likelihood.gains import Unknowns, smallest_unknowns
from eha_monitor.mismatch.name.columns import columns_at, placed, rig_free, runs_of
from eha_monitor.mismatch.name.gates import at_bound
from eha_monitor.mismatch.name.gram import grams_of
from eha_monitor.mismatch.name.rank import best_over, ranked_at
from eha_monitor.mismatch.name.refit import Slopes, evidence_of, joined, keep_within, polished
from eha_monitor.mismatch.name.starts import (
    LEAST_SHARE,
    base_free,
    free_of,
    limits_of,
    own_sizes,
    possible,
    starts_of,
    timing_free,
    with_effect,
    without_effect,
)
from eha_monitor.mismatch.policy import POLICY
from eha_monitor.physics.effects import CATALOGUE, NAMES
from eha_monitor.physics.parameters import place_of


@pytest.fixture(scope="module")
def clean():
    return fitted()


def test_a_damping_and_a_stiffness_are_positive(clean):
    b, beta = base_free(clean.experiment)
    assert (b.name, beta.name) == ("B", "beta_e") and b.lower > 0.0 and beta.lower > 0.0
    one, two = clean.experiment.settings.stage_one, clean.experiment.settings.stage_two
    assert b.outward(b.prior) == one.prior and b.lower < 0.01 * one.prior
    assert beta.outward(beta.prior) == pytest.approx(two.prior)


def test_every_record_may_err_in_time_by_a_little(clean):
    limit = POLICY.timing * clean.experiment.dt
    free = {f.name: f for f in timing_free(clean.experiment)}
    assert set(free) == {"command_delay.T", "position_delay.T", "pressure_delay.T"}
    assert all(f.upper == limit and f.prior == 0.0 for f in free.values())
    assert free["position_delay.T"].lower == -limit  # a late pump speed looks like it


def test_unknowns_are_tried_from_next_to_nothing(clean):
    small, large = limits_of(clean.experiment)
    assert small == smallest_unknowns(clean.experiment)
    assert (large.as_array() > 1e3 * small.as_array()).all()


def test_taking_an_effect_out_leaves_the_model_without_it(clean):
    entered = with_effect(clean.before, starts_of(
        "stribeck_friction", clean.experiment)[0], (1.0, 1.0))
    names = {f.name for f in entered.free} - {f.name for f in clean.before.free}
    assert names == {f"stribeck_friction.{p.name}"
                     for p in CATALOGUE["stribeck_friction"].parameters}
    assert entered.named == ("stribeck_friction",)
    left = without_effect(clean.experiment, entered, "stribeck_friction")
    assert left.named == () and np.array_equal(left.active, clean.before.active)
    assert left.free == clean.before.free and np.array_equal(left.theta, clean.before.theta)


def test_timing_of_every_record_is_free_until_it_is_named_and_again_after(clean):
    """A named delay takes the place of the small one and gives it back."""
    entered = with_effect(clean.before, starts_of("position_delay", clean.experiment)[0], (1.0,))
    assert [f.name for f in entered.free].count("position_delay.T") == 1
    assert entered.named == ("position_delay",)
    left = without_effect(clean.experiment, entered, "position_delay")
    assert {f.name for f in left.free} == {f.name for f in clean.before.free}
    assert np.array_equal(left.active, clean.before.active)


def test_a_size_enters_no_nearer_to_nothing_than_it_shows(clean):
    start = starts_of("quadratic_friction", clean.experiment)[0]
    (size,) = own_sizes(start)
    whole = dict(start.values)[size.name]
    place = place_of(f"quadratic_friction.{size.name}")
    for amplitude, wanted in ((2.0, 2.0), (1e-6, LEAST_SHARE), (-1.0, LEAST_SHARE)):
        fit = with_effect(clean.before, start, (amplitude,))
        assert fit.theta[place] == pytest.approx(wanted * whole)


@pytest.mark.parametrize(("difference", "whole", "part"), [
    (5.0, 3.5, 3.5), (-5.0, 3.5, -3.5), (-1.0, 2.0, -1.0), (2.0, 2.0, 2.0)])
def test_a_law_is_written_within_its_limits_and_does_the_same(clean, difference, whole, part):
    theta = clean.experiment.theta.copy()
    f_c, d_f = (place_of(f"asymmetric_friction.{name}") for name in ("F_c", "dF"))
    theta[f_c], theta[d_f] = 2.0, difference
    keep_within(theta, ("coulomb_friction", "rig.mass", "asymmetric_friction"))
    assert (theta[f_c], theta[d_f]) == pytest.approx((whole, part))
    for way in (-1.0, 1.0):  # the law's own equation, friction takes power in both directions
        assert max(theta[f_c] + way * theta[d_f], 0.0) == pytest.approx(
            max(2.0 + way * difference, 0.0))


def test_a_time_that_is_not_resolved_is_the_end_of_its_range(clean):
    step = clean.experiment.dt / clean.experiment.steps
    for start in starts_of("line_dynamics", clean.experiment):
        (time,) = (f for f in free_of(start) if f.symbol == "T_l")
        assert time.lower >= step and at_bound(time, step) == (time.lower == step)


def test_every_start_is_within_the_bounds_of_its_effect(clean):
    for name in NAMES:
        if not possible(name, clean.experiment):
            continue
        starts = starts_of(name, clean.experiment)
        assert starts or name == "position_quantisation"  # it is told otherwise
        assert all(start.among == len(starts) for start in starts)
        for start in starts:
            for p in CATALOGUE[name].parameters:
                value = dict(start.values)[p.name]
                assert p.lower <= value <= p.upper or not np.isfinite(value), (name, p.name)


# ---- columns ------------------------------------------------------------------------------------


def test_numbers_of_the_rig_have_their_tolerance_as_prior(clean):
    free = {f.name: f for f in rig_free(clean.experiment)}
    assert {"rig.mass", "rig.charge_pressure", "rig.volume_1", "rig.leakage"} <= set(free)
    assert not {"rig.viscous_damping", "rig.bulk_modulus"} & set(free)
    tolerance = settings().rig.tolerance
    for name, f in free.items():
        key = name.removeprefix("rig.")
        assert f.outward(f.prior) == pytest.approx(getattr(clean.experiment.settings.rig, key))
        assert f.spread == pytest.approx(
            free["rig.mass"].spread * tolerance.log_spread(key) / tolerance.log_spread("mass"))
        assert f.lower < f.outward(f.prior) < f.upper


def test_a_column_is_what_the_innovations_do_for_a_prior_deviation(clean):
    """Against runs of the filter with the number moved either way, fine steps."""
    experiment, fit = clean.experiment, clean.before
    columns = columns_at(experiment, fit, unnamed=False)
    noise = experiment.noise[experiment.columns]
    counted = experiment.stretches[0].counted
    (present,) = runs_of(experiment, fit.theta, fit.active, fit.gains)
    assert np.array_equal(columns.values[0][:, :, 0], present)
    checked = 0
    for place, column in enumerate(columns.what):
        if column.owner != "" or column.name not in ("B", "beta_e", "rig.mass",
                                                     "rig.pump_displacement"):
            continue
        f, ends = column.free, []
        for sign in (1.0, -1.0):
            theta = fit.theta.copy()
            theta[f.place] = f.outward(f.inward(theta[f.place]) + sign * 1e-3)
            ends.append(runs_of(experiment, theta, fit.active, fit.gains)[0])
        wanted = ((ends[0] - ends[1]) * f.spread / 2e-3 / noise)[counted]
        found = (columns.values[0][:, :, 1 + place] / noise)[counted]
        assert np.linalg.norm(found - wanted) < 0.03 * np.linalg.norm(wanted), column.name
        checked += 1
    assert checked == 4


def test_every_suspect_has_its_columns(clean):
    columns = columns_at(clean.experiment, clean.before)
    owners = {c.owner for c in columns.what}
    assert {name for name in NAMES if possible(name, clean.experiment)
            and starts_of(name, clean.experiment)} <= owners
    assert {"force of v", "flow of dp", "intermittent_load", "rig.mass"} <= owners
    names = [c.name for c in columns.what if c.owner == ""]
    assert names[:2] == ["B", "beta_e"] and len(set(names)) == len(names)


# ---- what the linear guess promises -------------------------------------------------------------


@pytest.mark.parametrize(("effect", "strength"), [("spring_load", 0.004),
                                                  ("quadratic_friction", 0.02)])
def test_what_the_ranking_promises_is_what_the_refit_gains(effect, strength):
    """Small and linear in its size, with little left by either: the linear guess is all."""
    case = fitted(effect, told=False, strength=strength)
    experiment = case.experiment
    small = limits_of(experiment)[0].as_array()
    fit = with_unknowns(experiment, case.before, Unknowns(*small))
    columns = columns_at(experiment, fit)
    found = best_over(ranked_at(columns.what, (), grams_of(
        experiment, fit, columns.values, [fit.unknowns], columns.copies), POLICY))
    promised = next(one for one in found if one.names == {effect})
    none = next(one for one in found if not one.names)
    slopes = Slopes(experiment, fit, columns)
    bare, named = (polished(experiment, joined(experiment, fit, columns.what, one), slopes)
                   for one in (none, promised))
    gained = evidence_of(named) - evidence_of(bare)
    wanted = (promised.evidence - promised.prior) - (none.evidence - none.prior)
    assert 30.0 < wanted < 200.0
    assert gained == pytest.approx(wanted, rel=0.05)
    size = next(c for c in columns.what if c.owner == effect)
    value = placed(size, promised.amplitudes[columns.what.index(size)])
    assert named.value(size.name) == pytest.approx(value, abs=0.1 * named.stddev(size.name))
