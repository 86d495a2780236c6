"""The page: built once for each browser, then kept up to date from the state."""

import math
import time
from pathlib import Path

from nicegui import ui

from eha_monitor.dashboard import actuator, charts, words
from eha_monitor.dashboard.state import STAGES, State, View, alarms
from eha_monitor.health.alarms import ALARM_NAMES, WATCHED
from eha_monitor.quantity import NOTE, SYMBOLS, readable

STYLE = Path(__file__).with_name("page.css")
# How often numbers and words are looked up, and how often the charts are drawn, s.
REFRESH_PERIOD, POSITION_PERIOD, CHART_PERIOD = 0.2, 0.5, 1.0
# Where the scale of the drawing shrinks: not at each pause of the motion.
_SHRINK = 4.0


def _tagged(element: ui.element, key: str) -> ui.element:
    """Give an element a name that stays, for tests and for whoever reads the page by program."""
    return element.props(f'data-testid="{key}"')


def _text(text: str = "", classes: str = "", key: str = "") -> ui.label:
    made = ui.label(text).classes(classes)
    return _tagged(made, key) if key else made


def _heading(rank: str, text: str) -> None:
    with ui.element(rank):
        ui.html(text, sanitize=False, tag="span")


class _Level:
    """A sign, a word and a colour."""

    def __init__(self, key: str):
        self._label = _text("", "level", key)
        self._shown = ("", "")

    def show(self, level: str, text: str = "") -> None:
        text = text or words.level_text(level)
        if (level, text) != self._shown:
            self._shown = level, text
            self._label.set_text(text)
            self._label.classes(replace=f"level level-{level.lower().replace(' ', '-')}")


