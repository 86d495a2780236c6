"""The live test of the model: a mismatch that comes, is told, and goes; and offline the same."""

import pytest
from machine_tools import A_1, A_2, stranger
from rig_tools import BETA, CHIRP, MULTISINE, SINE, TRIANGLE, settings, simulated
from test_live_estimator import Stream, rows_of

from eha_monitor.api.estimate import answer, judged
from eha_monitor.estimation.pipeline import estimate
from eha_monitor.health.alarms import AlarmBoard


def friction(start, end=None, force=40.0):
    faults = {"on": {"parameter": "coulomb_friction.F_c", "start": start, "value": force}}
    if end is not None:
        faults["off"] = {"parameter": "coulomb_friction.F_c", "start": end, "value": -force}
    return faults


def history_of_alarms(stream, **config):
    board = AlarmBoard(settings(**config))
    for snapshot in stream.history:
        board.update(snapshot.time_s, snapshot.parameters, None, snapshot.model.tainted)
    return [(a.word, round(a.time_s, 1)) for a in board.history
            if a.name == "viscous_damping_high"]


@pytest.fixture(scope="module")
def coming_and_going():
    made = Stream()
    made.push(rows_of(simulated(SINE, 24.0, faults=friction(4.0, 8.0)).recording(0)))
    return made


def test_a_mismatch_is_told_within_seconds_and_ends_when_the_record_fits(coming_and_going):
    history = coming_and_going.history
    standing = [s.time_s for s in history if any(m.stage == "one" for m in s.model.mismatches)]
    assert 4.0 < standing[0] < 7.5
    assert 18.0 < standing[-1] < 21.5  # a window of 10 s that fits, and 2 s more
    since = {round(m.since_s, 1) for s in history for m in s.model.mismatches
             if m.stage == "one"}
    assert since <= {4.0, 4.1, 4.2}
    end = history[-1]
    assert end.model.status == "consistent" and end.model.tainted == {}
    assert end.parameters["B"].value == pytest.approx(600, rel=0.01)
    assert end.parameters["beta_e"].value == pytest.approx(BETA, rel=0.02)
    assert coming_and_going.told("the model fits again since t = ")


def test_while_it_stands_no_alarm_is_raised_unless_asked_for(coming_and_going):
    worst = max(s.parameters["B"].value for s in coming_and_going.history
                if s.parameters["B"].status == "converged")
    assert worst > 1200  # beyond the limit of WARN
    words = [word for word, _ in history_of_alarms(coming_and_going)]
    assert set(words) == {"STALE", "OK", "not judged"}
    assert words[:4] == ["STALE", "not judged", "OK", "not judged"] and words[-1] == "OK"
    ignoring = history_of_alarms(coming_and_going, monitor={"on_mismatch": "ignore"})
    assert "WARN" in [level for level, _ in ignoring]


def test_at_a_triangle_the_misread_damping_waits_for_the_reversal():
    made = Stream()
    made.push(rows_of(simulated(TRIANGLE, 11.0, faults=friction(4.5)).recording(0)))
    assert made.history[-1].parameters["B"].value > 1500
    assert made.history[-1].model.tainted["B"].testing is False
    words = [word for word, _ in history_of_alarms(made)]
    assert words[:4] == ["STALE", "not judged", "OK", "not judged"]
    assert set(words) == set(words[:3])


@pytest.mark.parametrize("seed", [0, 2])
def test_a_model_that_nothing_has_tested_raises_no_alarm(seed):
    """At 100 Hz the first whole window comes late; ERROR stood at 8 s, the mismatch came later.

    The truth, 1500 N·s/m that fall to 1275, is above the limit of WARN (1200) and below that of
    ERROR; least squares find it beside the fall of the friction.
    """
    made = Stream(rig={"area_1": A_1, "area_2": A_2, "volume_1": 2e-4, "volume_2": 2e-4,
                       "mass": 60.0, "pump_displacement": None, "position_gain": None,
                       "sample_time": 1e-2}, effects={"constant_load": {"F_0": 338.0}})
    made.push(rows_of(stranger(seed, dt=1e-2, seconds=25.0)))
    worst = max(s.parameters["B"].value for s in made.history
                if s.parameters["B"].status == "converged")
    assert worst > 4000  # beside 180 N of dry friction
    assert {word for word, _ in history_of_alarms(made)} <= {"STALE", "OK", "not judged", "WARN"}
    judged = [taint.instead for s in made.history
              if (taint := s.model.tainted.get("B")) is not None and taint.instead is not None]
    assert judged and all(1275.0 < one.value < 1500.0 for one in judged)
    assert made.history[-1].model.mismatches


