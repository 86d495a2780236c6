"""The gates: what a cheap check refuses is no answer."""

from dataclasses import replace

import numpy as np
import pytest
from hold_parts.plant import Motion, Noise, Rig, recorded
from mismatch_tools import fitted

from eha_monitor.balances.baseline import baseline
from eha_monitor.mismatch.answer import as_configured, named_effect
from eha_monitor.mismatch.data.experiment import experiment_of
from eha_monitor.mismatch.diagnosis import Gate, NamedEffect, SignalFit, Value
from eha_monitor.mismatch.likelihood.along import filtered_tracks
from eha_monitor.mismatch.likelihood.fit import Free
from eha_monitor.mismatch.likelihood.gains import smallest_unknowns
from eha_monitor.mismatch.name.columns import rig_free
from eha_monitor.mismatch.name.finalists import not_needed, without_along
from eha_monitor.mismatch.name.gates import at_bound, ends_of_tolerance, failures, too_small
from eha_monitor.mismatch.name.naming import Naming
from eha_monitor.mismatch.name.nominal import nominal, with_rig
from eha_monitor.mismatch.name.posterior import Refits, refused_evidence
from eha_monitor.mismatch.name.refit import settled, wide
from eha_monitor.mismatch.name.starts import starts_of, with_effect
from eha_monitor.mismatch.policy import POLICY
from eha_monitor.mismatch.show.held_out import baseline_gates, shown, unseen_gates, without_answer
from eha_monitor.physics import signals as s
from eha_monitor.physics.parameters import place_of
from eha_monitor.settings import settings_from_tree


def moved(fit, **values):
    """Return a fit with parameters of effects set, ``effect__symbol=value``."""
    theta = fit.theta.copy()
    for name, value in values.items():
        theta[place_of(name.replace("__", "."))] = value
    return replace(fit, theta=theta)


def with_start(name, of="coulomb_friction"):
    """Return an experiment and its nominal fit with an effect entered at its start."""
    here = fitted(of, told=False)
    start = starts_of(name, here.experiment)[0]
    fit = with_effect(here.before, start, (1.0,) * 3)
    k = len(fit.free)
    return here.experiment, replace(fit, covariance=1e-30 * np.eye(k))


def gates_of(experiment, fit):
    return {(gate.gate, gate.what) for gate in failures(experiment, fit)}


def test_a_right_model_passes():
    here = fitted("coulomb_friction")
    assert failures(here.experiment, here.after) == []


@pytest.mark.parametrize("value", [2.0, -0.9])
def test_a_sensor_that_errs_to_the_end_of_its_range_is_refused(value):
    experiment, fit = with_start("pressure_scale")
    assert gates_of(experiment, fit) == set()
    assert gates_of(experiment, moved(fit, pressure_scale__k_1=value)) == {
        ("bound", "pressure_scale")}


def test_a_size_that_has_gone_to_nothing_is_refused():
    experiment, fit = with_start("coulomb_friction")
    for nothing in (0.0, 3e-77):
        assert gates_of(experiment, moved(fit, coulomb_friction__F_c=nothing)) == {
            ("bound", "coulomb_friction"), ("member", "coulomb_friction")}


@pytest.mark.parametrize("deviations, refused", [(2.5, True), (3.5, False)])
def test_a_member_that_may_as_well_be_absent_is_refused(deviations, refused):
    experiment, fit = with_start("coulomb_friction")
    i = [f.name for f in fit.free].index("coulomb_friction.F_c")
    covariance = np.eye(len(fit.free)) * 1e-30
    covariance[i, i] = (40.0 / deviations) ** 2
    there = replace(moved(fit, coulomb_friction__F_c=40.0), covariance=covariance)
    assert (("member", "coulomb_friction") in gates_of(experiment, there)) == refused


