"""The HTML report of ``estimate``: complete in itself, true to the numbers, hard to break."""

import base64
import os
import re
import struct
import warnings
from dataclasses import dataclass, replace
from html.parser import HTMLParser
from types import SimpleNamespace

import numpy as np
import pytest

from eha_monitor.api.estimate import judged
from eha_monitor.commands.table import show
from eha_monitor.errors import InputError
from eha_monitor.estimation.pipeline import estimate
from eha_monitor.estimation.results import Event, ModelStatus, Taint
from eha_monitor.health.alarms import Alarm
from eha_monitor.output import write_text
from eha_monitor.physics.simulator import Simulator
from eha_monitor.quantity import NOTE, with_uncertainty
from eha_monitor.recordings.recording import Recording
from eha_monitor.reports.estimate_report import (
    effect_of_mismatch,
    estimate_page,
    heading,
    verdict,
)
from eha_monitor.settings import settings_from_tree

FIGURES = {"parameter-B", "parameter-beta_e", "timeline", "pressure", "position", "velocity",
           "acceleration", "innovations-one", "innovations-two"}


SCRIPT = re.compile(r'<script(?: type="[a-z/]+")?(?: id="plotly")?>(.*?)</script>', re.DOTALL)


class Page(HTMLParser):
    """What the tests look at: text, ids, pictures of each figure, exact values, references.

    ``scripts`` holds the content of each script element; it is no text of the page.
    """

    def __init__(self, html: str):
        super().__init__()
        self.scripts = SCRIPT.findall(html)
        html = SCRIPT.sub("", html)
        self.text, self.ids, self.values, self.references, self.tags = "", set(), [], [], set()
        self.pictures: dict[str, list[dict]] = {}
        self._figure = ""
        self.feed(html)

    def handle_starttag(self, tag, attributes):
        found = dict(attributes)
        self.tags.add(tag)
        if "id" in found:
            self.ids.add(found["id"])
        if tag == "figure":
            self._figure = found["id"]
        if tag == "img":
            self.pictures.setdefault(self._figure, []).append(found)
        if tag == "data":
            self.values.append(float(found["value"]))
        self.references += [found[name] for name in ("src", "href", "action", "data", "srcset",
                                                     "poster") if name in found]

    def handle_data(self, data):
        self.text += data


@dataclass(frozen=True)
class Case:
    """An estimate with its alarms, ready for the report."""

    estimate: object
    alarms: tuple
    history: tuple

    def page(self, observability=None) -> str:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            return estimate_page(self.estimate, self.alarms, self.history, observability)


def case_of(recording: Recording, settings) -> Case:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the filters on data from beyond the world
        found = estimate(recording, settings)
        alarms, history = judged(found)
    return Case(found, alarms, history)


def simulated(tree: dict, samples: int, source: str = "bags/triangle.mcap"):
    settings = settings_from_tree(tree, "test")
    plant = Simulator(settings, seed=1)
    return Recording(plant.dt, plant.advance(samples), 10**18, source), settings


@pytest.fixture(scope="module")
def triangle() -> Case:
    return case_of(*simulated({}, 8000))


@pytest.fixture(scope="module")
def triangle_html(triangle) -> str:
    return triangle.page()


@pytest.fixture(scope="module")
def short() -> tuple[Recording, object]:
    """One second and a half of the triangle, with a reversal in it."""
    return simulated({}, 1500)


def test_page_is_complete_in_itself(triangle_html):
    html, page = triangle_html, Page(triangle_html)
    assert page.references and all(r.startswith(("data:image/png;base64,", "#"))
                                   for r in page.references)
    assert not page.tags & {"script", "link", "iframe", "object", "embed", "base"}
    assert "http:" not in html and "https:" not in html and "url(" not in html
    assert "@import" not in html
    assert len(html.encode()) < 5e6


def test_contents_lead_to_every_chapter(triangle_html):
    page = Page(triangle_html)
    links = [r[1:] for r in page.references if r.startswith("#")]
    assert len(links) == triangle_html.count("<h2 ") == len(set(links)) > 3
    assert set(links) <= page.ids


