"""How sets become proposals, scores and probabilities."""


from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mismatch_tools import case_of, diagnosed, fitted, recorded
from rig_tools import MULTISINE, simulated

from eha_monitor.concealed.cases import Case
from eha_monitor.mismatch.data.experiment import experiment_of
from eha_monitor.mismatch.likelihood.fit import remade, with_unknowns
from eha_monitor.mismatch.name.candidates import log_prior
from eha_monitor.mismatch.name.columns import rig_free
from eha_monitor.mismatch.name.finalists import finish, lesser, without_each
from eha_monitor.mismatch.name.naming import in_place_of
from eha_monitor.mismatch.name.nominal import lacks, nominal_model, resolved_nominal, with_rig
from eha_monitor.mismatch.name.posterior import Refits, posterior
from eha_monitor.mismatch.name.posterior import counted as counted_by
from eha_monitor.mismatch.name.proposals import (
    HANDFUL,
    Linearised,
    beyond_one_law,
    contested,
    levels_of,
    proposals_of,
)
from eha_monitor.mismatch.name.rank import Member, Ranked
from eha_monitor.mismatch.name.refit import (
    Slopes,
    discrepancy,
    evidence_of,
    informed,
    polished,
    settled,
    unfitted,
    wide,
)
from eha_monitor.mismatch.name.select import (
    Manner,
    Search,
    afresh,
    far_off,
    next_place,
    unbent,
)
from eha_monitor.mismatch.name.starts import starts_of, with_effect
from eha_monitor.mismatch.policy import POLICY
from eha_monitor.physics.parameters import place_of


def counted(left):
    return counted_by(left, POLICY)



def ranked(evidence: float, *names: str, prior: float = 0.0) -> Ranked:
    return Ranked(tuple(Member(name, 0) for name in sorted(names)), evidence, prior, None, {})


HARDLY = ranked(0.1, "pump_dead_zone")  # there are always some that gain next to nothing


def names_of(found: list[Ranked]) -> list[set[str]]:
    return [set(one.names) for one in found]


# ---- evidence that counts -----------------------------------------------------------------------


@given(st.floats(0.0, 1e7), st.floats(0.0, 1e5))
def test_what_is_left_counts_in_full_near_the_noise_and_less_above_it(left, more):
    assert counted(0.0) == 0.0 == counted(-5.0)
    assert -left * (1 + 1e-9) <= counted(left) <= 0.0  # never more than it is
    assert counted(left + more) <= counted(left)  # a worse model never counts for better
    # The same gain counts for more, the nearer to the noise.
    assert counted(left) - counted(left + more) <= -counted(more) + 1e-9


def test_a_few_log_units_near_the_noise_are_what_they_are():
    assert counted(3.0) == pytest.approx(-3.0, rel=0.02)
    taken_of_much = counted(1e4) - counted(1e5)
    assert taken_of_much < 0.01 * (1e5 - 1e4)


# ---- proposals ----------------------------------------------------------------------------------


def test_the_smallest_sets_that_reach_most_of_the_best_gain_are_refitted():
    found = [ranked(1000.0, "constant_load", "spring_load", "relief_valve"),
             ranked(995.0, "constant_load", "spring_load"),
             ranked(980.0, "constant_load", "drive_lag"),
             ranked(700.0, "constant_load"), ranked(0.0)]
    assert names_of(proposals_of(found, found[-1], refits_of({(): 0.0}))) == [
        {"constant_load"}, {"constant_load", "spring_load"}, {"constant_load", "drive_lag"}]
    found[3] = ranked(400.0, "constant_load")  # promises less than half
    assert names_of(proposals_of(found, found[-1], refits_of({(): 0.0}))) == [
        {"constant_load", "spring_load"}, {"constant_load", "drive_lag"}]


def test_nothing_is_proposed_where_nothing_is_better():
    found = [ranked(10.0, "constant_load"), ranked(5.0, "spring_load")]
    assert proposals_of(found, found[0], refits_of({(): 0.0})) == []


def test_what_contains_a_proposal_waits_for_it():
    found = [ranked(100.0, "stribeck_friction"), ranked(99.0, "coulomb_friction"),
             ranked(98.0, "constant_load"), HARDLY, ranked(0.0)]
    assert names_of(proposals_of(found, found[-1], refits_of({(): 0.0}))) == [
        {"coulomb_friction"}, {"constant_load"}]