@pytest.mark.parametrize("falls, refused", [(2.0, True), (40.0, False)])
def test_a_law_that_adds_nothing_surely_to_a_simpler_one_is_refused(falls, refused):
    """Its own size is sure; what it has beyond Coulomb friction is not."""
    experiment, fit = with_start("stribeck_friction")
    covariance = np.eye(len(fit.free)) * 1e-30
    i = [f.name for f in fit.free].index("stribeck_friction.F_d")
    covariance[i, i] = 4.0**2
    there = replace(moved(fit, stribeck_friction__F_c=40.0, stribeck_friction__F_d=falls),
                    covariance=covariance)
    assert (("added", "stribeck_friction") in gates_of(experiment, there)) == refused
    assert ("member", "stribeck_friction") not in gates_of(experiment, there)


@pytest.mark.parametrize("concealed", ["anti_cavitation", "coulomb_friction"])
def test_a_member_with_a_threshold_is_refused_where_a_refit_without_it_is_no_worse(concealed):
    """How far off nil its conductance is, no deviation says: beyond some it is all the same."""
    here = fitted(concealed, motion="rich", told=concealed == "anti_cavitation")
    fit = here.after
    if concealed != "anti_cavitation":
        fit = with_effect(fit, starts_of("anti_cavitation", here.experiment)[0], (1.0,))
        fit = settled(here.experiment, fit)
    wide_open = np.eye(len(fit.free)) * 1e-30
    i = [f.name for f in fit.free].index("anti_cavitation.k")
    wide_open[i, i] = fit.theta[place_of("anti_cavitation.k")] ** 2 + 1e-30
    fit = replace(fit, covariance=wide_open)
    refits, names = Refits(here.experiment.policy), frozenset(fit.named)
    refits.add(here.experiment, names, fit)
    failed = [one for one in failures(here.experiment, fit) if one.what == "anti_cavitation"]
    assert failed and {one.gate for one in failed} <= {"member", "bound"}
    left = not_needed(here.experiment, refits, names, failed)
    assert (left == []) == (concealed == "anti_cavitation")


def test_sizes_of_which_only_a_combination_is_known_say_so():
    experiment, fit = with_start("pressure_offset")
    tracks, said = filtered_tracks(experiment, fit), []
    for stddev in (1.0, 1e6):  # Pa
        there = replace(fit, covariance=stddev**2 * np.eye(len(fit.free)))
        naming = Naming(experiment, there, there, evidence={"pressure_offset": 1.0})
        said.append(named_effect(experiment, naming, "pressure_offset", tracks).statement)
    assert "combination" not in said[0]
    assert said[1].startswith(said[0]) and "each alone is ± 1" in said[1]


def test_a_shape_without_length_is_no_failure():
    experiment, fit = with_start("coulomb_friction")
    assert gates_of(experiment, moved(fit, coulomb_friction__z_0=0.0)) == set()


def test_friction_that_would_drive_the_piston_is_refused():
    experiment, fit = with_start("asymmetric_friction")
    names = {"asymmetric_friction__F_c": 40.0, "asymmetric_friction__dB": 0.0}
    assert gates_of(experiment, moved(fit, asymmetric_friction__dF=30.0, **names)) == set()
    for way in (80.0, -80.0):
        assert ("sign", "asymmetric_friction") in gates_of(
            experiment, moved(fit, asymmetric_friction__dF=way, **names))


def test_a_better_fit_of_a_refused_set_is_judged_anew():
    here = fitted("coulomb_friction")
    refits, names = Refits(here.experiment.policy), frozenset(here.after.named)
    worse = moved(here.after, coulomb_friction__F_c=0.0)
    refits.add(here.experiment, names, replace(
        worse, log_likelihood=here.after.log_likelihood - 1000.0))
    refits.refused[names] = tuple(failures(here.experiment, worse))
    assert refits.refused[names]
    refits.add(here.experiment, names, here.after)
    assert not refits.refused and refits.fits[names] is here.after


