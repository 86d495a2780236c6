"""The report, the table and the JSON of a diagnosis: every verdict, and numbers that are not."""

import json
import warnings
from dataclasses import fields, is_dataclass, replace

import numpy as np
import pytest
from diagnosis_tools import ALL, NAN, coulomb, damping
from test_reports import Page

from eha_monitor.commands.diagnosis_answer import answer, mismatched, written_config
from eha_monitor.commands.diagnosis_table import show
from eha_monitor.errors import InputError
from eha_monitor.mismatch.diagnosis import Agreement, Curve, Location, Overlay, SignalFit
from eha_monitor.quantity import NOTE
from eha_monitor.reports.diagnosis_figures import telling
from eha_monitor.reports.diagnosis_report import diagnosis_page, write_diagnosis_report
from eha_monitor.reports.diagnosis_words import VERDICTS, removed
from eha_monitor.settings import Settings, load_settings, settings_from_tree

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
    assert all(r.startswith("data:image/png;base64,") for r in page.references)
    assert not page.tags & {"script", "link", "iframe", "object", "embed", "base"}
    assert "http:" not in html and "https:" not in html and "url(" not in html
    assert found.message in page.text
    assert VERDICTS[found.verdict][1] in page.text
    for sentence in (*found.health, *found.advice):
        assert sentence in page.text
    assert len(html.encode()) < 3e6
    assert " nan" not in page.text and "None" not in page.text


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
    assert "would take away 35 %" in partly.text
    assert not {"curve", "where", "fit", "effects"} & Page(page_of(ALL["insufficient"]())).ids
    assert not {"where", "effects"} & Page(page_of(ALL["consistent"]())).ids


def test_page_says_what_was_found(html):
    text = Page(html).text
    for words in ("40.03 ± 0.08 N", "1412 ± 9 N·s/m", "601.2 ± 1.1 N·s/m", "97 %",
                  "where the motion turns round", "presliding friction", "41 µm", "2.1 µm",
                  "Push the depressurised rod", "14 log units", "simulated clean recordings",
                  "cannot be told from presliding friction",
                  COMMAND, "12 samples came twice", "F_c: 40.03"):
        assert words in text, words


def test_text_of_others_is_escaped():
    found = replace(coulomb(), message="<b>&", bags=("<i>",),
                    health=("<script>alert(1)</script>",))
    html = page_of(found, command="x '<u>'")
    assert "<script>" not in html and "<i>" not in html and "<u>" not in html


def test_the_most_telling_curve_leads():
    found = coulomb()
    assert [curve.against for curve in telling(found)][:2] == ["velocity", "pressure difference"]
    late = replace(found, curves=(replace(found.curves[1], against="time"), found.curves[0]))
    assert [curve.against for curve in telling(late)] == ["position", "time"]
    assert telling(found)[-1].balance == "flow"
    wild = np.array([NAN, np.inf])
    none = Curve("force", "time", "s", "N", wild, wild, wild, wild)
    assert telling(replace(found, curves=(none,))) == []


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
    found = spoilt(ALL["pair"](), number)
    page_of(found)
    show(found, [])
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
    for effect in tree["effects"]:
        assert set(effect) >= {"name", "balance", "statement", "parameters", "log_evidence",
                               "indistinguishable_from"}
        for value in effect["parameters"].values():
            assert set(value) == {"value", "stddev", "unit"}
    for fit in tree["fit"]["signals"].values():
        assert set(fit) >= {"unit", "before_rms", "after_rms", "noise_rms"}
    assert mismatched(found) == (name not in ("consistent", "insufficient"))


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
    assert "Nothing is changed" in file.read_text()


def test_table_for_a_person(capsys, tmp_path):
    show(ALL["pair"](), [tmp_path / "report.html"])
    out = " ".join(capsys.readouterr().out.split())
    for words in ("Mismatch, and what it is: The force balance lacks", "coulomb_friction",
                  "F_c = 40.03 ± 0.08 N", "presliding friction", "1412 ± 9 N·s/m",
                  "where the motion turns round", "41 µm", "99.7 %", "B read 1412 N·s/m",
                  "βe", NOTE):
        assert words in out, words
    assert "report.html" in out


def test_report_that_cannot_be_written(tmp_path):
    with pytest.raises(InputError, match="cannot write"):
        write_diagnosis_report(tmp_path / "missing" / "x.html", coulomb(), Settings())