def test_what_was_refitted_is_not_proposed_again():
    refits = refits_of({(): 0.0})
    refits.tried.add((frozenset(), frozenset({"constant_load"})))
    found = [ranked(100.0, "constant_load"), ranked(99.0, "spring_load"),
             ranked(98.5, "constant_load", "drive_lag"), HARDLY, ranked(0.0)]
    assert names_of(proposals_of(found, found[-1], refits)) == [{"spring_load"}]
    refits.tried.add((frozenset(), frozenset({"spring_load"})))
    assert names_of(proposals_of(found, found[-1], refits)) == [{"constant_load", "drive_lag"}]


def test_what_was_fitted_from_elsewhere_is_fitted_again_where_the_guess_promises_more():
    found = [ranked(100.0, "constant_load"), HARDLY, ranked(0.0)]
    for known, again in ((99.0, []), (50.0, [{"constant_load"}])):
        refits = refits_of({(): 0.0, ("constant_load",): known})
        assert names_of(proposals_of(found, found[-1], refits)) == again


def test_sets_without_a_name_are_not_refitted_and_a_handful_is_enough():
    every = ("constant_load", "spring_load", "drive_lag", "drive_gain", "added_mass",
             "relief_valve", "backlash")
    found = [ranked(101.0, "force of x"), *(ranked(100.0 - 0.1 * i, name)
                                            for i, name in enumerate(every)), HARDLY, ranked(0.0)]
    chosen = proposals_of(found, found[-1], refits_of({(): 0.0}))
    assert len(chosen) == HANDFUL and names_of(chosen)[0] == {"constant_load"}
    assert names_of(proposals_of(
        [ranked(9.0, "rig.mass"), ranked(0.0)], ranked(0.0), refits_of({(): 0.0}))) == [
        {"rig.mass"}]


# ---- fits ---------------------------------------------------------------------------------------


def test_a_clean_model_lacks_nothing_and_one_without_its_friction_much():
    clean, rubbing = fitted(), fitted("coulomb_friction")
    for case, fit in ((clean, clean.before), (rubbing, rubbing.after)):
        assert discrepancy(case.experiment, fit) < 100.0
    assert discrepancy(rubbing.experiment, rubbing.before) > 1000.0
    gained = evidence_of(rubbing.after) - evidence_of(rubbing.before)
    assert gained == pytest.approx(
        rubbing.after.log_likelihood - rubbing.before.log_likelihood, rel=0.05)


def test_the_evidence_of_a_useless_effect_is_lower():
    """A freedom costs what it could have told: Occam's factor."""
    clean = fitted()
    with_it = settled(clean.experiment, with_effect(
        clean.before, starts_of("constant_load", clean.experiment)[0], (0.01,)))
    assert with_it.log_likelihood > clean.before.log_likelihood - 1.0
    assert evidence_of(with_it) < evidence_of(clean.before)


def test_the_best_set_s_score_is_its_odds_where_nothing_is_left():
    rubbing = fitted("coulomb_friction")
    refits = Refits(POLICY)
    refits.add(rubbing.experiment, frozenset(), rubbing.before)
    refits.add(rubbing.experiment, frozenset({"coulomb_friction"}), rubbing.after)
    assert refits.best() == refits.ahead({})[0] == frozenset({"coulomb_friction"})
    scores = refits.scores()
    assert scores[frozenset({"coulomb_friction"})] <= log_prior(
        {"coulomb_friction"}, POLICY) + 1e-9
    assert scores[frozenset()] < scores[frozenset({"coulomb_friction"})] - 20.0
    worse = rubbing.before
    refits.add(rubbing.experiment, frozenset({"coulomb_friction"}), worse)
    assert refits.fits[frozenset({"coulomb_friction"})] is rubbing.after  # the better one is kept


def test_levels_go_from_the_present_unknowns_down_to_nothing():
    case = fitted("coulomb_friction")
    levels = [level.as_array() for level in levels_of(case.experiment, case.before)]
    now = case.before.unknowns.as_array()
    assert any(np.array_equal(level, now) for level in levels)
    assert all((level <= now * (1 + 1e-12)).all() for level in levels)
    assert len({tuple(level) for level in levels}) == len(levels)


def test_steps_resolve_the_damping_that_is_found():
    """Runge-Kutta runs away where B/M is large against a step; a fit would stop at that wall."""
    from rig_tools import MULTISINE, settings, simulated

    from eha_monitor.mismatch.data.experiment import experiment_of

    run = simulated(MULTISINE, 3.0, rig={"viscous_damping": 12000.0})
    given = settings(stage_one={"prior": 600.0})
    experiment = experiment_of([run.recording(0)], given)
    finer, fit = resolved_nominal(experiment)
    assert finer.steps >= experiment.steps
    assert fit.value("B") == pytest.approx(12000.0, rel=0.1)