def test_every_figure_is_there_at_twice_its_size(triangle_html):
    page = Page(triangle_html)
    assert page.ids >= FIGURES
    assert set(page.pictures) == FIGURES - {"timeline"} | {"curve"}
    for name, pictures in page.pictures.items():
        # The whole record, and a closer look; the first screen has one.
        assert len(pictures) == (1 if name == "curve" else 2)
        for one in pictures:
            png = base64.b64decode(one["src"].split(",", 1)[1])
            width, height = struct.unpack(">II", png[16:24])
            assert (width, height) == (2 * int(one["width"]), 2 * int(one["height"]))
            assert one["alt"]


def test_numbers_are_those_of_the_estimate(triangle, triangle_html):
    page = Page(triangle_html)
    found = triangle.estimate
    exact = [p.value for p in found.parameters.values()]
    if found.joint is not None:
        exact += [p.value for p in found.joint.parameters.values()]
    assert page.values == exact
    b, beta = found.parameters["B"], found.parameters["beta_e"]
    for one in (b, beta):
        assert with_uncertainty(one.value, one.stddev, one.unit) in page.text
    assert page.text.count(NOTE) == 1  # what ± is, once
    assert found.model.message in page.text
    for event in found.events:
        assert event.message in page.text
    for alarm in triangle.alarms:
        assert alarm.message in page.text


def test_healthy_verdict(triangle, triangle_html):
    said = verdict(triangle.estimate, triangle.alarms)
    assert (said.kind, said.headline) == ("ok", "Healthy")
    assert f"{said.headline}: {said.text}" in Page(triangle_html).text
    assert "within the limits" in said.text


def test_verdict_leads_with_the_gravest(triangle):
    found, alarms = triangle.estimate, list(triangle.alarms)
    wrong = replace(found, model=ModelStatus("mismatch", "m", tainted={"B": Taint("it", 1.0)}))
    assert verdict(wrong, triangle.alarms).headline == "Mismatch"
    assert "biased by the model error" in verdict(wrong, triangle.alarms).text
    alarms[0] = replace(alarms[0], level="ERROR")
    assert verdict(found, alarms).headline == "Alarm"
    assert "viscous damping B is too high (ERROR)" in verdict(found, alarms).text
    assert verdict(wrong, alarms).headline == "Alarm and mismatch"
    alarms[0] = replace(alarms[0], level="WARN")
    assert verdict(found, alarms).kind == "warn"
    silent = replace(found, stage_two=replace(found.stage_two, estimate=replace(
        found.stage_two.estimate, status="not_excited")))
    assert verdict(silent, triangle.alarms).headline == "No fault found in what could be judged"
    assert "no estimate of effective bulk modulus" in verdict(
        silent, triangle.alarms).text


def test_what_is_not_judged_is_not_within_the_limits(triangle):
    alarms = [replace(alarm, level="STALE", not_judged=True)
              if alarm.name.startswith("viscous") else alarm for alarm in triangle.alarms]
    said = verdict(triangle.estimate, tuple(alarms))
    assert "N·s/m is not judged" in said.text and "MPa is within the limits" in said.text
    assert said.headline == "No fault found in what could be judged" and said.kind != "ok"
    # The page says so, and what stands instead of a value in doubt.
    other = replace(triangle.estimate.parameters["B"], value=777.0, stddev=7.0)
    model = replace(triangle.estimate.model, status="mismatch", tainted={
        "B": Taint("it", 1.0, instead=other), "beta_e": Taint("it", 1.0)})
    wrong = replace(triangle.estimate, model=model)
    assert effect_of_mismatch(wrong) == (
        "B of the filter is not used: 777 ± 7 N·s/m by least squares on the force balance, which "
        "the alarms judge.", "βe of the filter cannot be used.")
    said = verdict(wrong, triangle.alarms).text
    assert "so βe is biased by the model error; B by least squares on the balances instead" in said
    text = Page(estimate_page(wrong, tuple(alarms), tuple(alarms), None)).text
    assert "777 ± 7" in text and "not judged" in text


def test_a_rising_damping_shows_as_an_alarm():
    tree = {"simulation": {"faults": {"wear": {"parameter": "viscous_damping", "start": 2.0,
                                               "duration": 2.0, "value": 1800.0}}}}
    case = case_of(*simulated(tree, 8000))
    said = verdict(case.estimate, case.alarms)
    assert said.kind == "error"
    page = Page(case.page())
    assert "B high" in page.text
    assert "ERROR" in page.text


