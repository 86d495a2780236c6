"""The report, the table and the JSON of a diagnosis: every verdict, and numbers that are not."""

import json
import warnings
from dataclasses import fields, is_dataclass, replace

import numpy as np
import pytest
from diagnosis_tools import ALL, CHARGE, MASS, NAN, coulomb, damping, everything, wrong_number
from test_reports import Page

from eha_monitor.api.diagnose import answer, written_config
from eha_monitor.commands.table import show_diagnosis
from eha_monitor.errors import InputError
from eha_monitor.mismatch.diagnosis import (
    Agreement,
    Change,
    Curve,
    Location,
    Overlay,
    RigFinding,
    SignalFit,
    Value,
    Window,
)
from eha_monitor.output import write_text
from eha_monitor.quantity import DIAGNOSED, in_units, quantity, rig_motion, with_uncertainty
from eha_monitor.recordings.recording import ChannelFinding
from eha_monitor.reports.diagnosis_figures import curve_figure, informative
from eha_monitor.reports.diagnosis_report import diagnosis_page
from eha_monitor.reports.diagnosis_words import (
    error_words,
    fit_rows,
    head_words,
    message_words,
    next_steps,
    not_in_config,
    pair_words,
    parameter_words,
    removed,
    removed_words,
    sentence,
    windows_words,
    worst_words,
)
from eha_monitor.settings import Settings, load_settings, settings_from_tree
from eha_monitor.words import probability

COMMAND = "eha-monitor diagnose bags/hidden_friction"


def page_of(found, **more) -> str:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return diagnosis_page(found, Settings(), **more)


@pytest.fixture(scope="module")
def html() -> str:
    return page_of(coulomb(), losses=("12 samples came twice",), command=COMMAND)


@pytest.mark.parametrize("name", list(ALL))
def test_every_verdict_has_a_page_that_is_complete_in_itself(name):
    found = ALL[name]()
    html = page_of(found)
    page = Page(html)
    assert all(r.startswith(("data:image/png;base64,", "#")) for r in page.references)
    assert not page.tags & {"script", "link", "iframe", "object", "embed", "base"}
    assert "http:" not in html and "https:" not in html and "url(" not in html
    assert message_words(found, probable=True) in page.text
    assert head_words(found) in page.text
    for said in (*found.health, *found.advice):
        assert said in page.text
    assert len(html.encode()) < 5e6
    assert " nan" not in page.text and "None" not in page.text


def test_a_change_has_one_voice():
    """The sentence said 4100 ± 1 against 3000.2 ± 0.9, the table ± 40 and ± 150; and the caption,
    that no effect of the catalogue fits."""
    healthy, now = damping(3000.2, 0.9), damping(4100.0, 1.2)
    said = "viscous damping B is 4100 ± 1 N·s/m, where 5 healthy recordings have 3000.2 ± 0.9"
    found = replace(coulomb(), effects=(), references=("a", "b", "c"), health=(), message=said,
                    before={"B": damping(3000.0, 150.0)}, after={"B": damping(4100.0, 40.0)},
                    changes=(Change("B", "", "force", healthy, now, "N·s/m", said),))
    page = Page(page_of(found))
    assert " ".join(pair_words(healthy, now)) in " ".join(page.text.split())
    assert "± 150" not in page.text and "No effect of the catalogue" not in page.text
    assert "what brakes the piston" in page.text
    less = replace(found, changes=(replace(found.changes[0], now=damping(2000.0, 1.0)),))
    assert "temperature and grade" in next_steps(less, "now")[0]
    dry = Change("coulomb_friction", "F_c", "force", Value(0.0, 0.1, "N"), Value(160.0, 0.1, "N"),
                 "N", said)
    assert "spring balance" in next_steps(replace(found, changes=(dry,)), "now")[0]
    line = curve_figure(found, informative(found)[0]).panels[0]
    assert any(getattr(one, "label", "") == "modelled: what has changed" for one in line.shown)