def test_a_fit_without_a_member_stands_where_the_fit_with_it_stood():
    rubbing = fitted("coulomb_friction")
    bare = lesser(rubbing.experiment, rubbing.after, "coulomb_friction")
    assert bare.named == () and not any(f.name.startswith("coulomb") for f in bare.free)
    assert bare.value("B") == rubbing.after.value("B")
    assert lacks(rubbing.experiment, bare) and not lacks(rubbing.experiment, rubbing.after)

    clean = fitted()
    own = next(f for f in rig_free(clean.experiment) if f.name == "rig.volume_1")
    theta = clean.before.theta.copy()
    theta[own.place] *= 2.0
    wrong = replace(clean.before, theta=theta, free=(*clean.before.free, wide(own, POLICY)),
                    named=("rig.volume_1",))
    bare = lesser(clean.experiment, wrong, "rig.volume_1")
    assert bare.named == () and own in bare.free
    # What the member hid may be another number's: all of them are free, each once.
    assert sorted(f.name for f in bare.free if f.name.startswith("rig.")) == sorted(
        f.name for f in rig_free(clean.experiment))
    assert bare.value("rig.volume_1") == own.upper  # no further than its tolerance allows


def test_a_second_law_of_a_family_counts_beyond_the_form_error_of_the_first():
    rest, one = ranked(-1000.0), ranked(0.0, "leakage_offset")  # explains 1000: 50 are form
    def second(evidence, here=frozenset()):
        two = ranked(evidence, "leakage_offset", "turbulent_leakage")
        found = beyond_one_law([two, one, rest], frozenset(here), POLICY.law)
        return next(item.evidence for item in found if len(item.names) == 2)

    assert second(40.0) == 0.0
    assert 0.0 < second(100.0) < 100.0
    assert second(900.0) == pytest.approx(900.0, rel=0.01)
    assert second(40.0, {"leakage_offset", "turbulent_leakage"}) == 40.0  # what is there stays
    beside = ranked(30.0, "leakage_offset", "coulomb_friction")
    found = beyond_one_law([beside, one, rest], frozenset(), POLICY.law)
    assert beside in found  # of another family


def test_two_families_are_each_judged_by_themselves():
    refits = Refits(POLICY)
    refits.evidence.update({
        frozenset(): -2000.0, frozenset({"leakage_offset"}): -1000.0,
        frozenset({"coulomb_friction"}): -1000.0,
        frozenset({"leakage_offset", "coulomb_friction"}): 0.0,
        frozenset({"leakage_offset", "turbulent_leakage", "coulomb_friction"}): 20.0,
        frozenset({"leakage_offset", "stribeck_friction", "coulomb_friction"}): 20.0})
    refits.left.update(dict.fromkeys(refits.evidence, 0.0))
    assert refits.best() == {"leakage_offset", "coulomb_friction"}


def test_a_rig_within_its_tolerances_is_no_reason_to_go_astray():
    """With B and beta_e alone this ended at a hundredth of the stiffness."""
    case = Case("test", (), motion="triangle", seed=11, nominal={
        "M": 21.4, "A": 5.04e-4, "V": 7.4e-5, "C_T": 1.1e-12, "D_p": 1.75e-7})
    recording, settings = recorded(case)
    found = nominal_model(experiment_of([recording.part(0, 12_000)], settings), within=True)
    assert found.value("beta_e") == pytest.approx(6e8, rel=0.3)


def test_a_number_of_the_rig_that_is_an_effects_equation_stays_at_the_configs():
    clean = fitted()
    start = starts_of("added_mass", clean.experiment)[0]
    heavier = with_effect(clean.before, start, (1.0,))
    names = {f.name for f in with_rig(clean.experiment, heavier).free}
    assert "rig.mass" not in names and "rig.pump_displacement" in names


def test_a_set_of_nothing_that_moves_asks_for_no_number_of_the_rig():
    """A linear guess of a set may leave nothing: its places are none, and no floats."""
    experiment = fitted("coulomb_friction", told=False).experiment
    nothing = SimpleNamespace(amplitudes={}, gram=SimpleNamespace(products=np.ones((1, 1))))
    assert informed(experiment, (), nothing) == []