@pytest.mark.parametrize("shape, duration, value", [(SINE, 0.0, 1300.0), (SINE, 12.0, 1300.0)])
def test_wear_is_no_mismatch_and_alarms(shape, duration, value):
    fault = {"wear": {"parameter": "viscous_damping", "start": 3.0, "duration": duration,
                      "value": value}}
    made = Stream()
    made.push(rows_of(simulated(shape, 8.0 + duration, faults=fault).recording(0)))
    assert not any(s.model.mismatches for s in made.history)
    levels = history_of_alarms(made)
    assert levels[-1][0] == "WARN"
    assert levels[-1][1] < 3.0 + duration + 4.0


def test_a_flow_that_is_missing_taints_the_modulus_alone():
    fault = {"dead": {"parameter": "pump_dead_zone.omega_0", "start": 4.0, "value": 8.0}}
    made = Stream()
    end = made.push(rows_of(simulated(MULTISINE, 8.0, faults=fault).recording(0)))
    assert [m.stage for m in end.model.mismatches] == ["two"]
    assert set(end.model.tainted) == {"beta_e"}
    assert "flow balance, drive or a sensor" in end.model.tainted["beta_e"].reason
    assert end.parameters["B"].value == pytest.approx(600, rel=0.01)


def test_offline_the_answer_says_what_is_tainted_and_holds_its_alarms():
    recording = simulated(MULTISINE, 8.0, effects={"coulomb_friction": {"F_c": 40.0}})
    recording = recording.recording(0)
    found = estimate(recording, settings())
    alarms, history = judged(found)
    tree = answer(found, alarms, history)["model"]
    assert tree["status"] == "mismatch"
    assert tree["mismatches"][0]["stage"] == "one" and tree["mismatches"][0]["since_s"] < 0.5
    assert tree["tainted"]["B"]["reason"].startswith("the model does not fit since t = ")
    assert found.by_stages["B"].value > 1500
    assert not any(a.raised for a in history if a.name == "viscous_damping_high")
    # By the filter alone it must be seen, and is no judgement.
    assert [(a.level, a.not_judged) for a in history
            if a.name == "viscous_damping_high" and a.time_s < 4.9][-1] == ("WARN", True)
    assert (alarms[0].level, alarms[0].not_judged) == ("OK", False)
    assert "does not fit" in alarms[0].message
    alarms, _ = judged(estimate(recording, settings(monitor={"on_mismatch": "ignore"})))
    assert alarms[0].level == "ERROR"
    known = estimate(recording, settings(effects={"coulomb_friction": {"F_c": 40.0}}))
    assert known.model.tainted == {} and known.model.mismatches == ()


LITTLE = {"coulomb_friction": {"F_c": 3.0}}


@pytest.mark.parametrize("damping, word", [(1296.0, "WARN"), (2000.0, "ERROR"), (600.0, "OK")])
def test_a_misfit_too_small_to_matter_holds_nothing_back(damping, word):
    """3 N of dry friction move B by 100 here; B 1296 against 1000 was held for 16 s."""
    run = simulated(CHIRP, 12.0, rig={"viscous_damping": damping}, effects=LITTLE)
    recording = run.recording(0)
    made = Stream()
    made.push(rows_of(recording))
    assert [m.stage for m in made.history[-1].model.mismatches][:1] == ["one"]
    assert history_of_alarms(made)[-1][0] == word
    found = estimate(recording, settings())
    assert found.model.status == "mismatch"
    assert judged(found)[0][0].word == word


def test_a_soft_oil_alarms_though_a_little_is_missing_in_the_flow():
    """beta_e 237 MPa, far below 400, stood as OK for 20 s."""
    run = simulated({**MULTISINE, "frequency_end": 30.0}, 12.0, rig={"bulk_modulus": 2.37e8},
                    effects={"cross_port_leakage": {"L": 2e-13}})
    recording = run.recording(0)
    made = Stream()
    made.push(rows_of(recording))
    assert "two" in [m.stage for m in made.history[-1].model.mismatches]
    board = AlarmBoard(settings())
    for snapshot in made.history:
        board.update(snapshot.time_s, snapshot.parameters, None, snapshot.model.tainted)
    assert board.alarms[3].raised, board.alarms[3].message
    found = estimate(recording, settings())
    assert judged(found)[0][3].raised, judged(found)[0][3].message