@pytest.mark.parametrize("channels, missing", [
    (("x", "force"), "effective bulk modulus"),
    (("x", "x_d"), "viscous damping"),
    (("x",), "viscous damping"),
    (("p1", "p2"), "viscous damping"),
])
def test_missing_channels_are_said_not_drawn(short, channels, missing):
    recording, settings = short
    rig = settings.rig
    given = recording.channels | {
        "force": rig.area_1 * recording.get("p1") - rig.area_2 * recording.get("p2")}
    case = case_of(replace(recording, channels={n: given[n] for n in channels}), settings)
    page = Page(case.page())
    assert page.ids >= FIGURES
    assert f"no estimate of {missing}" in page.text
    assert ("No curve:" in page.text) or len(page.pictures) == 9
    if "p1" not in channels and "force" not in channels:
        assert "pressure" not in page.pictures
        assert "nothing to show" in page.text


def altered(short, change) -> Case:
    recording, settings = short
    return case_of(replace(recording, channels={
        name: change(values.copy()) for name, values in recording.channels.items()}), settings)


def with_gap(values):
    values[600:900] = np.nan
    return values


def with_infinities(values):
    values[::400] = np.inf
    return values


# A page takes two seconds to draw; those that another case comes close to are of make proof.
@pytest.mark.parametrize("change", [
    lambda v: np.full(len(v), np.nan), lambda v: v[:1], lambda v: v[:0], lambda v: v * 1e4,
    np.ones_like, with_gap, *(pytest.param(change, marks=pytest.mark.slow) for change in (
        lambda v: v[:3], lambda v: v * 1e-12, np.zeros_like, with_infinities)),
], ids=["nan", "one", "none", "huge", "constant", "gap", "three", "tiny", "zero", "infinite"])
def test_whatever_the_data_a_page_comes(short, change):
    page = Page(altered(short, change).page())
    assert page.ids >= FIGURES
    assert "verdict" in page.ids
    assert "nan" not in page.text.lower().replace("nanos", "").split()


@pytest.mark.parametrize("factor", [1e9, 1e200])
def test_what_no_sensor_shows_gets_no_page(short, factor):
    with pytest.raises(InputError, match="out of range"):
        altered(short, lambda values: values * factor)


def test_somebodys_own_recording_is_not_the_papers(triangle_html):
    assert "paper" not in Page(triangle_html).text


def test_config_is_in_words_and_in_units_that_people_write(triangle_html):
    text = Page(triangle_html).text
    for words in ("piston area of chamber 1", "5.05 cm²", "68.5 cm³", "command hold",
                  "Stage two: effective bulk modulus", "viscous damping, high warn", "1000 N·s/m"):
        assert words in text, words
    for raw in ("command_hold", "stage_two", "area_1", "high_warn", "0.000505", "6e+08"):
        assert raw not in text, raw


@pytest.mark.parametrize(("start_ns", "words"), [
    (0, "no date"), (12_300_000_000, "no date: the stamps count from 0"),
    (3 * 365 * 86_400 * 10**9, "no date"), (10**18, "2001-09-09 01:46:40 UTC"),
    (2**62, "2116-02-20"), (10**25, "beyond the calendar")])
def test_a_start_is_a_date_only_where_the_stamps_are(short, triangle_html, start_ns, words):
    recording, settings = short
    assert "2001-09-09 01:46:40 UTC" in Page(triangle_html).text
    found = estimate(replace(recording.part(0, 300), start_ns=start_ns), settings)
    text = dict(heading(found))["Start"]
    assert words in text and "1970" not in text and "1972" not in text


def test_no_channel_at_all(short):
    _, settings = short
    page = Page(case_of(Recording(1e-3, {}), settings).page())
    assert page.ids >= FIGURES and not page.pictures
    assert "No answer" in page.text