def test_a_model_in_which_two_parameters_are_one_is_no_model_and_no_breakdown():
    clean = fitted()
    loose = replace(clean.before.free[0], prior=clean.before.value("B"), spread=1e30)
    twice = replace(clean.before, free=(loose, replace(loose, name="again")),
                    covariance=np.zeros((2, 2)))
    made = polished(clean.experiment, twice, Slopes(clean.experiment), steps=1)
    assert made.log_likelihood == -np.inf or np.isfinite(made.covariance).all()


def test_a_line_that_is_half_as_slow_again_is_carried_to_its_optimum():
    """Whole steps fail on the way.  From 1.7 on the last bit decides in which valley it ends."""
    ringing = fitted("line_dynamics")
    theta = ringing.after.theta.copy()
    theta[place_of("line_dynamics.T_l")] *= 1.5
    start = remade(ringing.experiment, ringing.after, theta=theta)
    made = polished(ringing.experiment, start, Slopes(ringing.experiment), 80)
    assert start.log_likelihood < ringing.after.log_likelihood - 5_000
    assert made.log_likelihood > ringing.after.log_likelihood - 10


def test_that_nothing_is_missing_is_never_judged_by_half_a_fit():
    clean = fitted()
    refits = Refits(POLICY)
    half = polished(clean.experiment, with_rig(clean.experiment, unfitted(clean.experiment)),
                    Slopes(clean.experiment), 1)
    other = settled(clean.experiment, with_rig(clean.experiment, with_effect(
        clean.before, starts_of("quadratic_friction", clean.experiment)[0], ())))
    refits.add(clean.experiment, frozenset(), half)
    refits.add(clean.experiment, frozenset(other.named), other)
    assert refits.best()
    finish(clean.experiment, refits)
    assert refits.fits[frozenset()].converged and not refits.best()


def test_each_member_of_the_best_set_is_taken_away_once():
    rubbing = fitted("coulomb_friction")
    refits = Refits(POLICY)
    refits.add(rubbing.experiment, frozenset(), rubbing.before)
    alone = settled(rubbing.experiment, with_rig(rubbing.experiment, rubbing.after))
    both = settled(rubbing.experiment, with_effect(
        alone, starts_of("constant_load", rubbing.experiment)[0], (0.01,)))
    refits.add(rubbing.experiment, frozenset(both.named), both)
    assert refits.best() == {"coulomb_friction", "constant_load"}
    without_each(rubbing.experiment, refits)
    assert refits.best() == {"coulomb_friction"}  # a load of nothing is no member
    assert refits.evidence[frozenset({"coulomb_friction"})] == pytest.approx(
        evidence_of(alone), abs=1.0)


def test_a_number_known_to_a_factor_is_tried_far_off_only_where_something_is_lacking():
    clean = fitted()
    search = Search(clean.experiment, clean.before)
    assert far_off(search) is None
    assert unbent(search) is None


def test_the_config_s_own_place_is_looked_at_where_friction_has_bent_the_first_fit():
    rubbing = fitted("coulomb_friction")
    start = unbent(Search(rubbing.experiment, rubbing.before))
    assert start is not None and start.value("B") < rubbing.before.value("B")
    assert start.value("B") == rubbing.experiment.theta[next(
        f.place for f in start.free if f.name == "B")]


def test_a_rival_that_is_far_behind_is_not_carried_further():
    rubbing = fitted("coulomb_friction")
    whole = settled(rubbing.experiment, rubbing.before)
    cut = settled(rubbing.experiment, rubbing.before, worth=np.inf)
    assert cut.log_likelihood <= whole.log_likelihood and np.isfinite(cut.log_likelihood)


# ---- probabilities ------------------------------------------------------------------------------


def refits_of(evidence: dict[tuple[str, ...], float]) -> Refits:
    """Refitted sets with so much evidence, and nothing left by the best."""
    refits = Refits(POLICY)
    for names, value in evidence.items():
        key = frozenset(names)
        refits.fits[key], refits.evidence[key], refits.left[key] = fitted().before, value, 0.0
    return refits


def test_probabilities_add_up_to_one_and_follow_the_evidence():
    refits = refits_of({("constant_load",): 100.0, ("spring_load",): 90.0, (): 0.0})
    weights = posterior(refits, [])
    assert sum(weights.values()) == pytest.approx(1.0)
    load, spring, none = (weights[frozenset(key)] for key in (
        ("constant_load",), ("spring_load",), ()))
    assert load > spring > none > 0.0


