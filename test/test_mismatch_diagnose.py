"""The diagnosis of short records from the concealed plant, whose equations are not the fit's."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from mismatch_tools import case_of, diagnosed, fitted, recorded
from rig_tools import MULTISINE, settings, simulated

from eha_monitor.api.diagnose import completed
from eha_monitor.balances.answer import Asked, first_answer
from eha_monitor.balances.policy import POLICY as OF_BALANCES
from eha_monitor.concealed.cases import Case
from eha_monitor.estimation.hold_choice import HoldDecision, other_hold, with_hold
from eha_monitor.estimation.pipeline import estimate
from eha_monitor.mismatch.answer import held_command, is_answer, verdict_of
from eha_monitor.mismatch.beside_balances import contradicted, explains_more
from eha_monitor.mismatch.data.experiment import experiment_of
from eha_monitor.mismatch.diagnose import diagnose, diagnose_and_name
from eha_monitor.mismatch.diagnosis import (
    VERDICTS,
    Diagnosis,
    RigFinding,
    SignalFit,
    Value,
    payload_sentences,
)
from eha_monitor.mismatch.holds import gained_under, late_as_held, nominal_of, searched
from eha_monitor.mismatch.name.before import informative, with_effects
from eha_monitor.mismatch.name.naming import Naming
from eha_monitor.mismatch.name.nominal import nominal
from eha_monitor.mismatch.name.refit import settled
from eha_monitor.mismatch.name.select import Manner, Search
from eha_monitor.mismatch.name.starts import starts_of, with_effect
from eha_monitor.mismatch.policy import POLICY
from eha_monitor.mismatch.show.held_out import unseen_gates
from eha_monitor.mismatch.show.model import rig_findings
from eha_monitor.physics.effects import CATALOGUE

DRY = {"coulomb_friction", "presliding_friction", "stribeck_friction", "pressure_friction",
       "asymmetric_friction"}


def sound(found: Diagnosis) -> Diagnosis:
    """Return a diagnosis after asserting what holds for every one."""
    assert found.verdict in VERDICTS and found.message
    total = sum(found.location.balance.values())
    assert total == pytest.approx(1.0) or (total == 0 and found.verdict in (
        "consistent", "insufficient_data"))
    stated = [*found.probability.values(), *(effect.probability for effect in found.effects),
              *(finding.probability for finding in found.rig_data)]
    assert all(0.0 <= p <= 1.0 + 1e-9 for p in stated)
    names = [effect.name for effect in found.effects]
    assert not any(set(names) & set(effect.indistinguishable_from) for effect in found.effects)
    for value in found.after.values():
        assert value.value > 0.0 and value.stddev > 0.0
    return found


def test_clean_record_is_consistent():
    recording, settings = recorded(case_of())
    told = []
    found = sound(diagnose([recording], settings,
                           progress=lambda text, share: told.append((text, share))))
    assert found.verdict == "consistent" and found.effects == () and found.config_effects == {}
    assert found.rig_data == () and found.probability["consistent"] > 0.5
    assert found.rig_within == ()
    assert found.after["B"].value == pytest.approx(600.0, rel=0.02)
    assert found.after["beta_e"].value == pytest.approx(6e8, rel=0.02)
    assert found.health == ()
    shares = [share for _, share in told]
    assert shares == sorted(shares) and shares[0] >= 0 and shares[-1] <= 1.0


def test_worn_clean_rig_is_consistent_and_its_wear_is_read():
    """What the monitor is there to find is no mismatch: B and beta_e differ from the config's."""
    found = sound(diagnosed(rig={"B": 900.0, "beta_e": 4.5e8}))
    assert found.verdict == "consistent" and found.effects == ()
    assert found.after["B"].value == pytest.approx(900.0, rel=0.02)
    assert found.after["beta_e"].value == pytest.approx(4.5e8, rel=0.02)


def test_coulomb_friction_is_named_and_b_is_freed_of_it(rubbing):
    found = sound(rubbing)
    assert found.verdict == "mismatch" and found.rig_data == ()
    first, *more = found.effects
    assert not more
    assert first.name == "coulomb_friction" or (
        first.name in DRY and "coulomb_friction" in first.indistinguishable_from)
    assert first.probability > 0.9
    assert set(first.indistinguishable_from) <= DRY
    assert found.location.balance["force"] > 0.6
    assert found.before["B"].value > 800.0
    assert found.after["B"].value == pytest.approx(600.0, rel=0.03)
    assert any("not wear" in sentence for sentence in found.health)
    assert found.signals["position"].after_rms < found.signals["position"].before_rms
    assert set(found.config_effects) == {first.name}
    assert first.name not in {one.name for one in found.considered}