def test_what_nobody_knows_is_told_with_its_size_and_where_to_look():
    rest = replace(ALL["unexplained"](), signals={"force": SignalFit("N", 38.0, 38.0, 0.4)})
    page = Page(page_of(rest)).text
    assert "The force is off by 38 N on unseen data" in page and "noise makes 0.4 N" in page
    first, *others = next_steps(rest, "now --config CONFIG")
    assert first == "Do not act on B and βe: what is missing is in them."
    assert others[0].startswith("Look at the load, the stops, the guides and seals")
    assert "`eha-monitor diagnose now --config CONFIG --reference HEALTHY ...`" in others[1]
    assert not set(map(sentence, rest.advice)) & set(others), "how to separate what has no name"
    assert parameter_words(rest, "B")[0].startswith("(") and "in doubt" in page
    assert [cells[0] for cells in fit_rows(rest)[1]] == ["force"]
    assert fit_rows(rest)[0] == ("error on unseen data", "model", "noise")


def test_what_begins_in_the_middle_is_shown_against_time_where_nothing_is_named():
    t, noise = np.linspace(0.0, 40.0, 400), np.random.default_rng(0).normal(0.0, 1.0, 400)
    nan = np.full(400, np.nan)
    late = Curve("force", "time", "s", "N", t, 30.0 * (t > 18.0) + noise, nan, nan)
    x = np.linspace(-0.1, 0.1, 20)
    spread = Curve("force", "velocity", "m/s", "N", x, 15.0 + 5.0 * np.sin(40.0 * x),
                   np.full(20, 15.0), np.full(20, np.nan))
    rest = replace(ALL["unexplained"](), curves=(spread, late))
    assert informative(rest)[0].against == "time"
    steady = replace(late, measured=noise)
    assert informative(replace(rest, curves=(steady, spread)))[0].against == "velocity"


def test_the_first_picture_is_of_the_balance_that_lacks_most():
    found = ALL["pair"]()
    drive = replace(found.effects[1], balance="drive")
    first, *_ = informative(replace(found, effects=(drive, found.effects[0]), location=Location(
        {"force": 0.8, "drive": 0.2}, "always", ())))
    assert first.balance == "force"


def test_times_that_are_the_whole_recording_are_not_said():
    found = coulomb()
    whole = Location(found.location.balance, "always", ((0.0, found.duration_s),))
    assert worst_words(replace(found, location=whole)) == ""
    part = replace(whole, intervals_s=((2.0, 3.5),))
    assert worst_words(replace(found, location=part)) == "2.0–3.5 s"


def test_sections_follow_what_is_there(html):
    whole = {"verdict", "curve", "health", "summary", "where", "curves", "effects", "considered",
             "fit", "overlays", "parts", "agreement", "advice", "certainty", "command",
             "config-effects", "losses"}
    assert Page(html).ids >= whole
    unexplained = Page(page_of(ALL["unexplained"]())).ids
    assert {"curve", "where", "considered", "fit"} <= unexplained
    assert not {"effects", "overlays", "parts", "config-effects"} & unexplained
    partly = Page(page_of(ALL["partly"]()))
    assert "effects" in partly.ids and "config-effects" not in partly.ids
    assert "Effects that would explain a part of it" in partly.text
    assert not {"curve", "where", "fit", "effects"} & Page(page_of(ALL["insufficient"]())).ids
    assert not {"where", "effects"} & Page(page_of(ALL["consistent"]())).ids


def test_page_says_what_was_found(html):
    text = Page(html).text
    for words in ("40.03 ± 0.08 N", "1412 ± 9 N·s/m", "601.2 ± 1.1 N·s/m", "97 %",
                  "where the motion reverses", "presliding friction", "41 µm", "2.1 µm",
                  "Push the depressurised rod", "Mismatch identified (>99 %)",
                  "Probability that", "is indistinguishable from presliding friction",
                  COMMAND, "12 samples came twice", "F_c: 40.03"):
        assert words in text, words


def test_text_of_others_is_escaped():
    found = replace(coulomb(), message="<b>&", bags=("<i>",),
                    health=("<script>alert(1)</script>",))
    html = page_of(found, command="x '<u>'")
    assert html.count("<script>") == 1  # the one of the page itself
    assert "<script>alert" not in html and "<i>" not in html and "<u>" not in html


