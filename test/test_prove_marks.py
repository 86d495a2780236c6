"""The marks of the concealed-effect trial, of answers made by hand; docs/proof.md defines them."""

import pytest

from eha_monitor.prove import score
from eha_monitor.prove.score import calibration_error, reliability_of
from eha_monitor.reports.proof_report import proof_page


def concealed(*effects, outside=()) -> dict:
    """Return a key's entry: (name, balance, parameters) each."""
    return {"case": "c1", "B": 600.0, "beta_e": 6e8, "motion": "rich", "noise": 1.0,
            "channels": ["x"], "effects": [
                {"name": name, "balance": balance, "strength": 1.0, "parameters": parameters,
                 "in_catalogue": name not in outside} for name, balance, parameters in effects]}


def said(*effects, verdict="mismatch", place="force", after=None) -> dict:
    """Return an answer: (name, balance, rivals, parameters) each."""
    return {"verdict": verdict, "location": {"balance": {place: 0.9} if place else {}},
            "message": "", "wall_s": 1.0, "effects": [
                {"name": name, "balance": balance, "indistinguishable_from": list(rivals),
                 "parameters": {k: {"value": v, "stddev": s, "unit": ""}
                                for k, (v, s) in parameters.items()}}
                for name, balance, rivals, parameters in effects],
            "parameters": {"after": {"B": {"value": 606.0, "stddev": 2.0},
                                     "beta_e": {"value": 6.3e8, "stddev": 2e7}}},
            "fit": {"signals": {"position": {"before_rms": 10e-6, "after_rms": after or 3e-6,
                                             "noise_rms": 2e-6}}}}


COULOMB = ("coulomb_friction", "force", {"F_c": 40.0})
DELAY = ("position_delay", "sensor", {"T": 2e-3})
OFFSET = ("pressure_offset", "sensor", {"b_1": 4e4, "b_2": 0.0})
HUMP = ("position_friction_hump", "force", {"F": 60.0})


@pytest.mark.parametrize(("truth", "answer", "exact", "within"), [
    ([], said(verdict="consistent", place=""), True, True),
    ([], said(verdict="unexplained"), False, False),
    ([], said(("spring_load", "force", (), {})), False, False),
    ([COULOMB], said(("coulomb_friction", "force", (), {})), True, True),
    ([COULOMB], said(("coulomb_friction", "force", ("a", "b", "c"), {})), True, True),
    ([COULOMB], said(("spring_load", "force", ("coulomb_friction", "b"), {})), False, True),
    ([COULOMB], said(("spring_load", "force", ("coulomb_friction", "b", "c"), {})), False, False),
    ([COULOMB], said(("pressure_friction", "force", (), {})), False, True),
    ([COULOMB, ("external_leakage", "flow", {})],  # the mean pressure moves
     said(("pressure_friction", "force", (), {}), ("external_leakage", "flow", (), {})),
     False, False),
    ([COULOMB], said(("coulomb_friction", "force", (), {}), ("spring_load", "force", (), {})),
     False, False),
    ([COULOMB], said(("coulomb_friction", "force", (), {}), verdict="unexplained"), False, False),
    ([COULOMB], said(verdict="consistent", place=""), False, False),
    ([COULOMB, DELAY], said(("coulomb_friction", "force", ("position_delay",), {})),
     False, False),  # one name stands for one effect
    ([COULOMB, DELAY], said(("drive_lag", "drive", ("position_delay",), {}),
                            ("coulomb_friction", "force", (), {})), False, True),
    ([HUMP], said(verdict="unexplained"), True, True),
    ([HUMP], said(verdict="unexplained", place="flow"), False, False),
    ([HUMP], said(("spring_load", "force", (), {}), verdict="unexplained"), False, True),
    ([HUMP], said(("spring_load", "force", (), {})), False, False),
])
def test_marks_of_a_case(truth, answer, exact, within):
    row = score.row_of(concealed(*truth, outside=("position_friction_hump",)), answer)
    assert (row["exact"], row["within_class"]) == (exact, within)


# Numbers of the rig, by hand.

def with_rig(truth: dict, **tolerances) -> dict:
    """Return a key's entry with config keys that are off by so many tolerances."""
    return {**truth, "rig_off": [{"key": key, "true": 1.0, "configured": 1.2, "tolerances": off}
                                 for key, off in tolerances.items()]}


def with_findings(answer: dict, *findings) -> dict:
    """Return an answer that says so of rig numbers: (key, rivals, probability) each."""
    return {**answer, "rig_data": [
        {"key": key, "configured": 1.2, "found": {"value": 1.01, "stddev": 0.01, "unit": ""},
         "probability": probability, "indistinguishable_from": list(rivals)}
        for key, rivals, probability in findings]}