@pytest.mark.slow
def test_a_second_motion_of_a_rig_with_dry_friction_begins_with_what_the_first_has_found():
    """What plans the next motion are the sets of a filter, also where least squares answer."""
    case = case_of("coulomb_friction", "drive_lag")
    (first, settings), (second, _) = (recorded(replace(case, seed=seed)) for seed in (3, 4))
    one = diagnose_and_name([first], settings)
    known = [fit for names, fit, _ in one.naming.tried if names]
    both = diagnose_and_name([first, second], settings, known=known)
    assert one.by_filter and both.by_filter
    for answer in (one, both):
        names = {effect.name for effect in answer.diagnosis.effects}
        assert "drive_lag" in names and len(names) == 2
    assert len(both.naming.experiment.stretches) == 2


def test_naming_a_force_leaves_the_bulk_modulus_as_it_is(rubbing):
    after = rubbing.after["beta_e"]
    assert after.value == pytest.approx(6e8, rel=0.02)
    assert abs(after.value - 6e8) < 3.0 * after.stddev


def test_pressure_offset_is_a_sensor_s_and_no_physics():
    found = sound(diagnosed("pressure_offset", options={"pressure_offset": {"sensor": "p1"}}))
    assert found.verdict == "mismatch"
    assert "pressure_offset" in {name for effect in found.effects
                                 for name in (effect.name, *effect.indistinguishable_from)}
    assert {effect.balance for effect in found.effects} == {"sensor"}
    assert max(found.location.balance, key=found.location.balance.get) == "sensor"


def test_drive_lag_is_the_drive_s():
    found = sound(diagnosed("drive_lag"))
    assert found.verdict == "mismatch" and [e.name for e in found.effects] == ["drive_lag"]
    assert found.location.balance["drive"] > 0.6
    lag = found.effects[0].parameters["tau"]
    assert lag.value > 0 and lag.stddev < 0.1 * lag.value


def test_what_no_entry_explains_is_said_to_be_unexplained_and_where_it_is(sticking):
    """A place in which the piston sticks: no such entry in the catalogue."""
    found = sound(sticking)
    assert found.verdict == "unexplained" and found.probability["unexplained"] > 0.5
    assert found.location.balance["force"] > 0.6
    assert found.config_effects == {}
    assert "not in the catalogue" in found.message


def test_what_is_unexplained_has_a_curve_in_its_balance(sticking):
    assert any(curve.balance == "force" for curve in sticking.curves)


def test_a_wrong_charge_pressure_is_a_number_of_the_rig_and_no_effect():
    """The issue: 3 bar where the config says 20 was told as a pressure offset."""
    found = sound(diagnosed(rig={"p_charge": 3e5}, nominal={"p_charge": 2e6}))
    assert found.verdict == "mismatch" and found.effects == ()
    (finding,) = found.rig_data
    assert finding.key == "charge_pressure" and finding.configured == 2e6
    assert finding.found.value == pytest.approx(3e5, rel=0.02)
    assert finding.probability > 0.9
    assert finding.statement.startswith("charge_pressure: the config says 2")
    assert finding.statement in found.message


def test_a_leakage_two_hundred_times_too_large_is_named():
    """Nothing is linear where the config stands; the search begins again far from there."""
    found = sound(diagnosed(rig={"C_T": 5e-13}, nominal={"C_T": 1e-10}))
    (finding,) = found.rig_data
    assert finding.key == "leakage" and found.effects == ()
    assert finding.found.value == pytest.approx(5e-13, abs=3.0 * finding.found.stddev)


def test_what_is_within_a_number_s_tolerance_is_no_mismatch():
    """A mass 5 % off: as well as an engineer knows it."""
    found = sound(diagnosed(nominal={"M": 21.0}))
    assert found.verdict == "consistent" and found.effects == () and found.rig_data == ()