def test_a_leak_that_flows_uphill_is_refused_beyond_its_noise():
    experiment, fit = with_start("cross_port_leakage")
    negative = moved(fit, cross_port_leakage__L=-1e-11)  # the config's own leak is 5e-13
    assert gates_of(experiment, negative) == {("sign", "cross_port_leakage")}
    uncertain = np.eye(len(fit.free)) * 1e-30
    i = [f.name for f in fit.free].index("cross_port_leakage.L")
    uncertain[i, i] = (2e-11) ** 2
    assert gates_of(experiment, replace(negative, covariance=uncertain)) == {
        ("member", "cross_port_leakage")}  # it may be none at all


def test_a_number_of_the_rig_off_by_a_thousand_is_refused():
    here = fitted("coulomb_friction", told=False)
    own = wide(next(f for f in rig_free(here.experiment)
                    if f.name == "rig.makeup_conductance"), POLICY)
    for value in (own.lower, own.upper):
        theta = here.before.theta.copy()
        theta[own.place] = value
        fit = replace(here.before, theta=theta, free=(*here.before.free, own), named=(own.name,),
                      covariance=np.eye(len(here.before.free) + 1))
        assert gates_of(here.experiment, fit) == {("bound", own.name)}
        assert not ends_of_tolerance(fit)


def test_numbers_at_the_end_of_their_tolerance_are_noticed():
    here = fitted("coulomb_friction", told=False)
    fit = with_rig(here.experiment, here.before)
    assert ends_of_tolerance(fit) == []
    own = next(f for f in fit.free if f.name == "rig.makeup_conductance")
    theta = fit.theta.copy()
    theta[own.place] = own.upper
    assert ends_of_tolerance(replace(fit, theta=theta)) == [own]


def test_a_bound_is_a_bound_in_the_fitted_coordinate():
    log = Free("rig.leakage", 0, 1e-15, 1e-9, np.log(1e-12), 2.0, True)
    assert at_bound(log, 1e-15) and at_bound(log, 1e-9)
    assert not at_bound(log, 2e-15)  # of the range it is a millionth, of the logarithm a tenth


def test_what_vanishes_takes_the_others_along_the_covariance():
    """The mean of a normal distribution given one coordinate, against sampling."""
    here = fitted("coulomb_friction")
    fit = here.after
    names = [f.name for f in fit.free]
    i = names.index("coulomb_friction.F_c")
    theta = without_along(fit, "coulomb_friction")
    rng = np.random.default_rng(2)
    draws = rng.multivariate_normal(np.zeros(len(names)), fit.covariance, 200_000)
    slope = draws.T @ draws[:, i] / (draws[:, i] @ draws[:, i])  # regression on F_c
    step = -fit.value("coulomb_friction.F_c")
    for name in ("B", "beta_e"):
        j = names.index(name)
        f = fit.free[j]
        expected = f.outward(f.inward(fit.theta[f.place]) + slope[j] * step)
        assert theta[f.place] == pytest.approx(expected, rel=0.02)


def signal(before, after, size=1.0, noise=0.01):
    return SignalFit("m", before, after, noise, signal_rms=size)


def test_an_error_that_grows_by_two_per_cent_of_its_signal_is_refused():
    assert not unseen_gates({"position": signal(0.5, 0.3), "pressure_1": signal(0.1, 0.1)}, POLICY)
    failed = unseen_gates(
        {"position": signal(0.5, 0.3), "pressure_1": signal(0.067, 0.153)}, POLICY)
    assert [(gate.gate, gate.what) for gate in failed] == [("unseen_error", "pressure_1")]
    assert "67 mm to 153 mm" in failed[0].statement


def test_errors_that_grow_together_are_refused_and_nothing_known_is_not():
    failed = unseen_gates(
        {"position": signal(0.10, 0.115), "pressure_1": signal(0.02, 0.02)}, POLICY)
    assert [gate.what for gate in failed] == ["all signals"]
    nothing = {"force": SignalFit("N", float("nan"), float("nan"), float("nan"))}
    assert not unseen_gates(nothing, POLICY)


def test_without_an_answer_the_nominal_model_is_shown():
    shown = without_answer({"position": signal(0.5, 0.3)})["position"]
    assert shown.after_rms == shown.before_rms == 0.5


