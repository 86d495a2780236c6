"""The rules by which effects are named, and the threshold of chance."""

import json
from dataclasses import replace

import numpy as np
import pytest
from eha_monitor.mismatch.choice import (
    FAMILY_SHARE,
    FORM_SHARE,
    NEGLIGIBLE,
    Naming,
    choose,
    demanded_gain,
    material,
    prune,
)
from eha_monitor.mismatch.contest import slack_of
from mismatch_tools import fitted
from scipy.stats import gumbel_r

from eha_monitor.mismatch import calibrate as calibrating
from eha_monitor.mismatch.diagnose import EXPLAINED, verdict_of
from eha_monitor.mismatch.likelihood.fit import with_unknowns
from eha_monitor.mismatch.likelihood.gains import Unknowns, expected_covariance
from eha_monitor.mismatch.likelihood.simulated import Calibration, calibrate, read, simulated
from eha_monitor.mismatch.name.base import (
    Candidate,
    Round,
    completed,
    enters_alone,
    expected_likelihood,
    first_fit,
    limits_of,
    settle,
    shortlist,
    ways_of,
    with_effect,
    without_effect,
)
from eha_monitor.mismatch.name.starts import screen, starts_of
from eha_monitor.mismatch.show.model import config_effects
from eha_monitor.physics.effects import CATALOGUE, NAMES
from eha_monitor.physics.parameters import place_of, theta_of
from eha_monitor.settings.load import settings_from_tree

THRESHOLD = 12.0


@pytest.fixture(scope="module")
def clean():
    return fitted()


def candidate(clean, name: str, gain: float, amplitude: float = 5.0) -> Candidate:
    """An effect at some times its start that is said to gain so much."""
    start = starts_of(name, clean.experiment)[0]
    fit = with_effect(clean.before, start, (amplitude,) * len(CATALOGUE[name].sizes))
    return Candidate(start, fit, gain)


def chosen(clean, *candidates, before=None):
    found = Round(before or clean.before, (), tuple(sorted(candidates, key=lambda c: -c.gain)))
    taken, rivals = choose(clean.experiment, found, clean.before, THRESHOLD)
    return (taken.effect if taken else None), set(rivals)


# ---- one round's choice ------------------------------------------------------------------------


def test_nothing_is_named_below_the_threshold(clean):
    assert chosen(clean) == (None, set())
    assert chosen(clean, candidate(clean, "spring_load", 11.9)) == (None, set())
    assert chosen(clean, candidate(clean, "spring_load", 12.0)) == ("spring_load", set())


def test_the_best_is_taken_and_what_is_far_behind_is_no_rival(clean):
    assert chosen(clean, candidate(clean, "quadratic_friction", 100.0),
                  candidate(clean, "spring_load", 93.9)) == ("quadratic_friction", set())


def test_of_what_cannot_be_told_apart_the_commoner_is_taken(clean):
    """Backlash is rare, Coulomb friction is not; 6 log units part nothing."""
    few = candidate(clean, "backlash", 100.0), candidate(clean, "coulomb_friction", 94.5)
    assert chosen(clean, *few) == ("coulomb_friction", {"backlash"})


def test_of_equally_common_ones_the_one_with_fewer_numbers_is_taken(clean):
    few = candidate(clean, "quadratic_friction", 95.0), candidate(clean, "relief_valve", 100.0)
    assert chosen(clean, *few) == ("quadratic_friction", {"relief_valve"})


def test_what_contains_the_one_taken_is_not_its_rival(clean):
    few = candidate(clean, "coulomb_friction", 96.0), candidate(clean, "stribeck_friction", 100.0)
    assert chosen(clean, *few) == ("coulomb_friction", set())


def test_what_cannot_be_told_from_one_that_matters_matters_too(clean):
    """The same flow of leakage: a line of little, or a step that is smoothed into that line."""
    line = candidate(clean, "cross_port_leakage", 100.0, amplitude=0.5 * NEGLIGIBLE)
    assert chosen(clean, line) == (None, set())
    assert chosen(clean, line, candidate(clean, "leakage_offset", 97.0)) == (
        "cross_port_leakage", {"leakage_offset"})
    gain_of_pump = candidate(clean, "pump_flow_gain", 80.0)
    assert chosen(clean, line, gain_of_pump) == ("cross_port_leakage", set())
    assert chosen(clean, line, replace(gain_of_pump, gain=60.0)) == ("pump_flow_gain", set())


@pytest.mark.parametrize("gain, slack", [(0.0, 6.0), (100.0, 6.0), (2000.0, 6.0), (1e5, 300.0)])
def test_slack_grows_with_the_evidence(gain, slack):
    assert slack_of(gain) == pytest.approx(slack)


