"""The pages in a headless Chromium: drawn without a complaint, at a desk, on a phone, on paper."""

import base64
import json
import re
import time
from functools import cache

import numpy as np
import pytest
from diagnosis_tools import ALL
from test_reports import case_of, simulated

from eha_monitor.quantity import Scale
from eha_monitor.reports import page, plotly_chart
from eha_monitor.reports.diagnosis_report import diagnosis_page
from eha_monitor.reports.figure import Band, Curve, Figure, Level, Panel, Side, Span
from eha_monitor.reports.plotly_chart import chart, chart_json, numbers
from eha_monitor.reports.still_image import drawn
from eha_monitor.reports.traces import band_envelope, envelope
from eha_monitor.settings import Settings

DESK, PHONE = {"width": 1280, "height": 900}, {"width": 400, "height": 800}
RANGES = ("[...document.querySelectorAll('[data-stretch=record] .plot')]"
          ".map(plot => plot.layout.xaxis.range)")
READ = "[...document.querySelectorAll('.hoverlayer .legend')].map(box => box.textContent)"


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """The report of six seconds of the triangle, in a file."""
    path = tmp_path_factory.mktemp("pages") / "report.html"
    path.write_text(case_of(*simulated({}, 6000)).page(), encoding="utf-8")
    return path


@cache
def diagnosed(name):
    """Return the page of a diagnosis made by hand."""
    return diagnosis_page(ALL[name](), Settings())


@pytest.fixture
def opened(browser):
    """Return what opens a page of a file; complaints and requests fail the test."""
    complaints, contexts = [], []

    def open_it(path, viewport=DESK, **how):
        context = browser.new_context(viewport=viewport, **how)
        contexts.append(context)
        shown = context.new_page()
        shown.on("console", lambda one: complaints.append(one.text))
        shown.on("pageerror", lambda one: complaints.append(str(one)))
        shown.on("request", lambda one: complaints.append(one.url)
                 if not one.url.startswith(("file:", "data:", "blob:")) else None)
        shown.goto(path.as_uri())
        return shown

    yield open_it
    for context in contexts:
        context.close()
    assert not complaints


def until(shown, condition, patience=30.0):
    """Wait for a condition in JavaScript; the page's policy forbids Playwright's own way."""
    end = time.monotonic() + patience
    while not shown.evaluate(condition):
        assert time.monotonic() < end, condition
        shown.wait_for_timeout(20)


def hovered(shown, box, share=0.6, height=0.3):
    """Move the mouse into a chart and wait until it tells values; returns what is told."""
    place = shown.locator(f"{box} .nsewdrag").first.bounding_box()
    at = place["x"] + share * place["width"], place["y"] + height * place["height"]
    shown.mouse.move(*at)
    shown.mouse.move(at[0] + 1, at[1])
    until(shown, f"{READ}.length > 0")
    return place


def test_charts_read_zoom_and_go_together(opened, report):
    shown = opened(report)
    shown.evaluate("allCharts()")
    assert shown.locator(".js-plotly-plot").count() == shown.locator(".chart > img").count() == 17
    assert shown.evaluate("document.documentElement.scrollWidth") <= 1280
    shown.evaluate("document.querySelector('#position').scrollIntoView()")
    place = hovered(shown, "#position")
    until(shown, f"{READ}.length >= 2")  # the velocity below tells the same moment
    told = shown.evaluate(READ)
    moments = [float(re.match(r"([\d.]+) s", one)[1]) for one in told]
    assert np.ptp(moments) < 0.02, told
    assert abs(moments[0] - 0.6 * 6.0) < 0.05
    assert any(all(word in one for word in ("measured", "stage one", "residual", "mm", "µm"))
               for one in told)
    start = shown.evaluate(RANGES)
    y = place["y"] + 0.3 * place["height"]
    shown.mouse.move(place["x"] + 0.25 * place["width"], y)
    shown.mouse.down()
    shown.mouse.move(place["x"] + 0.5 * place["width"], y, steps=4)
    shown.mouse.up()
    until(shown, f"{RANGES}.every(([a, b]) => Math.abs(a - 1.5) < 0.05"
                            " && Math.abs(b - 3) < 0.05)")
    # Every chart of the whole record, none of the enlarged part.
    assert len(shown.evaluate(RANGES)) == 9
    shown.mouse.dblclick(place["x"] + 0.4 * place["width"], y)
    until(shown, f"JSON.stringify({RANGES}) == '{json.dumps(start)}'"
                            ".replaceAll(' ', '')")