def test_a_sensor_that_drifts_is_shown_against_time():
    found, t = coulomb(), np.linspace(0.0, 40.0, 400)
    drifting = replace(found.effects[0], name="pressure_drift", balance="sensor")
    x = np.linspace(-100.0, 100.0, 20)
    by_speed = Curve("sensor", "pump speed", "rad/s", "Pa", x, 400.0 * np.sign(np.sin(x)),
                     np.full(20, 300.0), np.full(20, np.nan))
    over_time = Curve("sensor", "time", "s", "Pa", t, 30.0 * t, np.full(400, np.nan), 30.0 * t)
    only = replace(found, effects=(drifting,), curves=(by_speed, over_time))
    assert informative(only)[0].against == "time"
    level = replace(over_time, measured=np.random.default_rng(0).normal(400.0, 300.0, 400))
    assert informative(replace(only, curves=(level, by_speed)))[0].against == "pump speed"


def test_the_most_informative_curve_leads():
    found = coulomb()
    assert [curve.against for curve in informative(found)][:2] == ["velocity", "position"]
    late = replace(found, curves=(replace(found.curves[1], against="time"), found.curves[0]))
    assert [curve.against for curve in informative(late)] == ["position", "time"]
    assert informative(found)[-1].balance == "flow"
    wild = np.array([NAN, np.inf])
    none = Curve("force", "time", "s", "N", wild, wild, wild, wild)
    assert informative(replace(found, curves=(none,))) == []


def spoilt(tree, number: float):
    """Return a diagnosis with every number in its values, fits and curves replaced."""
    if isinstance(tree, dict):
        return {key: spoilt(value, number) for key, value in tree.items()}
    if isinstance(tree, tuple):
        return tuple(spoilt(value, number) for value in tree)
    if isinstance(tree, np.ndarray):
        return np.full_like(tree, number)
    if is_dataclass(tree):
        return replace(tree, **{f.name: spoilt(getattr(tree, f.name), number)
                                for f in fields(tree) if f.name != "config_effects"})
    return number if isinstance(tree, float) else tree


@pytest.mark.parametrize("number", [NAN, np.inf, -np.inf, 0.0, 1e300, -1e-300])
def test_no_number_breaks_page_table_or_json(number, capsys):
    found = spoilt(everything(), number)
    text = Page(page_of(found)).text
    assert " nan" not in text and "inf" not in text.replace("information", "")
    show_diagnosis(found, Settings())
    text = json.dumps(answer(found), allow_nan=False)
    assert json.loads(text)["schema"] == "eha_monitor/diagnosis/1"
    assert "coulomb_friction" in capsys.readouterr().out
    load_again = written_config(found, Settings(), None)
    assert "coulomb_friction" in load_again


@pytest.mark.parametrize("size", [0, 1, 2])
def test_curves_of_few_points(size):
    few = np.arange(float(size))
    curve = Curve("force", "velocity", "m/s", "N", few, few, few, few)
    found = replace(coulomb(), curves=(curve,),
                    overlays=(Overlay("position", "m", few, few, few, few),),
                    agreement=(Agreement("slow", {"B": damping(1.0, NAN)}, {}),))
    ids = Page(page_of(found)).ids
    assert ("curve" in ids) == ("overlays" in ids) == (size == 2)


def test_many_points_and_many_intervals():
    x = np.linspace(-1, 1, 400)
    found = replace(
        coulomb(), duration_s=0.0, curves=(Curve("force", "velocity", "m/s", "N", x, x, x, x),),
        location=Location({"force": 1.0}, "never_heard_of", tuple(
            (float(i), i + 0.5) for i in range(300))))
    text = Page(page_of(found)).text
    assert "and 294 more" in text and "never heard of" in text