def test_what_the_recording_knows_better_within_the_tolerance_is_told():
    """A pump that delivers 2.5 % less, its displacement known to 3 %: no mismatch, but news."""
    found = sound(diagnosed(rig={"D_p": 0.975 * 1.69e-7}, nominal={"D_p": 1.69e-7}))
    assert found.verdict == "consistent" and found.rig_data == ()
    (finding,) = [one for one in found.rig_within if one.key == "pump_displacement"]
    assert finding.configured == 1.69e-7
    assert abs(finding.found.value - 0.975 * 1.69e-7) < 3.0 * finding.found.stddev
    assert finding.statement.endswith("within its tolerance")


def test_standstill_is_insufficient_data():
    found = sound(diagnosed(demand=np.zeros(1500)))
    assert found.verdict == "insufficient_data" and found.effects == ()
    assert "too little motion to identify anything" in found.message
    assert found.before == {} and found.after == {}


# ---- the verdict from what was named, without a diagnosis ---------------------------------------


def test_the_verdict_is_what_is_more_likely_than_not():
    clean = fitted()
    named = replace(clean.before, named=("coulomb_friction",))

    def verdict(after=clean.before, wrong=(), unexplained=0.1):
        return verdict_of(Naming(clean.experiment, clean.before, after, wrong,
                                 unexplained=unexplained))

    assert verdict() == "consistent"
    assert verdict(named) == "mismatch"
    assert verdict(wrong=("mass",)) == "mismatch"
    assert verdict(named, unexplained=0.6) == verdict(unexplained=0.6) == "unexplained"
    assert verdict(named, unexplained=0.5) == "mismatch"


def test_a_name_stands_that_is_likely_or_has_a_place_that_nothing_leaves_empty():
    assert is_answer(0.6, 0.6, POLICY) and is_answer(np.nan, 0.0, POLICY)
    assert is_answer(0.4, 0.97, POLICY)  # one of many names for what is surely there
    assert not is_answer(0.4, 0.9, POLICY)


def test_a_fit_that_fails_on_unseen_data_is_worse():
    def fit(before, after):
        return SignalFit("m", before, after, 1e-6)

    assert not unseen_gates({"position": fit(2e-6, 2e-6)}, POLICY)
    assert not unseen_gates({"position": fit(2e-6, 2.01e-6)}, POLICY)  # chance
    assert unseen_gates({"position": fit(2e-6, 2.1e-6)}, POLICY)
    assert not unseen_gates({"position": fit(2e-6, 2.1e-6), "pressure_1": fit(9e-6, 1e-6)}, POLICY)
    no_noise = SignalFit("m", 1.0, 2.0, 0.0)  # nothing to measure it by
    assert not unseen_gates({"position": no_noise}, POLICY)


def test_a_wrong_number_is_told_with_both_values_the_most_certain_first():
    clean = fitted()
    fit = clean.before
    b, beta = fit.free[0], fit.free[1]
    free = (replace(b, name="rig.mass"), replace(beta, name="rig.charge_pressure"))
    after = replace(fit, free=free, covariance=fit.covariance[:2, :2],
                    named=("rig.mass", "rig.charge_pressure"))
    found = rig_findings(clean.experiment, Naming(
        clean.experiment, fit, after, ("mass", "charge_pressure"),
        {"rig.mass": 0.7, "rig.charge_pressure": 0.99}, rivals={"rig.mass": ("added_mass",)}))
    assert [one.key for one in found] == ["charge_pressure", "mass"]
    assert [one.configured for one in found] == [2e6, 20.0]
    assert found[1].indistinguishable_from == ("added_mass",) and found[1].found.unit == "kg"
    assert found[1].statement.startswith("mass: the config says 20 kg, the recording 600")


def gained(other, found):
    windows = informative(other)
    return gained_under(windows, nominal_of(windows), found)[0]


def test_a_hold_that_the_bare_model_contradicts_is_taken_back():
    """Play and a saturated drive looked like a hold, and under it nothing fitted any more."""
    recording, settings = recorded(case_of("drive_saturation"))
    flowing, held = (experiment_of([recording], with_hold(settings, hold))
                     for hold in ("continuous", "sampled"))
    under_hold, under_none = (nominal(made)[1] for made in (held, flowing))
    assert gained(flowing, under_hold) > 100.0
    assert gained(held, under_none) < -100.0
    assert other_hold(held.settings).command_hold == flowing.settings.command_hold