def test_rotary_rig_has_rotary_units(short):
    recording, _ = short
    settings = settings_from_tree({"rig": {
        "motion": "rotary", "area_1": None, "area_2": None, "volume_1": None, "volume_2": None,
        "pump_displacement": None, "position_gain": None, "mass": 20.0}}, "test")
    force = 5.05e-4 * (recording.get("p1") - recording.get("p2"))
    case = case_of(replace(recording, channels={"x": recording.get("x"), "force": force}),
                   settings)
    page = Page(case.page())
    assert "Angle" in page.text and "torque" in page.text and "N·m" in page.text
    assert any("angle" in one["alt"] for one in page.pictures["position"])


def test_names_are_escaped(short):
    recording, settings = short
    nasty = "<script>alert('1')</script>&\"\udcff"
    named = settings.model_copy(update={"rig": settings.rig.model_copy(update={"name": nasty})})
    case = case_of(replace(recording, source=f"bags/{nasty}.mcap", losses=(nasty,),
                           channels={"x": recording.get("x")[:50]}), named)
    case = replace(case, alarms=(Alarm(nasty, "WARN", nasty, 0.0),),
                   estimate=replace(case.estimate, events=(Event(0.0, "one", nasty),),
                                    warnings=(nasty,), model=ModelStatus("mismatch", nasty)))
    html = case.page()
    page = Page(html)
    charts = sum(map(len, page.pictures.values()))
    # One script for each chart, and two if there is any: nothing of the names.
    assert len(page.scripts) == html.count("<script") == charts + (2 if charts else 0)
    assert not any("alert" in one for one in page.scripts)
    assert "&lt;script&gt;" in html
    assert nasty in Page(html).text


def test_observability_is_a_table(short):
    recording, settings = short
    case = case_of(recording.part(0, 3), settings)
    rows = (SimpleNamespace(channels=("x", "p1", "p2"),
                            relative_stddev={"B": 0.002, "beta_e": np.inf, "L": np.nan}),
            SimpleNamespace(channels=("x", "temperature"),
                            relative_stddev={"B": 0.4, "beta_e": 0.03, "L": 7.0}))
    page = Page(case.page(SimpleNamespace(rows=rows)))
    assert "observability" in page.ids
    assert "x, p1, p2" in page.text and "± 0.2 %" in page.text
    assert page.text.count("not observable") == 2
    assert "observability" not in Page(case.page(SimpleNamespace(rows=()))).ids


def test_written_at_once_and_refused_in_one_line(short, tmp_path, monkeypatch):
    recording, settings = short
    case = case_of(recording.part(0, 3), settings)
    target, html = tmp_path / "report.html", case.page()
    target.write_text("older")
    write_text(target, html)
    assert target.read_text(encoding="utf-8").startswith("<!DOCTYPE html>")
    assert os.listdir(tmp_path) == ["report.html"]
    for bad in (tmp_path / "absent" / "r.html", tmp_path):
        with pytest.raises(InputError, match="cannot write") as refused:
            write_text(bad, html)
        assert str(bad) in str(refused.value) and "\n" not in str(refused.value)
    assert os.listdir(tmp_path) == ["report.html"]


def test_a_long_recording_stays_small(short):
    """An hour at 100 Hz, from a result made by hand: the drawing is what is tested."""
    recording, settings = short
    n = 360_000
    time = np.arange(n) * 0.01
    x = 0.04 * np.sin(0.5 * time) + 1e-6 * np.random.default_rng(0).standard_normal(n)
    case = case_of(recording, settings)
    stretched = {name: np.resize(getattr(case.estimate.stage_one, name), n) for name in (
        "value", "stddev", "velocity", "acceleration", "innovation", "innovation_stddev")}
    stage = replace(case.estimate.stage_one, time=time, position=x, **stretched)
    found = replace(case.estimate, recording=Recording(0.01, {"x": x}), stage_one=stage)
    html = Case(found, case.alarms, case.history).page()
    assert len(html) < 6e6
    assert "3600 s (60.0 min)" in html


def test_the_terminal_writes_the_same_numbers_and_says_once_what_they_mean(triangle, capsys):
    show(triangle.estimate, triangle.alarms, [])
    out = " ".join(capsys.readouterr().out.split())
    for one in triangle.estimate.parameters.values():
        assert f"{one.shown} converged" in out
    assert out.count(NOTE) == 1 and "nats" not in out
    assert not re.search(r"\de[+-]\d", out)