def test_share_of_the_error_that_is_removed():
    assert removed(SignalFit("m", 11.0, 2.0, 1.0)) == pytest.approx(0.9)
    assert removed(SignalFit("m", 11.0, 0.5, 1.0)) == 1.0
    assert removed(SignalFit("m", 11.0, 12.0, 1.0)) == pytest.approx(-0.1)
    assert np.isnan(removed(SignalFit("m", 1.01, 1.0, 1.0)))  # there was nothing to remove
    assert np.isnan(removed(SignalFit("m", NAN, NAN, NAN)))
    assert removed_words(SignalFit("m", 11.0, 2.0, 1.0)) == "90 %"
    assert removed_words(SignalFit("m", 1.1, 12.0, 1.0)) == "grew"  # not −10 900 %
    assert removed_words(SignalFit("m", 1.01, 1.0, 1.0)) == "—"


@pytest.mark.parametrize(
    ("unit", "errors", "shown"),
    [
        ("m³/s", (6.25e-8, 1.95e-7, 5.7e-8), ["3.75 ml/min", "11.7 ml/min", "3.42 ml/min"]),
        ("m³/s", (1.57e-6, 6.1e-8, 5.7e-8), ["94.2 ml/min", "3.66 ml/min", "3.42 ml/min"]),
        ("Pa", (15400.0, 1090.0, 995.0), ["15.4 kPa", "1.09 kPa", "0.995 kPa"]),
        ("N", (2208.0, 24.6, NAN), ["2208 N", "24.6 N", "—"]),
        ("N", (0.0, 0.0, 0.0), ["0 N", "0 N", "0 N"]),
    ],
)
def test_the_errors_of_a_signal_stand_in_one_unit(unit, errors, shown):
    fit = SignalFit(unit, *errors)
    assert [error_words(value, fit) for value in errors] == shown


@pytest.mark.parametrize("name", list(ALL))
def test_json_is_the_contract(name):
    found = ALL[name]()
    tree = json.loads(json.dumps(answer(found), allow_nan=False))
    assert tree["schema"] == "eha_monitor/diagnosis/1"
    assert isinstance(tree["bag"], str)
    assert tree["verdict"] == found.verdict
    assert set(tree["location"]) == {"balance", "regime", "intervals_s"}
    assert set(tree["location"]["balance"]) == {"force", "flow", "drive", "sensor"}
    assert set(tree["parameters"]) == {"before", "after"}
    assert tree["fit"]["data"] == "held_out"
    assert isinstance(tree["advice"], list)
    assert set(tree["probability"]) == {"consistent", "unexplained"}
    assert tree["threshold"]["calibrated"] is False
    for finding in (*tree["rig_data"], *tree["rig_within"]):
        assert set(finding) == {"key", "configured", "found", "probability", "statement",
                                "indistinguishable_from"}
        assert set(finding["found"]) == {"value", "stddev", "unit"}
    for effect in tree["effects"]:
        assert set(effect) >= {"name", "balance", "statement", "parameters", "log_evidence",
                               "indistinguishable_from", "probability", "intervals_s"}
        for value in effect["parameters"].values():
            assert set(value) == {"value", "stddev", "unit"}
    for fit in tree["fit"]["signals"].values():
        assert set(fit) >= {"unit", "before_rms", "after_rms", "noise_rms"}


def test_config_carries_the_physics_and_what_it_did_to_the_rest(tmp_path):
    given = settings_from_tree({"rig": {"mass": 31.0, "viscous_damping": 500.0},
                                "thresholds": {"viscous_damping": {"high_warn": 900.0}}}, "x")
    file = tmp_path / "named.yaml"
    file.write_text(written_config(coulomb(), given, tmp_path / "my_rig.yaml"))
    read = load_settings(file)
    assert read.effects["coulomb_friction"]["F_c"] == 40.03
    assert read.rig.viscous_damping == 601.2 and read.rig.bulk_modulus == 5.998e8
    assert read.rig.mass == 31.0 and read.thresholds == given.thresholds
    head = file.read_text().split("/**:")[0]
    assert "Completes my_rig.yaml" in head and "rig.viscous_damping: 601.2 ± 1.1 N·s/m" in head
    assert "one standard deviation" in head
    assert "bags/hidden_friction" in head