def test_a_set_is_compared_with_itself_under_the_other_hold():
    """A position that is read late looked like a hold; what it is fits far better without."""
    recording, settings = recorded(case_of("spring_load", "position_delay"))
    flowing, held = (experiment_of([recording], with_hold(settings, hold))
                     for hold in ("continuous", "sampled"))

    def fitted_with(experiment, *names):
        fit = nominal(experiment)[1]
        for name in names:
            fit = with_effect(fit, starts_of(name, experiment)[0], (1.0,))
        return settled(experiment, fit)

    assert gained(held, fitted_with(flowing, "spring_load", "position_delay")) < -100.0


def test_two_times_that_stand_for_a_hold_and_a_lag_are_told_so():
    """A held command behind a lag of a quarter of a sample read as two delays of one sample."""
    recording, settings = recorded(Case(
        "test", (("drive_lag", 0.06),), motion="short", seed=3, drive="digital_own"))
    flowing, held = (experiment_of([recording], with_hold(settings, hold))
                     for hold in ("continuous", "sampled"))
    fit = with_effects(flowing, nominal(flowing)[1], {"command_delay": {"T": 1e-3},
                                                      "feedback_delay": {"T": 1e-3}})
    more, best = gained_under(informative(held), nominal_of(informative(held)),
                              settled(flowing, fit))
    assert more > 100.0 and best.named == ("drive_lag",)
    (tau,) = [best.theta[f.place] for f in best.free if f.name == "drive_lag.tau"]
    assert tau == pytest.approx(2.4e-4, rel=0.05)


@pytest.mark.parametrize("hold", ["continuous", "sampled"])
def test_the_other_hold_is_asked_for_before_a_search_goes_on(hold):
    """What was found first is likelier without a hold: the search ends there, or never turns."""
    recording, settings = recorded(case_of("drive_saturation"))
    searches, ended = [], []

    def begin(experiment, may_end, elsewhere, known):
        searches.append(experiment.settings.command_hold)
        fit = nominal(experiment)[1]
        return experiment, SimpleNamespace(found=fit, doubtful=True, experiment=experiment)

    def name(search):
        ended.append(search.experiment.settings.command_hold)
        return Naming(search.experiment, search.found, search.found)

    def under(asked):
        return experiment_of([recording], asked, True)

    undecided = HoldDecision(hold, 5.0, False, "x_d")
    found = searched(under, with_hold(settings, hold), undecided, False, begin, name)
    assert ended == ["continuous"]
    assert searches == (["continuous"] if hold == "continuous" else [hold, "continuous"])
    assert found.followed and found.experiment.settings.command_hold == "continuous"
    assert found.decision.decided is (hold == "sampled")


def test_a_hold_that_was_decided_wrongly_ends_with_the_first_refits():
    """A search of 210 s lacked 3.4 log units a sample; the other hold, 2.9 better, took 15."""
    recording, settings = recorded(case_of("turbulent_leakage"))
    wrong = with_hold(settings, "sampled")
    decided, asked = HoldDecision("sampled", 41.0, True, "omega"), []

    def begin(experiment, may_end, elsewhere, known):
        sampled = experiment.settings.command_hold == "sampled"
        fit = nominal(experiment)[1]
        search = Search(experiment, fit, Manner(elsewhere=elsewhere))
        if sampled:
            search.leave()
        asked.append(experiment.settings.command_hold)
        return experiment, SimpleNamespace(found=fit, doubtful=False, experiment=experiment)

    def name(search):
        start = starts_of("turbulent_leakage", search.experiment)[0]
        return Naming(search.experiment, search.found, settled(
            search.experiment, with_effect(search.found, start, (1.0,))))

    def under(hold):
        made = experiment_of([recording], hold, True)
        return replace(made, policy=replace(made.policy, lacking=0.01))

    found = searched(under, wrong, decided, False, begin, name)
    assert asked == ["continuous"] and found.followed
    assert found.experiment.settings.command_hold == "continuous"