def test_sets_that_were_only_ranked_are_measured_from_the_best_model():
    best = ranked(50.0, "constant_load", prior=-5.0)
    other = ranked(49.0, "spring_load", prior=-5.0)
    promising = ranked(60.0, "drive_lag", prior=-5.0)  # better by the guess, and never refitted
    nameless = ranked(51.0, "force of x", prior=-7.0)
    refits = refits_of({("constant_load",): 100.0, (): 0.0})
    ranking = [promising, nameless, best, other]
    weights = posterior(refits, [(best.names, ranking)])
    load, spring, none = (weights[frozenset({name})] for name in (
        "constant_load", "spring_load", "force of x"))
    assert load > spring > 0.5 * load and none > 0.0
    assert frozenset({"drive_lag"}) not in weights
    weights = posterior(refits, [(best.names, ranking)], promising=True)
    assert weights[frozenset({"drive_lag"})] > 0.9 * weights[frozenset({"constant_load"})]


def test_what_stands_in_a_name_s_place_is_counted_beside_all_the_others():
    best = frozenset({"constant_load", "drive_lag"})
    weights = {best: 0.6, frozenset({"spring_load", "drive_lag"}): 0.3,
               frozenset({"spring_load"}): 0.05, frozenset({"drive_lag"}): 0.05}
    assert in_place_of("constant_load", best, weights) == {"spring_load": 0.3}
    assert in_place_of("drive_lag", best, weights) == {}


@pytest.mark.parametrize("gained, named", [(40.0, False), (4000.0, True)])
def test_a_square_beside_dry_friction_counts_beyond_its_form_error(gained, named):
    """The tail of a Stribeck drop is B with less of it and a square."""
    dry = frozenset({"stribeck_friction"})
    refits = refits_of({tuple(dry): 8000.0, ("quadratic_friction",): 100.0, (): 0.0,
                    ("stribeck_friction", "quadratic_friction"): 8000.0 + gained})
    assert (refits.best() != dry) is named


def test_friction_by_direction_stands_in_the_place_of_a_load_beside_dry_friction():
    load = frozenset({"coulomb_friction", "constant_load"})
    weights = {load: 0.6, frozenset({"asymmetric_friction"}): 0.4}
    assert in_place_of("constant_load", load, weights) == {"asymmetric_friction": 0.4}
    assert in_place_of("asymmetric_friction", frozenset({"asymmetric_friction"}), weights) == {
        "coulomb_friction": 0.6, "constant_load": 0.6}


# ---- where the search goes on -------------------------------------------------------------------


def test_laws_of_a_family_differ_by_more_than_its_form_error_or_are_rivals():
    """Of 1000 log units that Coulomb friction explains 50 are form: they leave a rival 5 %."""
    law, plain = frozenset({"stribeck_friction"}), frozenset({"coulomb_friction"})
    for gained in (-30.0, 10.0, 50.0, 200.0):
        best = 1000.0 + max(gained, 0.0)
        refits = refits_of({(): 0.0, ("coulomb_friction",): 1000.0,
                        ("stribeck_friction",): 1000.0 + gained})
        scores = refits.scores()
        apart = scores[law] - log_prior(law, POLICY) - scores[plain] + log_prior(plain, POLICY)
        assert apart == pytest.approx(gained * np.log(20.0) / (0.05 * best), rel=1e-9)
    other = refits_of({(): 0.0, ("constant_load",): 1000.0, ("spring_load",): 1030.0})
    scores = other.scores()
    assert scores[frozenset({"spring_load"})] - scores[frozenset({"constant_load"})] > 5.0


def test_a_second_law_of_a_family_beside_the_first_is_mostly_form_error():
    both, one = ("coulomb_friction", "pressure_friction"), ("coulomb_friction",)
    refits = refits_of({(): 0.0, one: 10000.0, both: 10100.0})
    assert refits.best() == frozenset(one)
    refits = refits_of({(): 0.0, one: 10000.0, both: 13000.0})
    assert refits.best() == frozenset(both)


def test_the_search_goes_where_it_has_not_been_and_stops():
    load, none = frozenset({"constant_load"}), frozenset()
    refits = refits_of({(): 0.0, ("constant_load",): 100.0})
    assert refits.ahead({})[0] == load
    assert refits.ahead({load: 100.0}) is None
    assert refits.ahead({load: 90.0})[0] == load  # it was fitted better since
    station = fitted().before
    refits.stations[frozenset({"spring_load"})] = station, 500.0
    assert refits.ahead({load: 100.0, none: 0.0}) == (frozenset({"spring_load"}), station)
    assert refits.best() == load  # what cannot be is no answer