@pytest.mark.parametrize("name", ["consistent", "unexplained", "insufficient", "partly"])
def test_config_without_a_name_stays_as_it_was(name, tmp_path):
    given = settings_from_tree({"effects": {"spring_load": {"k": 900.0}}}, "x")
    file = tmp_path / "named.yaml"
    file.write_text(written_config(ALL[name](), given, None))
    assert load_settings(file) == given
    assert "No key is changed" in file.read_text()


def test_table_for_a_person(capsys, tmp_path):
    show_diagnosis(ALL["pair"](), Settings(), [tmp_path / "report.html"])
    out = " ".join(capsys.readouterr().out.split())
    for words in ("Mismatch identified (>99 %): The force balance lacks",
                  "coulomb_friction >99 %", "pump_dead_zone 91 %",
                  "F_c = 40.03 ± 0.08 N", "presliding friction", "1412 ± 9 N·s/m",
                  "where the motion reverses", "41 µm", "99.7 %", "B read 1412 N·s/m",
                  "βe", DIAGNOSED):
        assert words in out, words
    assert "report.html" in out


def test_nothing_is_certain_in_per_cent():
    shown = {0.0: "<1 %", 0.004: "<1 %", 0.006: "1 %", 0.5: "50 %", 0.994: "99 %",
             0.996: ">99 %", 1.0: ">99 %", 1.2: ">99 %", NAN: "—"}
    assert {p: probability(p) for p in shown} == shown


def test_a_wrong_number_of_the_rig_is_read_first(capsys):
    html = page_of(everything())
    page = Page(html)
    assert {"wrong-numbers", "rig-numbers", "rig-within", "verdict",
            "effect-intermittent_load"} <= page.ids
    assert html.index('id="wrong-numbers"') < html.index('id="verdict"')
    for words in (f"{CHARGE.statement} (99 %)", f"{MASS.statement} (71 %)",
                  "In this recording mass is indistinguishable from added mass",
                  "9.5 tolerances", "± 20 %", "Mismatch identified (94 %)", "(86 %)", "91 %",
                  "It acts at 3.2–5.1, 8.0–9.4, 17.2–21.0 s", "not in it: intermittent load"):
        assert words in page.text, words
    assert page.text.count(CHARGE.statement) == 1  # not again in the message
    show_diagnosis(everything(), Settings())
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].endswith(f"{CHARGE.statement} (99 %)")
    assert lines[3].endswith("mass is indistinguishable from added mass")
    assert lines[4].startswith("Mismatch identified (94 %): A load of −95 N")
    assert any(line.startswith("intermittent_load acts at 3.2–5.1") for line in lines)


def test_a_wrong_number_alone_is_the_whole_answer(capsys):
    show_diagnosis(wrong_number(), Settings())
    out = capsys.readouterr().out
    assert "Wrong rig data explain the mismatch; no effect is missing (98 %)\n" in out
    assert "left out  " not in out  # no empty table of effects
    page = Page(page_of(wrong_number()))
    assert "effects" not in page.ids and "config-effects" in page.ids
    assert "charge_pressure: 300000" in page.text


def test_config_takes_the_found_numbers_and_tells_what_it_cannot_hold(tmp_path):
    file = tmp_path / "named.yaml"
    file.write_text(written_config(everything(), Settings(), None))
    read = load_settings(file)
    assert read.rig.charge_pressure == 3e5 and read.rig.mass == 25.1
    assert set(read.effects) == {"coulomb_friction", "pump_dead_zone"}
    assert read.rig.tolerance == Settings().rig.tolerance
    head = " ".join(file.read_text().split("/**:")[0].replace("#", "").split())
    assert "rig.charge_pressure: 300.0 ± 2.0 kPa, was 2000 kPa (99 %)" in head
    assert ("not in this config: intermittent_load: F = −95.2 ± 1.6 N at 3.2–5.1, 8.0–9.4, "
            "17.2–21.0 s; "
            "a config contains only permanent effects") in head