def test_laws_of_two_answers_are_compared_as_they_are_written():
    recording, settings = recorded(case_of("stribeck_friction"))
    first = first_answer([recording], settings, Asked())
    dry = first.config_effects
    assert first.verdict == "mismatch" and dry
    # Terms that correct the form of what least squares name are none of its laws.
    assert not explains_more(first, replace(first), [recording], settings)
    assert explains_more(first, replace(first, config_effects={}), [recording], settings)
    none = replace(first, config_effects={})
    assert not explains_more(none, first, [recording], settings)
    # Of a force that is hardly any of the whole, less than half of what the other leaves is more.
    small = replace(first, signals={"force": replace(first.signals["force"], signal_rms=1e6)})
    assert not explains_more(small, none, [recording], settings)
    assert explains_more(small, none, [recording], settings, OF_BALANCES.open)
    assert not explains_more(none, small, [recording], settings, OF_BALANCES.open)
    assert not explains_more(replace(first, signals={}), none, [recording], settings)


def test_a_number_of_the_force_that_least_squares_contradict_is_no_answer():
    """Scales of two pressure sensors stood for a load, with a B 59 deviations off."""
    recording, settings = recorded(case_of("constant_load"))
    first = first_answer([recording], settings, Asked())
    b, load = first.after["B"], first.effects[0]
    assert first.verdict == "mismatch" and load.name == "constant_load"

    def said(value, *effects):
        return replace(first, effects=effects, after={**first.after, "B": replace(
            b, value=value, stddev=1e-3 * value)})

    rig = settings.rig
    (gate,) = contradicted(first, said(1.3 * b.value), rig)
    assert gate.gate == "least_squares" and gate.what == "B"
    assert f"{b.value:.3g}"[:2] in gate.statement
    assert contradicted(first, said(b.value + 2.0 * b.stddev), rig) == ()
    # Of a load of another size both are told; least squares without an effect say nothing.
    larger = replace(load, parameters={"F_0": replace(
        load.parameters["F_0"], value=2.0 * load.parameters["F_0"].value)})
    assert [one.what for one in contradicted(first, said(b.value, larger), rig)] == ["F_0"]
    assert contradicted(replace(first, effects=()), said(1.3 * b.value), rig) == ()
    assert contradicted(first, replace(said(1.3 * b.value), verdict="unexplained"), rig) == ()
    # A mass of which a filter says nothing is the config's, within its tolerance.
    mass = replace(load, name="added_mass", parameters={
        "dM": Value(0.5 * rig.mass, 0.02 * rig.mass, "kg")})
    heavier = replace(first, effects=(load, mass))
    (gate,) = contradicted(heavier, said(b.value, load), rig)
    assert gate.what == "dM"
    known = RigFinding("mass", rig.mass, Value(1.48 * rig.mass, 0.02 * rig.mass, "kg"), 1.0, "")
    assert contradicted(heavier, replace(said(b.value, load), rig_data=(known,)), rig) == ()


def test_a_load_that_is_the_weight_of_the_mass_that_came_is_one_payload():
    recording, settings = recorded(case_of("constant_load"))
    load = first_answer([recording], settings, Asked()).effects[0]
    force = replace(load, parameters={"F_0": Value(1250.0, 10.0, "N")})
    config = settings.model_copy(update={
        "effects": {"constant_load": {"F_0": 269.3}}})  # 100 kg less
    finding = RigFinding("mass", 50.0, Value(153.0, 2.0, "kg"), 1.0, "")
    (sentence,) = payload_sentences((force,), (finding,), config)
    assert "100 kg" in sentence
    mass = replace(load, name="added_mass", parameters={"dM": Value(97.0, 2.0, "kg")})
    assert payload_sentences((force, mass), (), config) == (sentence,)
    assert payload_sentences((force, mass), (), settings) == ()  # 127 kg
    turning = config.model_copy(update={"rig": config.rig.model_copy(update={
        "motion": "rotary"})})
    assert payload_sentences((force, mass), (), turning) == ()
    assert payload_sentences((force,), (), config) == payload_sentences((mass,), (), config) == ()


@pytest.mark.parametrize(("effect", "samples", "held"), [
    ("position_delay", 0.5, True), ("command_delay", 0.52, True), ("command_delay", 0.8, False),
    ("position_delay", 2.0, False), ("pressure_delay", 0.5, False)])
def test_a_time_of_half_a_sample_may_be_a_hold(effect, samples, held):
    found = fitted(effect)
    theta, (delay,) = found.after.theta.copy(), [
        f for f in found.after.free if f.name == f"{effect}.T"]
    theta[delay.place] = samples * found.experiment.dt
    fit = replace(found.after, theta=theta)
    assert found.after.stddev(delay.name) < 0.05 * found.experiment.dt
    assert late_as_held(Naming(found.experiment, found.before, fit)) is held
    bare = Naming(found.experiment, found.before, replace(fit, named=()))
    assert not late_as_held(bare)