def test_an_effect_of_no_size_is_not_named_however_significant(clean):
    """A tenth of a start is a thousandth of what the balance does."""
    tiny = candidate(clean, "spring_load", 5e3, amplitude=0.5 * NEGLIGIBLE)
    assert not material(clean.experiment, tiny.fit, "spring_load")
    assert chosen(clean, tiny) == (None, set())
    assert chosen(clean, tiny, candidate(clean, "constant_load", 50.0)) == ("constant_load", set())
    one_of_two = candidate(clean, "asymmetric_friction", 50.0, amplitude=0.5 * NEGLIGIBLE)
    theta = one_of_two.fit.theta
    theta[place_of("asymmetric_friction.dF")] *= 10
    assert material(clean.experiment, one_of_two.fit, "asymmetric_friction")


def test_a_limit_that_was_reached_matters(clean):
    assert material(clean.experiment, candidate(clean, "drive_saturation", 50.0).fit,
                    "drive_saturation")


def test_beside_large_effects_more_is_demanded_and_most_within_a_family(clean):
    first = clean.before
    named = candidate(clean, "coulomb_friction", 0.0).fit
    for sofar in (10.0, 1e4, 1e5):
        fit = replace(named, log_likelihood=first.log_likelihood + sofar)
        assert demanded_gain(fit, first, "spring_load", THRESHOLD) == pytest.approx(
            max(THRESHOLD, FORM_SHARE * sofar))
        assert demanded_gain(fit, first, "pressure_friction", THRESHOLD) == pytest.approx(
            max(THRESHOLD, FAMILY_SHARE * sofar))
    assert demanded_gain(first, first, "pressure_friction", THRESHOLD) == THRESHOLD
    later = replace(named, log_likelihood=first.log_likelihood + 1e4)
    pair = candidate(clean, "spring_load", 120.0), candidate(clean, "pressure_friction", 400.0)
    assert chosen(clean, *pair, before=later) == ("spring_load", set())


def test_a_richer_form_waits_for_what_it_contains():
    assert enters_alone("coulomb_friction") and enters_alone("presliding_friction")
    assert not enters_alone("stribeck_friction") and not enters_alone("asymmetric_friction")
    assert all(enters_alone(name) for name in NAMES if not CATALOGUE[name].contains)


def test_shortlist_keeps_two_starts_of_each_of_the_best(clean):
    scores = screen(clean.experiment, clean.before, [
        start for name in ("relief_valve", "stribeck_friction", "spring_load")
        for start in starts_of(name, clean.experiment)])
    assert [s.gain for s in scores] == sorted((s.gain for s in scores), reverse=True)
    kept = shortlist(scores, 2)
    names = [score.start.effect for score in kept]
    best = list(dict.fromkeys(score.start.effect for score in scores))[:2]
    assert set(names) == set(best) and max(names.count(name) for name in names) <= 2


# ---- in and out --------------------------------------------------------------------------------


def test_a_mass_that_takes_the_ringing_out_of_step_is_scored_near_zero():
    """2.5 % of mass moves the phase by a radian at the end of a reversal's ringing."""
    case = fitted("added_mass", motion="triangle", told=False, strength=0.17)
    (score,) = screen(case.experiment, case.before, starts_of("added_mass", case.experiment))
    start = dict(score.start.values)["dM"]
    assert score.gain > 30.0
    assert score.amplitudes[0] * start == pytest.approx(1.0, abs=0.3)  # kg


def test_where_unknowns_took_what_is_missing_the_filter_leans_on_the_model_first(clean):
    small = limits_of(clean.experiment)[0].as_array()
    loose = with_unknowns(clean.experiment, clean.before, Unknowns(1000.0 * small[0], *small[1:]))
    first, second = ways_of(clean.experiment, loose)
    assert second is loose
    assert (first.unknowns.as_array() <= 30.0 * small * (1 + 1e-9)).all()
    held = replace(clean.experiment, largest_unknown=100.0)
    assert ways_of(held, loose) == [loose]
    stiff = with_unknowns(clean.experiment, clean.before, Unknowns(*small))
    assert ways_of(clean.experiment, stiff) == [stiff]


def test_taking_an_effect_out_leaves_the_model_without_it(clean):
    entered = completed(with_effect(clean.before, starts_of(
        "stribeck_friction", clean.experiment)[0], (1.0, 1.0), whole=False))
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


def test_what_another_has_made_superfluous_is_taken_out():
    case = fitted("coulomb_friction")
    start = starts_of("spring_load", case.experiment)[0]
    both = settle(case.experiment, with_effect(case.after, start, (0.1,)), 1)
    fit, evidence = prune(case.experiment, both, case.before, THRESHOLD)
    assert fit.named == ("coulomb_friction",) and set(evidence) == {"coulomb_friction"}
    assert evidence["coulomb_friction"] == pytest.approx(
        fit.log_likelihood - case.before.log_likelihood, rel=0.02)