def test_each_member_is_contested_by_what_comes_next_in_its_place():
    pair = ranked(200.0, "pressure_offset", "backlash")
    ranking = [pair, ranked(150.0, "pressure_scale", "backlash"),
               ranked(140.0, "constant_load", "backlash"), ranked(50.0, "backlash"),
               ranked(60.0, "pressure_offset"), ranked(90.0, "pressure_offset", "drive_lag")]
    view = Linearised(pair.names, None, (), None, [], ranking)
    assert names_of(contested(view)) == [{"pressure_scale", "backlash"}]  # a lag takes too little


def test_pressures_that_nobody_reads_have_the_ranges_of_the_filter():
    """A relief valve of a rig without pressure sensors is sought where the pressures are."""
    case = case_of()
    read, _ = recorded(case)
    bare, settings = recorded(replace(case, channels=("x", "x_d", "omega")))
    found = resolved_nominal(experiment_of([bare], settings))[0].ranges
    p1, p2 = read.channels["p1"], read.channels["p2"]
    assert found.pressure_difference == pytest.approx(np.quantile(
        np.abs(p1 - p2), [0.5, 0.9, 0.98, 0.998]), rel=0.2, abs=3e4)
    assert found.lowest_pressure == pytest.approx(np.quantile(
        np.minimum(p1, p2), [0.002, 0.02, 0.2]), rel=0.05)


def test_a_soft_seal_is_found_with_its_micro_damping():
    """The concealed LuGre seal has sigma_1 = 0.6 sqrt(sigma_0 M): t_1 = 3 ms, ten starts away."""
    soft = fitted("presliding_friction", motion="rich").after
    level, travel = 40.0, 50e-6
    damping = 0.6 * np.sqrt(20.0 * travel / level)
    for symbol, true in (("F_c", level), ("z_0", travel), ("t_1", damping)):
        assert soft.value(f"presliding_friction.{symbol}") == pytest.approx(true, rel=0.02)


def test_backlash_shows_where_the_pressures_are_the_input():
    """Position and two pressures alone: the sensor rests while the piston crosses the play."""
    found = diagnosed("backlash", channels=("x", "p1", "p2"))
    assert [one.name for one in found.effects] == ["backlash"]
    assert found.effects[0].parameters["b"].value == pytest.approx(200e-6, rel=0.02)
    assert found.effects[0].parameters["in_loop"].value == 0.0  # no loop that could tell


@pytest.mark.parametrize("found", [False, True])
def test_beside_closed_balances_a_round_that_gains_nothing_is_the_last(found):
    """What was found is gated; where nothing was, the nominal model is what stands."""
    case = fitted("coulomb_friction")
    search = Search(case.experiment, case.before, Manner(close=True))
    here, fit = next_place(search, 0)
    assert here == frozenset() and fit is case.before
    search.done[frozenset()] = search.refits.evidence[frozenset()]
    if found:  # an effect of which something is still lacking
        half = replace(case.after, log_likelihood=case.before.log_likelihood + 0.4 * (
            case.after.log_likelihood - case.before.log_likelihood), unknowns=case.before.unknowns)
        search.refits.add(case.experiment, frozenset(case.after.named), half, True)
        assert next_place(search, 1)[0] == frozenset(case.after.named)
        search.done[frozenset(case.after.named)] = max(search.refits.evidence.values())
    turn = 2 if found else 1
    place = next_place(search, turn)
    if place is not None:  # once from the config's own numbers, where the fit was bent
        assert turn == 1 and place[0] == frozenset() and place[1] is not case.before
        place = next_place(search, 2)
    assert place is None and search.vain is not found


def test_a_fit_that_broke_down_is_begun_again_from_the_config():
    """A position some samples late: under large unknowns the filter runs away."""
    run = simulated(MULTISINE, 3.0, effects={"position_delay": {"T": 0.007}})
    experiment = experiment_of([run.recording(1)], run.config.model_copy(update={"effects": {}}))
    start = replace(starts_of("position_delay", experiment)[0], values=(("T", 0.006),))
    loose = with_effect(unfitted(experiment, 100.0), start, ())
    broken = settled(experiment, with_unknowns(experiment, loose, loose.unknowns))
    assert not np.isfinite(broken.log_likelihood)
    found = afresh(experiment, broken)
    assert found.value("position_delay.T") == pytest.approx(0.007, rel=0.01)
    assert found.value("B") == pytest.approx(600.0, rel=0.01)
    other = replace(broken, named=("position_delay", "rig.mass"))
    assert afresh(experiment, other) is other