@pytest.mark.parametrize("gained, counts", [(-5.0, -5.0), (30.0, 0.0), (500.0, 495.0)])
def test_what_a_refused_set_gains_counts_beyond_the_form_of_the_laws(gained, counts):
    """The answer explains 1000 log units, of which its laws may have 50 wrong."""
    refits, best, other = Refits(POLICY), frozenset({"pump_dead_zone"}), frozenset({"added_mass"})
    refits.evidence = {frozenset(): -1000.0, best: 0.0, other: gained}
    refits.left = dict.fromkeys(refits.evidence, 0.0)
    refits.refused[other] = (Gate("bound", "added_mass", "at the end of its range"),)
    assert refused_evidence(refits) == {other: pytest.approx(counts)}


def test_what_does_less_than_a_right_model_may_leave_is_no_effect():
    """0.06 N in 276 N was presliding friction at 93 % on a healthy rig of another's equations."""
    experiment, fit = with_start("coulomb_friction")
    limit = POLICY.few * smallest_unknowns(experiment).force
    assert limit == pytest.approx(1.5e-3 * experiment.ranges.force)
    assert too_small(experiment, moved(fit, coulomb_friction__F_c=0.9 * limit)) == (
        "coulomb_friction",)
    assert too_small(experiment, moved(fit, coulomb_friction__F_c=1.1 * limit)) == ()
    refits, small = Refits(POLICY), moved(fit, coulomb_friction__F_c=0.9 * limit)
    refits.add(experiment, frozenset(small.named), small)
    assert not refits.evidence and set(refits.stations) == {frozenset(small.named)}


def test_what_adds_no_force_and_no_flow_has_a_size_of_its_own():
    experiment, fit = with_start("pressure_scale")
    assert too_small(experiment, moved(fit, pressure_scale__k_1=1e-9)) == ()


@pytest.mark.parametrize(("written", "same"), [
    ({"F_c": 60.0, "F_d": 15.0}, True), ({"F_c": 61.5, "F_d": 15.0}, True),
    ({"F_c": 60.0, "F_d": 12.0}, True), ({"F_c": 50.0, "F_d": 15.0}, False),
    ({"F_c": 60.0}, False), ({}, False)])
def test_an_effect_of_the_config_that_is_as_it_says_is_no_mismatch(written, same):
    """F_d is 1.8 N unsure; F_c to 5 %, the form error of laws."""
    experiment = fitted("coulomb_friction", told=False).experiment
    effects = {"stribeck_friction": {**written, "v_s": 0.01}} if written else {}
    experiment = replace(experiment, settings=experiment.settings.model_copy(
        update={"effects": effects}))
    found = NamedEffect("stribeck_friction", "force", "", {
        "F_c": Value(59.7, 0.4, "N"), "F_d": Value(15.3, 1.8, "N"),
        "v_s": Value(0.02, 1e-4, "m/s"), "z_0": Value(2.5e-5, 4e-7, "m")}, 2124.0)
    assert as_configured(experiment, found) is same


def test_a_mass_that_noise_makes_small_refuses_no_right_model():
    """In slow motion M a is noise: a regression leaves less with less mass than there is."""
    rig, noise = Rig(), Noise(position=8e-6)
    recording = recorded(rig, Motion((("triangle", 8.0, 0.003, 0.25),)), 1e-3, False, noise=noise)
    settings = settings_from_tree(rig.config(1e-3, noise), "test")
    experiment, fit = nominal(experiment_of([recording], settings))
    first = baseline(recording, settings)
    assert first.force["M"].value < 0.8 * rig.mass
    force = shown(experiment, fit, fit)["force"]
    assert baseline_gates(experiment, [first], fit, force) == ()
    # B is another's: the mass is no excuse for that.
    theta = fit.theta.copy()
    theta[s.B] *= 1.5
    worse = replace(fit, theta=theta)
    (gate,) = baseline_gates(experiment, [first], worse, shown(experiment, fit, worse)["force"])
    assert gate.gate == "unseen_error"