def test_pruning_nothing_is_nothing(clean):
    fit, evidence = prune(clean.experiment, clean.before, clean.before, THRESHOLD)
    assert fit is clean.before and evidence == {}


# ---- the threshold of chance -------------------------------------------------------------------


@pytest.fixture(scope="module")
def calibrated(clean, tmp_path_factory):
    """Three clean draws, kept in a folder of their own."""
    folder = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(calibrating, "CACHE", folder / "numba-of-this-source")
        told = []
        result = calibrate(clean.experiment, clean.before, 3,
                           lambda text, share: told.append(share))
        yield folder, result, told


def test_threshold_is_the_gumbel_tail_of_what_chance_gains(calibrated):
    _, result, told = calibrated
    assert len(result.gains) == 3 and sorted(told) == told and told[-1] == 1.0
    scale = max(np.std(result.gains) * np.sqrt(6) / np.pi, 1.0)
    law = gumbel_r(np.mean(result.gains) - np.euler_gamma * scale, scale)
    assert result.threshold >= 10.0
    assert result.threshold == pytest.approx(max(10.0, law.isf(0.002)), rel=1e-3)


def test_calibration_is_kept_and_read_and_a_broken_one_ignored(calibrated, clean):
    folder, result, _ = calibrated
    path, = (folder / "calibration").glob("*.json")

    def again():
        told = []
        return calibrate(clean.experiment, clean.before, 3,
                         lambda text, share: told.append(share)), told

    assert again() == (result, [])  # read: nothing was run
    tree = json.loads(path.read_text())
    path.write_text(json.dumps({**tree, "threshold": 77.0}))
    assert again()[0].threshold == 77.0  # it is the file that was read
    for broken in ("", "{", "[]", "null", '{"threshold": null}',
                   '{"threshold": 20, "gains": 3, "per_sample": 1}'):
        path.write_text(broken)
        assert read(path) is None
    assert again()[0] == result and json.loads(path.read_text()) == tree
    assert read(folder / "absent.json") is None


def test_another_motion_or_rig_has_a_calibration_of_its_own(clean):
    key = calibrating.fingerprint(clean.experiment, clean.before, 3)
    stretch = clean.experiment.stretches[0]
    moved = clean.experiment.only((replace(stretch, u=stretch.u * 1.5),))
    noisier = replace(clean.experiment, noise=2 * clean.experiment.noise)
    others = [calibrating.fingerprint(e, clean.before, n)
              for e, n in ((moved, 3), (noisier, 3), (clean.experiment, 4))]
    assert len({key, *others}) == 4
    assert key == calibrating.fingerprint(replace(clean.experiment), clean.before, 3)


def test_a_clean_draw_is_clean(calibrated, clean):
    """One that calibration has not seen: the same noise, and nothing to be found."""
    _, result, _ = calibrated
    drawn = simulated(clean.experiment, clean.before, 99)
    before, after = clean.experiment.stretches[0], drawn.stretches[0]
    assert np.array_equal(np.isfinite(after.z), np.isfinite(before.z))
    assert np.array_equal(after.u, before.u)
    fit = first_fit(drawn)
    starts = [s for name in NAMES for s in starts_of(name, drawn)
              if CATALOGUE[name].balance in ("force", "flow")]
    assert screen(drawn, fit, starts)[0].gain < result.threshold
    assert fit.value("B") == pytest.approx(clean.before.value("B"), rel=0.02)
    assert fit.log_likelihood / len(fit.e) == pytest.approx(result.per_sample, abs=0.1)


# ---- the verdict -------------------------------------------------------------------------------


def verdict(clean, named=(), taken=0.0, floor=1e4, unknown=1.0):
    """Verdict where a right model would gain ``floor`` and the named ones gain ``taken``."""
    before = clean.before
    small = limits_of(clean.experiment)[0].as_array()
    after = replace(before, named=tuple(named), log_likelihood=before.log_likelihood + taken,
                    unknowns=type(before.unknowns)(*(unknown * small)))
    floor = (before.log_likelihood + floor) / len(before.e)
    return verdict_of(clean.experiment, Naming(before, after, (), {}, {}),
                      Calibration(THRESHOLD, (), floor))


def test_names_that_take_the_evidence_away_are_a_mismatch(clean):
    named = ("coulomb_friction",)
    assert verdict(clean, named, 9990.0) == ("mismatch", pytest.approx(0.999))
    assert verdict(clean, named, 1e4 * EXPLAINED + 1)[0] == "mismatch"
    assert verdict(clean, named, 1e4 * EXPLAINED - 1)[0] == "unexplained"
    assert verdict(clean, named, 2e4) == ("mismatch", 1.0)  # better than chance expects