def test_a_name_of_the_balances_alone_is_not_called_impermanent():
    own = replace(coulomb().effects[0], name="pump_loss_by_direction", balance="flow")
    found = replace(coulomb(), effects=(own,), config_effects={})
    assert not_in_config(found) == {own.name: "the model that runs has no such term, only the "
                                              "balances have"}
    assert "pump loss by direction, for the model that runs has no" not in Page(
        page_of(replace(found, verdict="unexplained"))).text  # nothing is written then


@pytest.mark.parametrize(("found", "written", "words"), [
    ({"makeup_conductance": 2e-12}, {"makeup_conductance": 5e-13},
     "makeup_conductance is a part of leakage"),
    ({"leakage": 4e-14}, {"leakage": 4e-14, "makeup_conductance": 4e-14}, "part of leakage"),
    ({"leakage": 1e-12, "makeup_conductance": 2e-12},
     {"leakage": 1e-12, "makeup_conductance": 1e-12}, "part of leakage"),
    ({"mass": -3.0}, {"mass": 20.0}, "rig.mass: expected more than 0 kg"),
    ({"mass": 24.0, "volume_1": 1e30}, {"mass": 24.0, "volume_1": 6.85e-5}, "rig.volume_1: the"),
    ({"area_1": 5.1234567e-4}, {"area_1": 5.12346e-4, "area_2": 5.05e-4}, "rig.area_1: "),
])
def test_found_numbers_keep_within_bounds_and_fit_together(found, written, words, tmp_path):
    findings = tuple(RigFinding(key, 1.0, Value(value, 0.01 * abs(value), "x"), 0.9, f"{key}: x")
                     for key, value in found.items())
    file = tmp_path / "named.yaml"
    file.write_text(written_config(replace(wrong_number(), rig_data=findings), Settings(), None))
    read = load_settings(file)
    assert {key: getattr(read.rig, key) for key in written} == written
    assert words in file.read_text()


def test_numbers_found_beside_an_unexplained_rest_are_not_written(tmp_path):
    file = tmp_path / "named.yaml"
    file.write_text(written_config(replace(everything(), verdict="unexplained"), Settings(), None))
    assert load_settings(file) == Settings()


def test_a_rig_that_turns_has_newton_metres_everywhere(capsys):
    found = everything()
    assert in_units(found) is found
    assert quantity(12.0, "kg") == "12 kg"
    with rig_motion("rotary"):
        said = (f"{quantity(12, 'kg')} at {quantity(3e-3, 'm/s^2')} and {quantity(15e3, 'N/m')}; "
                f"{quantity(68.5e-6, 'm³')}, {with_uncertainty(1.4e-12, 1e-13, 'N')}")
        turned = replace(in_units(found), health=(said,))
        assert in_units(turned).effects == turned.effects  # what is turned stays so
        # Already the rig's own unit, and no unit of a linear one.
        assert quantity(7.0, "N·m·s/rad") == "7 N·m·s/rad" and quantity(2.0, "rad/s") == "2 rad/s"
        assert quantity(0.0, "m") == "0 rad" and quantity(5e-4, "m²") == "5 cm²·m/rad"
    assert quantity(7.0, "m") == "7 m"
    assert turned.bags == found.bags and turned.config_effects == found.config_effects
    show_diagnosis(turned, Settings())
    table = " ".join(capsys.readouterr().out.split())
    rotary = settings_from_tree({"rig": {"motion": "rotary"}}, "x")
    page = Page(diagnosis_page(turned, rotary)).text
    tree = answer(turned)
    for text in (table, page, json.dumps(tree, ensure_ascii=False)):
        assert "12 kg·m² at 3 mrad/s² and 15 kN·m/rad; 68.5 cm³, (1.40 ± 0.10)·10⁻¹² N·m" in text
    for text in (table, page):
        assert "40.03 ± 0.08 N·m" in text
        assert "601.2 ± 1.1 N·m·s/rad" in text
    assert tree["effects"][0]["parameters"]["F"]["unit"] == "N·m"
    assert {one["key"]: one["found"]["unit"] for one in tree["rig_data"]}["mass"] == "kg·m²"