def test_charts_wait_until_they_are_near(opened, report):
    shown = opened(report)
    until(shown, "document.querySelectorAll('.js-plotly-plot').length > 0")
    assert shown.locator("#innovations-two .js-plotly-plot").count() == 0
    shown.locator("details.researcher > summary").click()
    shown.locator("#innovations-two").scroll_into_view_if_needed()
    until(shown, "document.querySelectorAll('#innovations-two .js-plotly-plot').length > 0")


@pytest.mark.parametrize("dark", ["light", "dark"])
def test_a_phone_shows_all_without_scrolling_sideways(opened, report, dark):
    shown = opened(report, PHONE, color_scheme=dark, has_touch=True, is_mobile=True)
    shown.evaluate("allCharts()")
    assert shown.evaluate("document.documentElement.scrollWidth") <= 400
    for key in shown.evaluate("[...document.querySelectorAll('.contents a')].map(a => a.hash)"):
        shown.locator(f".contents a[href='{key}']").click()
        top = shown.locator(key).bounding_box()["y"]
        assert top < PHONE["height"], key
    ink = shown.evaluate("document.querySelector('.plot')._fullLayout.font.color")
    assert (ink == "#dfe6ec") == (dark == "dark")
    # Tables are cards there.
    shown.evaluate("document.querySelectorAll('details').forEach(one => one.open = true)")
    assert shown.evaluate("[...document.querySelectorAll('.scroll')].filter("
                          "one => one.scrollWidth > one.clientWidth + 1).length") == 0


def test_without_scripts_and_on_paper_the_pictures_stand_there(opened, report):
    plain = opened(report, java_script_enabled=False)
    assert plain.locator(".chart > img").first.is_visible()
    shown = opened(report)
    shown.evaluate("allCharts()")
    assert not shown.locator(".chart > img").first.is_visible()
    shown.emulate_media(media="print")
    assert shown.locator(".chart > img").first.is_visible()
    assert not shown.locator(".plot").first.is_visible()
    assert not shown.locator(".contents").is_visible()


@pytest.mark.parametrize("size", [DESK, PHONE], ids=["desk", "phone"])
def test_verdict_picture_and_what_to_do_share_the_first_screen(opened, report, tmp_path, size):
    other = tmp_path / "diagnosis.html"
    other.write_text(diagnosed("coulomb"), encoding="utf-8")
    for path in (report, other):
        shown = opened(path, size)
        until(shown, "document.querySelectorAll('#hero .js-plotly-plot').length == 1")
        for key in ("#verdict", "#curve", "#advice + ul > li:first-child"):
            box = shown.locator(key).bounding_box()
            assert box["y"] + box["height"] <= size["height"], (path.name, key)
        text = shown.locator("#verdict, #hero").all_inner_texts()
        assert not any(word in one for one in text for word in ("NIS", "log units", "variance"))


@pytest.mark.parametrize("name", ["consistent", "unexplained", "everything"])
def test_pages_of_a_diagnosis(opened, tmp_path, name):
    path = tmp_path / f"{name}.html"
    path.write_text(diagnosed(name), encoding="utf-8")
    shown = opened(path, PHONE)
    shown.evaluate("allCharts()")
    assert shown.locator(".js-plotly-plot").count() == shown.locator(".chart > img").count()
    assert shown.evaluate("document.documentElement.scrollWidth") <= 400


def test_without_plotly_a_page_holds_its_pictures_alone(monkeypatch):
    find = plotly_chart.importlib.util.find_spec
    monkeypatch.setattr(plotly_chart.importlib.util, "find_spec",
                        lambda name: None if name == "plotly" else find(name))
    monkeypatch.setattr(page, "packed_library", plotly_chart.packed_library.__wrapped__)
    html = diagnosis_page(ALL["coulomb"](), Settings())
    assert "data:image/png" in html and "DecompressionStream" not in html


def axes_of(made) -> dict:
    return {key: value for key, value in made["layout"].items() if "axis" in key}


@pytest.fixture
def described() -> Figure:
    """A figure of two panels on one time axis, with a band, a line, marks, a level, a span."""
    t = np.linspace(0.0, 2.0, 50)
    top = Panel(Side(limits=(0.0, 2.0)), Side("position", Scale(1e3, "mm")))
    top.add(Band(t, 1e-3 * t - 1.0, 1e-3 * t + 1.0, "band", "#0072B2", 0.2),
            Curve(t, 1e-3 * t, "line", "#0072B2", dash="dash"),
            Level(0.5e-3, "", "#8A6100", dash="dot"),
            Span(0.5, 1.0, "", "#F0E442", 0.4, True))
    bottom = Panel(Side("time", Scale(1.0, "s"), "whole record", (0.0, 2.0)),
                   Side("residual", Scale(1e3, "mm")))
    bottom.add(Curve(np.array([0.5, 1.5]), np.array([3e-3, 4e-3]), "line, residual", "#0072B2",
                     0.0, marker="square", y_error=np.array([1e-4, 2e-4]), legend=False))
    return Figure((top, bottom), "words", (2.0, 1.0), on_time=True)