ADDED = ("added_mass", "force", {"dM": 4.0})
NOTHING = said(verdict="consistent", place="")


@pytest.mark.parametrize(("effects", "off", "answer", "exact", "within"), [
    ([], {"mass": 4.0}, with_findings(said(), ("mass", (), 0.9)), True, True),
    ([], {"mass": -4.0}, said(("added_mass", "force", ("mass",), {})), False, True),
    ([], {"mass": 4.0}, said(("added_mass", "force", (), {})), False, False),
    ([], {"mass": 4.0}, with_findings(said(), ("leakage", (), 0.9)), False, False),
    ([], {"mass": 4.0}, with_findings(said(("spring_load", "force", (), {})),
                                      ("mass", (), 0.9)), False, False),
    ([], {"mass": 4.0}, NOTHING, False, False),
    # A pair is one number, however many of its keys are named.
    ([], {"area_1": 5.0, "area_2": 5.0}, with_findings(
        said(place="flow"), ("area_2", (), 0.9)), True, True),
    ([], {"area_1": 5.0, "area_2": 5.0}, with_findings(
        said(), ("area_1", (), 0.9), ("area_2", (), 0.8)), True, True),
    ([], {"pump_displacement": 5.0}, with_findings(
        said(), ("area_1", ("area_2", "pump_displacement"), 0.9)), False, True),
    # Within its tolerance a number must not be named; between two and three it may be.
    ([], {"mass": 1.2}, NOTHING, True, True),
    ([], {"mass": 1.2}, with_findings(said(), ("mass", (), 0.9)), False, False),
    ([], {"mass": 2.4}, with_findings(said(), ("mass", (), 0.9)), True, True),
    ([], {"mass": 2.4}, NOTHING, True, True),
    # With effects beside it.
    ([COULOMB], {"mass": 4.0}, with_findings(
        said(("coulomb_friction", "force", (), {})), ("mass", (), 0.9)), True, True),
    ([COULOMB], {"mass": 4.0}, said(("coulomb_friction", "force", (), {})), False, False),
    ([COULOMB], {"mass": 1.0}, said(("coulomb_friction", "force", (), {})), True, True),
    ([COULOMB], {"mass": 1.0}, with_findings(
        said(("coulomb_friction", "force", (), {})), ("mass", (), 0.9)), False, False),
    ([ADDED], {}, with_findings(said(), ("mass", ("added_mass",), 0.9)), False, True),
    ([ADDED], {}, with_findings(said(), ("mass", (), 0.9)), False, False),
    ([HUMP], {"mass": 4.0}, said(verdict="unexplained"), True, True),
])
def test_marks_of_a_case_with_wrong_rig_numbers(effects, off, answer, exact, within):
    truth = with_rig(concealed(*effects, outside=("position_friction_hump",)), **off)
    row = score.row_of(truth, answer)
    assert (row["exact"], row["within_class"]) == (exact, within)


def test_rig_numbers_found_and_falsely_named():
    far = with_rig(concealed(), mass=4.0)
    found = score.row_of(far, with_findings(said(), ("mass", (), 0.9)))
    assert found["rig_truth"] == ["mass"] == found["rig_named"] and found["rig"] == "beyond"
    assert found["kind"] == "rig" and found["located_right"] and found["detectable"] is None
    assert {one["name"]: one["sigmas"] for one in found["parameters"]}["rig.mass"] == (
        pytest.approx(1.0))
    near = with_rig(concealed(), mass=1.5)
    false = score.row_of(near, with_findings(said(), ("mass", (), 0.9)))
    assert false["rig_false"] == ["mass"] and false["rig"] == "within"
    assert false["kind"] == "null" and not false["rig_truth"]
    declared = score.row_of(with_rig(concealed(ADDED), mass=1.5),
                            with_findings(said(), ("mass", ("added_mass",), 0.9)))
    assert not declared["rig_false"]
    missed = score.row_of(far, NOTHING)
    marks = score.score_of([found, missed, false, declared])
    assert marks["rig_found"] == 0.5 and marks["rig_false_name"] == 0.25
    assert score.confusion([found, missed, false]) == {"mass": {"mass": 1, "none": 1},
                                                       "none": {"mass": 1}}
    # Only where the config is right can a parameter be asked to be close.
    assert marks["base_parameters_within_2_percent"] is None
    assert marks["parameters_inside_2_sigma"] is not None