def test_report_that_cannot_be_written(tmp_path):
    with pytest.raises(InputError, match="cannot write"):
        write_text(tmp_path / "missing" / "x.html", diagnosis_page(coulomb(), Settings()))


def test_a_long_recording_says_on_which_windows_its_effects_were_named():
    found = replace(coulomb(), named_on=(Window("bag", 8.0, 16.0), Window("bag", 32.0, 40.0)))
    said = windows_words(found)
    assert "on the most informative 16 s (8 to 16 s and 32 to 40 s)" in said
    assert said in diagnosis_page(found, Settings())
    assert windows_words(coulomb()) == ""
    assert answer(found)["named_on"] == [
        {"bag": "bag", "start_s": 8.0, "stop_s": 16.0},
        {"bag": "bag", "start_s": 32.0, "stop_s": 40.0}]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("healthy_3 does not belong", "healthy_3 does not belong."),
        ("p1 is 8 bar", "p1 is 8 bar."),
        ("x: 1000 of 2000 values are NaN", "x: 1000 of 2000 values are NaN."),
        ("βe is low", "βe is low."),
        ("a constant load", "A constant load."),
        ("monday/7: no force", "monday/7: no force."),
    ],
)
def test_names_and_symbols_keep_their_letters(text, said):
    assert sentence(text) == said


def test_no_line_is_drawn_where_nothing_was_compared():
    """Dry friction with samples at rest left out: two branches, no ramp between them."""
    found = everything()
    curve = next(one for one in found.curves if one.against != "time")
    v = np.r_[np.linspace(-0.2, -0.05, 12), np.linspace(0.05, 0.2, 12)]
    curve = replace(curve, x=v, measured=np.sign(v), spread=np.full(24, 0.1), modelled=np.sign(v))
    line = curve_figure(found, curve).panels[0].shown[-1]
    assert len(line.x) == 25 and np.isnan(line.x[12]) and np.isnan(line.y[12])


@pytest.mark.parametrize(
    ("one", "other", "shown"),
    [
        ((0.0, 70.0), (-12510.0, 70.0), ("0.00 ± 0.07 kN/m", "−12.51 ± 0.07 kN/m")),
        ((1.1e4, 7e3), (6100.0, 1400.0), ("11 ± 7 kN/m", "6.1 ± 1.4 kN/m")),
        ((5.0, 0.0), (12e3, 100.0), ("5 N/m", "12.00 ± 0.10 kN/m")),  # one was given
        (None, (5.0, 1.0), ("—", "5.0 ± 1.0 N/m")),
    ],
)
def test_two_values_that_are_compared_stand_in_one_unit(one, other, shown):
    pair = [value and Value(*value, "N/m") for value in (one, other)]
    assert pair_words(*pair) == shown


def test_what_to_do_names_the_numbers_that_there_are():
    found = coulomb()
    assert "Use B and βe of the completed config" in " ".join(next_steps(found, "BAG"))
    without = replace(found, after={"B": found.after["B"]})
    assert "Use B of the completed config" in " ".join(next_steps(without, "BAG"))
    changed = replace(found, references=("monday",))
    assert "completed config" not in " ".join(next_steps(changed, "BAG"))
    both = replace(found, bags=("monday", "tuesday"))
    text = Page(page_of(both)).text
    assert "In these recordings Coulomb friction is" in text and "In this recording" not in text


def test_what_stands_against_a_channel_is_said_before_the_verdict(capsys):
    dead = ChannelFinding("p1 is 8 bar in the whole recording", "hold", ("p1",))
    held = ChannelFinding("the drive holds its command", "hold", ("x_d",),
                          {"command_hold": "sampled"})
    found = replace(coulomb(), channels=(held, dead))
    show_diagnosis(found, Settings())
    out = capsys.readouterr().out
    assert "channel: p1 is 8 bar in the whole recording." in out[: out.index("Mismatch")]
    assert "holds its command" not in out  # the command adds it as a note
    text = Page(page_of(found)).text
    assert "p1 is 8 bar in the whole recording." in text[: text.index("Mismatch identified")]