@pytest.mark.parametrize("factor", [1.0, 300.0])
def test_a_filter_expects_the_innovations_that_it_has(clean, factor):
    small = limits_of(clean.experiment)[0].as_array()
    unknowns = type(clean.before.unknowns)(factor * small[0], *small[1:])
    fit = with_unknowns(clean.experiment, clean.before, unknowns)
    expected = np.diag(expected_covariance(clean.experiment, fit.theta, fit.active, unknowns,
                                           fit.gains))
    had = np.diag(fit.s) / expected
    if factor == 1.0:
        assert had == pytest.approx(1.0, abs=0.1)
    else:  # it is prepared for an unknown force that is not there
        assert had.max() < 1.02 and had.min() < 0.9


def left_over(clean, needed=900.0, still=1.0, gain=0.0, found=("coulomb_friction",), wrong=1.0):
    """Verdict where half of the evidence is left, after an unknown force fell to ``still``."""
    small = limits_of(clean.experiment)[0].as_array()
    unknowns = type(clean.before.unknowns)
    before = replace(clean.before, unknowns=unknowns(needed * small[0], *small[1:]))
    after = with_unknowns(clean.experiment, clean.before,
                          unknowns(still * small[0], *small[1:]))
    after = replace(after, named=("coulomb_friction",), s=wrong * after.s,
                    log_likelihood=before.log_likelihood + 5e3)
    last = Round(replace(after, named=found), (), (candidate(clean, "spring_load", gain),))
    floor = (before.log_likelihood + 1e4) / len(before.e)
    return verdict_of(clean.experiment, Naming(before, after, (last,), {}, {}),
                      Calibration(THRESHOLD, (), floor))[0]


def test_evidence_that_is_left_over_by_a_small_unknown_is_a_names_error_of_form(clean):
    assert left_over(clean) == "mismatch"
    assert left_over(clean, still=190.0) == "unexplained"  # a fifth of 900 is 180
    assert left_over(clean, needed=90.0) == "unexplained"  # none was needed
    assert left_over(clean, gain=501.0) == "unexplained"  # another effect has a claim
    assert left_over(clean, found=()) == "unexplained"  # nobody asked whether one has
    assert left_over(clean, wrong=2.0) == "unexplained"  # that is no unknown force


def test_without_names_an_unknown_that_matters_is_unexplained(clean):
    assert verdict(clean, unknown=1.0) == ("consistent", 0.0)
    assert verdict(clean, unknown=99.0)[0] == "consistent"  # below 1 % of what a balance does
    assert verdict(clean, unknown=101.0)[0] == "unexplained"
    assert verdict(clean, floor=10.0, unknown=101.0)[0] == "consistent"  # as good as the noise


def test_expected_likelihood_is_that_of_the_sensors_noise(clean):
    """A draw of pure sensor noise has it on average."""
    experiment = clean.experiment
    rng = np.random.default_rng(0)
    noise = experiment.noise[experiment.columns]
    e = rng.standard_normal(clean.before.e.shape) * noise
    from eha_monitor.mismatch.likelihood.fit import log_likelihood_of

    assert expected_likelihood(experiment, clean.before) == pytest.approx(
        log_likelihood_of(e), abs=5 * np.sqrt(e.size))


# ---- the model as a config ---------------------------------------------------------------------


def test_named_physics_goes_through_a_config_and_explains_the_record():
    case = fitted("coulomb_friction")
    found = config_effects(case.experiment, case.after, ("coulomb_friction",))
    assert set(found) == {"coulomb_friction"}
    assert config_effects(case.experiment, case.after, ()) == {}
    tree = json.loads(json.dumps({**case.experiment.settings.model_dump(mode="json"),
                                  "effects": found}))
    again = settings_from_tree(tree, "written")
    theta, active = theta_of(again.rig, again.effects)
    for p in CATALOGUE["coulomb_friction"].parameters:
        place = place_of(f"coulomb_friction.{p.name}")
        assert theta[place] == pytest.approx(case.after.theta[place], rel=1e-9, abs=1e-15)
    assert active[NAMES.index("coulomb_friction")]


def test_a_model_that_is_known_explains_the_record_as_well_as_when_it_was_found():
    case = fitted("coulomb_friction")
    effects = config_effects(case.experiment, case.after, ("coulomb_friction",))
    config = case.experiment.settings.model_copy(update={"effects": effects})
    theta, active = theta_of(config.rig, config.effects)
    known = replace(case.experiment, settings=config, theta=theta, active=active)
    explained = first_fit(known)
    assert explained.named == ()
    assert explained.log_likelihood > case.before.log_likelihood + 0.98 * (
        case.after.log_likelihood - case.before.log_likelihood)
    assert explained.value("B") == pytest.approx(600.0, rel=0.02)