def test_a_rig_number_that_an_oracle_cannot_see_need_not_be_named():
    far = with_rig(concealed(COULOMB), volume_1=5.0, volume_2=5.0)
    answer = said(("coulomb_friction", "force", (), {}))
    for gain, right in ((3.0, True), (300.0, False)):
        oracle = {"log_evidence": {"coulomb_friction": 900.0}, "signals": {},
                  "rig_evidence": {"volume": gain}}
        row = score.row_of(far, answer, oracle)
        assert (row["within_class"], row["detectable"]) == (right, not right)
    alone = {"log_evidence": {}, "signals": {}, "rig_evidence": {"volume": 3.0}}
    blind_to_it = score.row_of(with_rig(concealed(), volume_1=5.0), NOTHING, alone)
    assert blind_to_it["within_class"] and not blind_to_it["exact"]
    assert score.score_of([blind_to_it])["rig_found"] is None


# Probabilities, by hand.

def likely(answer: dict, consistent: float, unexplained: float, *effects: float) -> dict:
    """Return an answer with probabilities."""
    named = [{**one, "probability": p} for one, p in zip(answer["effects"], effects, strict=True)]
    return {**answer, "effects": named,
            "probability": {"consistent": consistent, "unexplained": unexplained}}


def statements(row: dict) -> dict:
    return {one["of"]: (one["said"], one["right"]) for one in row["probabilities"]}


def test_statements_of_an_answer_are_right_or_wrong():
    two = said(("coulomb_friction", "force", (), {}), ("spring_load", "force", (), {}))
    row = score.row_of(concealed(COULOMB), likely(two, 0.0, 0.1, 0.95, 0.6))
    assert statements(row) == {"consistent": (0.0, False), "unexplained": (0.1, False),
                               "coulomb_friction": (0.95, True), "spring_load": (0.6, False)}
    rig = with_findings(likely(NOTHING, 0.3, 0.0), ("area_1", (), 0.7), ("area_2", (), 0.6))
    assert statements(score.row_of(with_rig(concealed(), area_1=4.0), rig)) == {
        "unexplained": (0.0, False), "area": (0.7, True)}  # nobody knows what can be seen
    assert statements(score.row_of(concealed(), likely(NOTHING, 0.99, 0.0)))["consistent"] == (
        0.99, True)
    outside = score.row_of(concealed(HUMP, outside=("position_friction_hump",)),
                           likely(said(verdict="unexplained"), 0.0, 0.8))
    assert statements(outside)["unexplained"] == (0.8, True)
    weak = {"log_evidence": {"coulomb_friction": 7.0}, "signals": {}}
    assert "consistent" not in statements(
        score.row_of(concealed(COULOMB), likely(NOTHING, 0.9, 0.0), weak))
    # Answers without probabilities, or without a number in them, state nothing.
    assert score.row_of(concealed(), NOTHING)["probabilities"] == []
    assert score.row_of(concealed(), likely(NOTHING, None, float("nan")))["probabilities"] == []


def test_calibration_error_is_the_mean_distance_of_said_and_right():
    every = [{"of": "a", "said": 0.95, "right": k < 80} for k in range(100)]
    every += [{"of": "a", "said": 0.25, "right": k < 75} for k in range(300)]
    bins = reliability_of(every)
    assert [(one["low"], one["n"], one["right"]) for one in bins] == [
        (0.2, 300, 0.25), (0.9, 100, 0.8)]
    assert calibration_error(bins) == pytest.approx(0.25 * 0.15)
    assert reliability_of([{"of": "a", "said": 1.0, "right": True}])[0]["low"] == 0.9
    assert calibration_error([]) is None
    row = score.row_of(concealed(COULOMB), likely(
        said(("coulomb_friction", "force", (), {})), 0.0, 0.0, 0.9))
    assert score.score_of([row])["calibration_error"] == pytest.approx(0.1 / 3)


def test_what_an_oracle_cannot_see_need_not_be_named():
    truth = concealed(COULOMB, DELAY)
    oracle = {"log_evidence": {"coulomb_friction": 900.0, "position_delay": 7.0},
              "over_simpler": {}, "signals": said()["fit"]["signals"]}
    row = score.row_of(truth, said(("coulomb_friction", "force", (), {})), oracle)
    assert not row["exact"] and row["within_class"] and not row["detectable"]
    blind_to_both = score.row_of(truth, said(verdict="consistent", place=""), {
        **oracle, "log_evidence": {"coulomb_friction": 3.0, "position_delay": 7.0}})
    assert blind_to_both["within_class"] and not blind_to_both["exact"]
    stribeck = concealed(("stribeck_friction", "force", {"F_c": 40.0}))
    simple = said(("coulomb_friction", "force", (), {}))
    for over, right in ((5.0, True), (500.0, False)):
        told = {"log_evidence": {"stribeck_friction": 900.0}, "signals": {},
                "over_simpler": {"stribeck_friction": over}}
        assert score.row_of(stribeck, simple, told)["within_class"] is right