@pytest.mark.parametrize("name, late, stddev, held", [
    ("command_delay", 0.51e-3, 0.03e-3, True), ("feedback_delay", 0.55e-3, 0.03e-3, True),
    ("command_delay", 0.70e-3, 0.03e-3, False), ("position_delay", 0.50e-3, 0.03e-3, False),
    ("command_delay", 0.50e-3, 0.30e-3, False)])  # known no better, it may be anything
def test_a_delay_of_half_a_sample_may_be_a_digital_controller(name, late, stddev, held):
    said = held_command(name, {"T": Value(late, stddev, "s")}, 1e-3)
    assert ("holds its command" in said) == held


def configured(*effects, **config):
    """Diagnose a case of 6 s whose config has effects, SI."""
    recording, settings = recorded(case_of(*effects))
    return sound(diagnose([recording], settings.model_copy(update={"effects": config})))


def test_what_the_config_says_of_an_effect_may_be_a_little_wrong():
    """A lag 4 % off was an encoder that is late, and B 1 % off at 0.03 %, on a healthy machine."""
    found = configured("drive_lag", "spring_load", drive_lag={"tau": 4.16e-3},
                       spring_load={"k": 8.08e3, "x_0": 0.0})
    assert found.verdict == "consistent" and found.effects == () and found.rig_data == ()
    for name, true in (("B", 600.0), ("beta_e", 6e8)):
        one = found.after[name]
        assert abs(one.value - true) < 2.5 * one.stddev < 0.3 * true


def test_an_effect_of_the_config_that_has_grown_is_named_with_both_sizes():
    """A lag of 12 ms where the config has 0.4 was a gain, and two delays, with 98 %."""
    found = configured("drive_lag", drive_lag={"tau": 0.2e-3})
    (lag,) = found.effects
    assert lag.name == "drive_lag" and lag.probability > 0.9
    assert lag.parameters["tau"].value == pytest.approx(4e-3, rel=0.02)
    assert "200 µs" in found.message and found.rig_data == ()
    assert found.config_effects["drive_lag"]["tau"] == pytest.approx(4e-3, rel=0.02)


def test_friction_of_the_config_whose_law_is_another_gives_way():
    """Held beside what is named it was "213 N at speed rises by 728 N", where 457 N are bent."""
    sharp = {p.name: p.default for p in CATALOGUE["coulomb_friction"].parameters}
    recording, settings = recorded(case_of("presliding_friction"))
    few = {name: recording.channels[name] for name in ("x", "p1", "p2")}
    found = sound(diagnose(
        [replace(recording, channels=few)], settings.model_copy(
            update={"effects": {"coulomb_friction": sharp | {"F_c": 30.0}}})))
    (friction,) = found.effects
    assert friction.name == "presliding_friction" and "in place of the config's" in found.message
    assert friction.parameters["F_c"].value == pytest.approx(40.0, rel=0.03)
    assert friction.parameters["z_0"].value == pytest.approx(50e-6, rel=0.05)
    assert found.config_effects.keys() == {"presliding_friction"}
    # Beside the config's 30 N: not all of the friction was missing in B.
    assert found.before["B"].value < 600.0 + 0.6 * (
        diagnose([replace(recording, channels=few)], settings).before["B"].value - 600.0)


def test_a_config_within_its_tolerances_is_written_as_the_filters_need_it():
    """A pump that is 1 % off, known to 3 %: consistent, and stage two off by 276 times."""
    given = settings()
    pump = 1.01 * given.rig.pump_displacement
    recording = simulated({**MULTISINE, "frequency_end": 4.0}, 8.0,
                          rig={"pump_displacement": pump}).recording(0)
    found = diagnose([recording], given)
    assert found.verdict == "consistent"
    made, changed, _ = completed(found, given)
    assert made.rig.pump_displacement / made.rig.area_1 == pytest.approx(
        pump / given.rig.area_1, rel=2e-3)
    assert made.rig.area_1 == made.rig.area_2 and made.rig.volume_1 == made.rig.volume_2
    assert any(line.startswith("rig.pump_displacement") for line in changed)
    before, after = (estimate(recording, one).stage_two.consistency.nis for one in (given, made))
    assert after < 0.1 * before