class Page:
    """Builds the elements into the current NiceGUI context and keeps them up to date.

    Parameters
    ----------
    state : what is shown.
    topics : full names of the topics, by the keys of ``View.silence`` that are looked at.
    """

    def __init__(self, state: State, topics: dict[str, str]):
        self.state, self.topics = state, topics
        self._scales = words.scales(state.settings)
        self._unit = "rad" if state.settings.rig.motion == "rotary" else "m"
        self._half = 0.0
        ui.add_css(STYLE.read_text(encoding="utf-8"))
        with ui.element("main").classes("page"):
            self._build_head()
            self._figures = {w.symbol: self._build_estimate(w.symbol, w.words) for w in WATCHED}
            self._build_alarms()
            self._build_actuator()
            self._build_model()
        self.refresh()
        self.draw_position()
        self.draw_charts()
        ui.timer(REFRESH_PERIOD, self.refresh, immediate=False)
        ui.timer(POSITION_PERIOD, self.draw_position, immediate=True)
        ui.timer(CHART_PERIOD, self.draw_charts, immediate=True)

    def _build_head(self) -> None:
        with ui.element("header").classes("head wide"):
            _heading("h1", "Actuator health")
            self._rig = _text("", "note", "rig")
            ui.element("div").classes("grow")
            self._overall = _Level("overall")
        self._banner = _text("", "banner wide", "silence").props('role="alert"')

    def _build_estimate(self, symbol: str, title: str) -> dict:
        with ui.element("section").classes("card") as card:
            _heading("h2", f"{title.capitalize()} {SYMBOLS[symbol]}")
            with ui.element("div").classes("figure"):
                parts = {part: _text("", part, f"{symbol}-{part}")
                         for part in ("value", "stddev", "unit", "status")}
            chart = ui.echart(charts.estimate_frame(self._scales[symbol])).classes("chart")
        return {"card": card, "chart": chart, **parts}

    def _build_alarms(self) -> None:
        self._alarms = {}
        with ui.element("section").classes("card"):
            _heading("h2", "Alarms")
            for name in ALARM_NAMES:
                with ui.element("div").classes("alarm"):
                    level = _Level(f"{name}-level")
                    _text(words.plain_name(name), "name")
                    self._alarms[name] = (level, _text("", "message", f"{name}-message"))

    def _build_actuator(self) -> None:
        with ui.element("section").classes("card"):
            _heading("h2", "Actuator")
            with ui.element("div").classes("actuator") as self._drawing_box:
                _tagged(self._drawing_box, "actuator")
                self._drawing = ui.html("", sanitize=False)
            with ui.element("div").classes("positions"):
                self._positions = [_text("", "", key) for key in
                                   ("measured", "estimated", "difference")]
            self._position_scale = readable(0.02, self._unit)
            self._position_chart = ui.echart(
                charts.position_frame(self._position_scale)).classes("chart")

    def _build_model(self) -> None:
        with ui.element("section").classes("card wide"):
            _heading("h2", "Model and residual")
            with ui.element("div").classes("alarm"):
                self._model = _Level("model-level")
                self._model_status = _text("", "name", "model-status")
                self._model_message = _text("", "message", "model-message")
            with ui.element("div").classes("row title"):
                for title in ("innovations of", "size (NIS)", "drift (variance ratio)", "samples"):
                    ui.label(title)
            self._innovations = {}
            for stage in STAGES:
                with ui.element("div").classes("row"):
                    ui.label(words.plain_name(stage))
                    self._innovations[stage] = [
                        _text("", "", f"{stage}-{key}") for key in ("nis", "variance", "samples")]
            _text("Both are 1 if the model fits the data; the model is judged by whether they "
                  "stay near 1.", "note")
            self._residual_chart = ui.echart(charts.residual_frame()).classes("chart")
            self._data = _text("", "note", "data")
            _text(NOTE, "note", "plus-minus")

    def refresh(self) -> None:
        """Bring numbers, words and the piston up to date."""
        view = self.state.view(time.monotonic())
        silence = words.silence_text(view, self.state.settings, self.topics)
        self._banner.set_text(silence)
        self._banner.set_visibility(bool(silence))
        self._rig.set_text(f"rig {view.hardware}")
        self._overall.show(*words.overall(view))
        for alarm in alarms(view):
            level, message = self._alarms[alarm.name]
            level.show(alarm.word)
            message.set_text(alarm.message)
        for watched in WATCHED:
            self._refresh_estimate(view, watched.symbol)
        self._refresh_model(view)
        self._refresh_actuator(view)

    def _refresh_estimate(self, view: View, symbol: str) -> None:
        figure = self._figures[symbol]
        number = words.shown(view.value[symbol], view.stddev[symbol], self._scales[symbol])
        for part in ("value", "stddev", "unit"):
            figure[part].set_text(getattr(number, part))
        stage = next(s for s, w in zip(STAGES, WATCHED, strict=True) if w.symbol == symbol)
        figure["status"].set_text(words.stage_status(view, stage))
        monitor = self.state.settings.monitor
        old = monitor.stale_after + 1.0 / monitor.publish_rate < view.silence[symbol] < math.inf
        if old != ("old" in figure["card"].classes):
            figure["card"].classes(**{"add" if old else "remove": "old"})

    def _refresh_model(self, view: View) -> None:
        found = view.findings.get("model_mismatch")
        self._model.show(found.word if found else "STALE")
        self._model_status.set_text(words.model_status(view))
        self._model_message.set_text(found.message if found else "nothing received yet")
        for stage, labels in self._innovations.items():
            for label, text in zip(labels, words.innovation_texts(view, stage), strict=True):
                label.set_text(text)
        self._data.set_text(words.data_text(view))

    def _refresh_actuator(self, view: View) -> None:
        texts = words.position_texts(view, self._position_scale)
        for label, text in zip(self._positions, texts, strict=True):
            label.set_text(text)
        if self._half:
            self._drawing_box.style(
                f"--measured: {actuator.place(view.measured, self._half)}; "
                f"--estimated: {actuator.place(view.estimated, self._half)}")

    def draw_position(self) -> None:
        """Bring the chart of the position up to date, and the scale of the drawing."""
        rows = {name: self.state.history(name) for name in ("measured", "estimated")}
        half = actuator.half_range([row[1] for history in rows.values() for row in history])
        if half > self._half or half * _SHRINK < self._half:
            self._half = half
            self._drawing.set_content(actuator.drawing(half, self._unit))
        _put(self._position_chart, charts.position_data(rows, self._position_scale))

    def draw_charts(self) -> None:
        """Bring the charts of the last minutes up to date."""
        now = time.time()
        for symbol, figure in self._figures.items():
            _put(figure["chart"], charts.estimate_data(
                self.state.history(symbol), self.state.limits(symbol), self._scales[symbol], now))
        _put(self._residual_chart, charts.residual_data(
            {stage: self.state.history(stage) for stage in STAGES}, now))


def _put(chart: ui.echart, data: dict) -> None:
    """Hand a chart what has moved, without sending its frame again."""
    chart.run_chart_method("setOption", data)