def test_blame_error_removed_and_parameters():
    blamed = score.row_of(concealed(DELAY), said(("added_mass", "force", (), {})))
    declared = score.row_of(concealed(DELAY), said(("added_mass", "force",
                                                    ("position_delay",), {})))
    drive = score.row_of(concealed(DELAY), said(("drive_lag", "drive", (), {})))
    assert [row["sensor_blamed"] for row in (blamed, declared, drive)] == [True, False, False]
    # 5 noises before, 1.5 after, 1.2 with an oracle: 3.5 of the 3.8 that go.
    oracle = {"log_evidence": {"pressure_offset": 99.0}, "signals": {
        "position": {"before_rms": 10e-6, "after_rms": 2.4e-6, "noise_rms": 2e-6}}}
    row = score.row_of(concealed(OFFSET), said(
        ("pressure_offset", "sensor", (), {"b_1": (4.1e4, 400.0), "b_2": (1e3, 400.0)}),
        place="sensor"), oracle)
    assert row["removed"] == pytest.approx(3.5 / 3.8)
    assert row["oracle_rms"] == pytest.approx(1.2)
    errors = {one["name"]: (one["relative"], one["sigmas"]) for one in row["parameters"]}
    assert errors["pressure_offset.b_1"] == pytest.approx((0.025, 2.5))
    assert errors["pressure_offset.b_2"] == pytest.approx((0.025, 2.5))
    assert errors["B"] == pytest.approx((0.01, 3.0))
    assert errors["beta_e"] == pytest.approx((0.05, 1.5))
    marks = score.score_of([row, blamed])
    assert marks["exact"] == 0.5 and marks["sensor_blamed_on_physics"] == 0.5
    assert marks["base_parameters_within_2_percent"] == 0.5
    assert marks["parameters_inside_2_sigma"] == 0.25
    assert marks["null_false_alarm"] is None


def test_a_diagnosis_that_failed_counts_as_missed():
    row = score.row_of(concealed(COULOMB), None, None, {"error": "killed"})
    assert row["verdict"] == "failed" and not row["within_class"] and row["message"] == "killed"
    clean = score.row_of(concealed(), None)
    assert score.score_of([row, clean])["null_false_alarm"] == 1.0
    assert score.confusion([row, clean]) == {"coulomb_friction": {"failed": 1},
                                             "none": {"failed": 1}}


def test_confusion_counts_each_concealed_effect():
    rows = [score.row_of(concealed(COULOMB), said(("coulomb_friction", "force", (), {}))),
            score.row_of(concealed(COULOMB), said(("spring_load", "force", (), {}))),
            score.row_of(concealed(COULOMB), said(verdict="consistent", place="")),
            score.row_of(concealed(), said(("spring_load", "force", (), {}))),
            score.row_of(concealed(), said(verdict="consistent", place=""))]
    assert score.confusion(rows) == {
        "coulomb_friction": {"coulomb_friction": 1, "spring_load": 1, "none": 1},
        "none": {"spring_load": 1, "none": 1}}


def test_reliability_and_rig_numbers_stand_in_the_report():
    far = with_rig(concealed(COULOMB), mass=4.0)
    rows = [score.row_of(far, likely(said(("coulomb_friction", "force", (), {})), 0.0, 0.3, 0.9))]
    found = {"sealed_key_sha256": "a" * 64, "cases": 1, "score": score.score_of(rows),
             "by_effect": score.by_effect(rows), "rows": rows, "failed": 0, "oracle": False,
             "by_rig": score.by_group(rows, lambda row: row["rig"]), "seed": 1, "commit": None,
             "reliability": score.reliability(rows), "confusion": score.confusion(rows),
             "sources": {}}
    page = proof_page(found)
    assert "mass: the config says 1.2, 1 is true, 4 tolerances" in page
    assert 'id="reliability"' in page and page.count("data:image/png") == 1
    assert 'data-mark="calibration_error">13.3 %' in page  # (0 + 0.3 + 0.1) / 3


def test_what_no_channel_shows_is_not_asked_for():
    """Position and pressures leave the force balance: a leak cannot show in them."""
    leak = ("position_dependent_leak", "flow", {})
    truth = {**concealed(leak, outside=("position_dependent_leak",)),
             "channels": ["x", "p1", "p2"]}
    quiet = {"verdict": "consistent", "effects": [], "location": {"balance": {}},
             "fit": {"signals": {}}, "parameters": {"after": {}}}
    row = score.row_of(truth, quiet)
    assert row["detectable"] is False and row["within_class"]
    assert score.score_of([row])["outside_unexplained"] is None
    row = score.row_of({**truth, "channels": ["x", "x_d", "p1", "p2"]}, quiet)
    assert row["detectable"] and not row["within_class"]