def test_a_chart_shows_what_is_described(described):
    made = chart(described)
    band, line, marks = made["data"]
    assert band["fill"] == "toself" and band["fillcolor"] == "rgba(0,114,178,0.2)"
    assert (line["name"], line["line"]["dash"], line["showlegend"]) == ("line", "dash", True)
    assert marks["yaxis"] == "y2" and marks["xaxis"] == "x" and marks["mode"] == "markers"
    assert marks["name"] == "line, residual" and not marks["showlegend"]
    assert read(marks["error_y"]["array"]) == pytest.approx([0.1, 0.2])
    assert read(line["y"]) == pytest.approx(np.linspace(0.0, 2.0, 50))
    level, span = sorted(made["layout"]["shapes"], key=lambda one: one["type"])
    assert (level["y0"], level["line"]["dash"], level["xref"]) == (
        pytest.approx(0.5), "dot", "x domain")
    assert (span["x0"], span["x1"], span["yref"]) == (0.5, 1.0, "y domain")
    assert set(axes_of(made)) == {"xaxis", "yaxis", "yaxis2"} and made["clock"] == 1.0
    assert made["layout"]["xaxis"]["title"]["text"] == "time, s — whole record"
    assert json.loads(chart_json(described))["clock"] == 1.0


def test_the_still_image_shows_the_same(described):
    made = drawn(described)
    top, bottom = made.axes
    assert top.get_lines()[0].get_ydata() == pytest.approx(np.linspace(0.0, 2.0, 50))
    assert top.get_xlim() == bottom.get_xlim() == (0.0, 2.0)
    assert [text.get_text() for text in top.get_legend().get_texts()] == ["band", "line"]
    assert bottom.get_legend() is None and bottom.get_xlabel() == "time, s — whole record"
    assert made._repr_png_()[1] == {"width": 580, "height": 400}


def test_scales_by_powers_and_rows_keep_their_labels():
    panel = Panel(Side("strength", log=True), Side(rows=("leakage", "friction")))
    panel.add(Curve(np.array([1.0, 100.0]), np.array([0.0, 1.0]), width=0.0, marker="circle"))
    figure = Figure((panel,), "words")
    found = axes_of(chart(figure))
    assert found["yaxis"]["ticktext"] == ["leakage", "friction"]
    assert found["xaxis"]["type"] == "log" and "100" in found["xaxis"]["ticktext"]
    axis = drawn(figure).axes[0]
    assert [text.get_text() for text in axis.get_yticklabels()] == ["leakage", "friction"]
    assert "100" in [text.get_text() for text in axis.get_xticklabels()]


def read(packed: dict) -> np.ndarray:
    """Read an array as plotly.js does."""
    return np.frombuffer(base64.b64decode(packed["bdata"]), "<" + packed["dtype"])


@pytest.mark.parametrize(("values", "kind"), [
    (np.linspace(0, 60, 1000), "f4"), (600 + 1e-5 * np.arange(9), "f8"), (np.full(3, 2.0), "f8")])
def test_numbers_are_rounded_where_no_eye_sees_it(values, kind):
    packed = numbers(values)
    assert packed["dtype"] == kind
    assert np.abs(read(packed) - values).max() <= 2e-5 * np.ptp(values)


def test_an_envelope_keeps_samples_where_they_are():
    rng = np.random.default_rng(3)
    time, values = np.arange(100_000) * 1e-3, rng.standard_normal(100_000)
    t, v = envelope(time, values, bins=300)
    assert len(t) <= 4 * 300 and (np.diff(t) > 0).all()
    assert (values[np.round(t / 1e-3).astype(int)] == v).all()
    first = values[:333]  # the first bin
    assert (first.min(), first.max()) == (v[t < 0.333].min(), v[t < 0.333].max())


def test_a_band_is_as_wide_as_it_is_anywhere_and_keeps_its_gap():
    time = np.arange(10_000) * 1e-3
    lower, upper = np.sin(time) - 1.0, np.sin(time) + 1.0
    lower[4321], upper[77] = -9.0, 9.0
    upper[6000:7000] = np.nan
    t, low, high = band_envelope(time, lower, upper, bins=50)
    assert np.nanmin(low) == -9.0 and np.nanmax(high) == 9.0 and len(t) <= 2 * 51 + 1
    assert np.isnan(low).sum() == np.isnan(high).sum() == 1
    assert time[5999] == t[np.flatnonzero(np.isnan(low))[0]]
