"""The part of the page that shows one actuator in full, and the small parts of every page."""

import json
import math
import time
from collections.abc import Callable

from nicegui import ui

from eha_monitor.dashboard import charts, words
from eha_monitor.dashboard.state import STAGES, Actuator, Span, State, View, alarms, thinned
from eha_monitor.health.alarms import ALARM_NAMES, NO_LIMIT, WATCHED, Watched
from eha_monitor.health.judge import DIAGNOSIS, MACHINE, MISMATCH
from eha_monitor.quantity import NOTE, SYMBOLS, readable


def tagged(element: ui.element, key: str) -> ui.element:
    """Give an element a name that stays, for tests and for whoever reads the page by program."""
    return element.props(f'data-testid="{key}"')


def text(content: str = "", classes: str = "", key: str = "") -> ui.label:
    """Make a text."""
    made = ui.label(content).classes(classes)
    return tagged(made, key) if key else made


def heading(rank: str, content: str) -> ui.label:
    """Make a heading, ``h1`` or ``h2``."""
    with ui.element(rank):
        return ui.label(content)


def button(label: str, key: str, on_click=None) -> ui.button:
    """Make a plain button, large enough for a finger."""
    made = ui.button(label, on_click=on_click, color=None).props("no-caps unelevated dense")
    return tagged(made.classes("plain"), key)


class Level:
    """A sign, a word and a colour; quiet, without the colour, where it is acknowledged."""

    def __init__(self, key: str):
        self._label = text("", "level", key)
        self._shown = ("", "", False)

    def show(self, level: str, content: str = "", quiet: bool = False) -> None:
        """Show a level, with other words than its own where they are given."""
        content = content or words.level_text(level)
        if (level, content, quiet) != self._shown:
            self._shown = level, content, quiet
            self._label.set_text(content)
            self._label.classes(replace=f"level level-{level.lower().replace(' ', '-')}"
                                        + (" quiet" if quiet else ""))


# ---- acknowledging an alarm: the name is kept in that browser for the next time ---------------

_LONGEST = 40  # characters of a name
_KEY = "eha_monitor_name"
_LOCAL = ("127.0.0.1", "::1", "")


def who_is(name: str, address: str) -> str:
    """Return how a person is written down: the name, and the machine if it is another one.

    >>> who_is(" Ada ", "127.0.0.1"), who_is("Ada", "10.0.0.7")
    ('Ada', 'Ada (10.0.0.7)')
    """
    name = " ".join(name.split())[:_LONGEST]
    return name if address in _LOCAL else f"{name} ({address})"


async def ask_for_acknowledgement(state: State, alarm: str) -> None:
    """Ask for the name, then acknowledge one alarm of an actuator."""
    client = ui.context.client
    try:
        known = await ui.run_javascript(f"localStorage.getItem('{_KEY}') || ''", timeout=2.0)
    except TimeoutError:
        known = ""
    with ui.dialog(value=True) as dialog, ui.element("div").classes("card dialog"):
        heading("h2", f"Acknowledge: {words.plain_name(alarm)}, {state.name}")
        name = tagged(ui.input("Your name", value=str(known)[:_LONGEST]).props(
            f"maxlength={_LONGEST} autofocus"), "who")

        def acknowledge() -> None:
            if not (name.value or "").strip():
                name.error = "expected a name, for those who look here later"
                return
            ui.run_javascript(f"localStorage.setItem('{_KEY}', "
                              "document.querySelector('[data-testid=who]').value)")
            state.acknowledge([alarm], who_is(name.value, client.ip or ""))
            dialog.close()

        name.on("keydown.enter", acknowledge)
        ui.label("The alarm stays on the page and no longer asks for attention, until it clears "
                 "or gets worse.").classes("note")
        with ui.element("div").classes("buttons"):
            button("Cancel", "cancel", dialog.close)
            button("Acknowledge", "confirm", acknowledge)
    dialog.on("hide", dialog.delete)


_SHRINK = 4.0  # where the scale of the drawing shrinks: not at each pause of the motion
_MOST_ROWS = 700  # rows of a line: more than a chart has pixels are not sent


class Detail:
    """Builds the cards of an actuator into the current NiceGUI context and keeps them up to date.

    ``span`` : which time the charts show; ``on_zoom`` is called when one has been dragged there.
    """

    def __init__(self, shown: Actuator, span: Span, on_zoom: Callable[[], None]):
        self.shown, self.state, self.span, self._on_zoom = shown, shown.state, span, on_zoom
        self._scales = words.scales(self.state.settings)
        self._unit = "rad" if self.state.settings.rig.motion == "rotary" else "m"
        self._half = 0.0
        self._figures = {w.symbol: self._build_estimate(w.symbol, w.words) for w in WATCHED}
        self._alarms: dict[str, tuple] = {}
        self._build_alarms()
        self._build_actuator()
        self._build_model()
        self._build_diagnosis()

    def _build_estimate(self, symbol: str, title: str) -> dict:
        name = f"{title.capitalize()} {SYMBOLS[symbol]}"
        with ui.element("section").classes("card") as card:
            with ui.element("div").classes("title"):
                heading("h2", name)
                picture = button("PNG", f"{symbol}-png")
            with ui.element("div").classes("figure"):
                parts = {part: text("", part, f"{symbol}-{part}")
                         for part in ("value", "stddev", "unit", "status")}
            chart = self._chart(charts.estimate_frame(self._scales[symbol]), name, picture)
        return {"card": card, "chart": chart, **parts}

    def _chart(self, frame: dict, name: str, picture: ui.button) -> ui.echart:
        """Make a chart of the last minutes: dragged on it is a stretch of time."""
        chart = ui.echart(frame).classes("chart")
        chart.on("chart:datazoom", lambda event: self._dragged(event.args), args=["batch"])
        ui.timer(0.2, lambda: ui.run_javascript(f"ehaDrag({chart.id})"), once=True)
        picture.on_click(lambda: self._save_picture(chart, name))
        return chart

    def _dragged(self, event: dict) -> None:
        batch = (event or {}).get("batch") or [{}]
        first, last = (_seconds(batch[0].get(key)) for key in ("startValue", "endValue"))
        zone = charts.zone_s()
        if self.span.drag(first - zone, last - zone):
            self.reset_zoom()
            self._on_zoom()

    def reset_zoom(self) -> None:
        """Let each chart show the whole of its axis: the axis itself is what was chosen."""
        whole = {"type": "dataZoom", "start": 0, "end": 100}
        for chart in (*(each["chart"] for each in self._figures.values()), self._residual_chart):
            chart.run_chart_method("dispatchAction", whole)

    def _save_picture(self, chart: ui.echart, name: str) -> None:
        now = time.strftime("%Y-%m-%d %H:%M:%S %Z")
        title = f"{self.shown.name}: {name}"
        file = f"{self.shown.name}_{name.replace(' ', '_')}_{time.strftime('%Y%m%dT%H%M%S')}.png"
        ui.run_javascript("ehaPicture(" + ", ".join(
            [str(chart.id), *(_literal(each) for each in (title, f"saved {now}", file))]) + ")")

    def _build_alarms(self) -> None:
        with ui.element("section").classes("card"):
            heading("h2", "Alarms")
            for name in ALARM_NAMES:
                self._build_alarm(name, words.plain_name(name))

    def _build_alarm(self, name: str, title: str, key: str = "") -> ui.label:
        key = key or name
        with ui.element("div").classes("alarm"):
            level = Level(f"{key}-level")
            label = text(title, "name")
            message = text("", "message", f"{key}-message")
            given = text("", "message by", f"{key}-acknowledged")
            with ui.element("div").classes("answer") as answer:
                button("Acknowledge", f"{key}-acknowledge",
                                lambda: ask_for_acknowledgement(self.state, name))
        self._alarms[name] = level, message, given, answer
        return label

    def _build_actuator(self) -> None:
        with ui.element("section").classes("card"):
            with ui.element("div").classes("title"):
                heading("h2", "Position, the last 15 s")
                picture = button("PNG", "position-png")
            with ui.element("div").classes("actuator") as self._drawing_box:
                tagged(self._drawing_box, "actuator")
                self._drawing = ui.html("", sanitize=False)
            with ui.element("div").classes("positions"):
                self._positions = [text("", "", key) for key in
                                   ("measured", "estimated", "difference")]
            self._position_scale = readable(0.02, self._unit)
            self._position_chart = ui.echart(
                charts.position_frame(self._position_scale)).classes("chart")
            picture.on_click(lambda: self._save_picture(self._position_chart, "Position"))

    def _build_model(self) -> None:
        with ui.element("section").classes("card wide"):
            with ui.element("div").classes("title"):
                heading("h2", "Model and residual")
                picture = button("PNG", "residual-png")
            self._model_status = self._build_alarm(MISMATCH, "", "model")
            tagged(self._model_status, "model-status")
            with ui.element("div").classes("line names"):
                for title in ("innovations of", "size (NIS)", "drift (variance ratio)", "samples"):
                    ui.label(title)
            self._innovations = {}
            for stage in STAGES:
                with ui.element("div").classes("line"):
                    ui.label(words.plain_name(stage))
                    self._innovations[stage] = [text("", "", f"{stage}-{key}")
                                                for key in ("nis", "variance", "samples")]
            text("Both are 1 where the model explains the data; what is judged is "
                          "whether they stay near it.", "note")
            self._residual_chart = self._chart(charts.residual_frame(), "Innovations", picture)
            self._data = text("", "note", "data")
            text(NOTE, "note", "plus-minus")

    def _build_diagnosis(self) -> None:
        with ui.element("section").classes("card wide") as self._diagnosis:
            heading("h2", "Diagnosis")
            self._machine_row = ui.element("div").classes("alarm")
            with self._machine_row:
                self._machine_level = Level("machine-level")
                self._machine = text("", "name", "machine")
            with ui.element("div").classes("alarm"):
                self._verdict = Level("diagnosis-level")
                self._diagnosed = text("", "name", "diagnosis")
            self._diagnosis_lines = text("", "note lines", "diagnosis-lines")

    def _refresh_diagnosis(self, view: View) -> None:
        """Show the card once a monitor tells of a diagnosis."""
        head = view.diagnosis.get(DIAGNOSIS)
        self._diagnosis.set_visibility(head is not None)
        if head is not None:
            verdict = str(head.values.get("verdict", ""))
            self._verdict.show(head.word, f"{words.SIGNS[head.word]} {verdict or 'none yet'}")
            self._diagnosed.set_text(head.message)
            machine = view.diagnosis.get(MACHINE)
            self._machine_row.set_visibility(machine is not None)
            if machine is not None:
                self._machine_level.show(machine.word, f"{words.SIGNS[machine.word]} machine")
                self._machine.set_text(words.local_times(machine))
            self._diagnosis_lines.set_text("\n".join(words.diagnosis_lines(view)))

    def refresh(self, view: View) -> None:
        """Bring numbers, words and the piston up to date."""
        for alarm in alarms(view):
            self._refresh_alarm(view, alarm.name, alarm.word, alarm.message)
        for stage, watched in STAGES.items():
            self._refresh_estimate(view, watched, stage)
        found = view.findings.get(MISMATCH)
        self._refresh_alarm(view, MISMATCH, found.word if found else "STALE",
                            found.message if found else "nothing heard yet")
        self._model_status.set_text(words.model_status(view))
        for stage, labels in self._innovations.items():
            for label, content in zip(labels, words.innovation_texts(view, stage), strict=True):
                label.set_text(content)
        self._data.set_text(words.data_text(view))
        self._refresh_actuator(view)
        self._refresh_diagnosis(view)

    def _refresh_alarm(self, view: View, name: str, word: str, content: str) -> None:
        level, message, given, answer = self._alarms[name]
        level.show("STALE" if content == NO_LIMIT else word,
                   "–" if content == NO_LIMIT else "", name in view.acknowledged)
        message.set_text(content)
        by = words.acknowledged_text(view, name)
        given.set_text(by)
        given.set_visibility(bool(by))
        answer.set_visibility(name in words.waiting(view))

    def _refresh_estimate(self, view: View, watched: Watched, stage: str) -> None:
        symbol = watched.symbol
        figure = self._figures[symbol]
        number = words.shown(view.value[symbol], view.stddev[symbol], self._scales[symbol])
        for part in ("value", "stddev", "unit"):
            figure[part].set_text(getattr(number, part))
        status, doubted = words.estimate_status(view, watched.section, stage)
        figure["status"].set_text(status)
        monitor = self.state.settings.monitor
        old = doubted or (
            monitor.stale_after + 1.0 / monitor.publish_rate < view.silence[symbol] < math.inf)
        if old != ("old" in figure["card"].classes):
            figure["card"].classes(**{"add" if old else "remove": "old"})

    def _refresh_actuator(self, view: View) -> None:
        texts = words.position_texts(view, self._position_scale)
        for label, content in zip(self._positions, texts, strict=True):
            label.set_text(content)
        if self._half:
            self._drawing_box.style(
                f"--measured: {charts.place(view.measured, self._half)}; "
                f"--estimated: {charts.place(view.estimated, self._half)}")

    def draw_position(self) -> None:
        """Bring the chart of the position up to date, and the scale of the drawing."""
        rows = self.state.positions()
        half = charts.half_range([row[1] for history in rows.values() for row in history])
        if half > self._half or half * _SHRINK < self._half:
            self._half = half
            self._drawing.set_content(charts.drawing(half, self._unit))
        _put(self._position_chart, charts.position_data(rows, self._position_scale))

    def draw_charts(self) -> None:
        """Bring the charts of the chosen time up to date."""
        now = time.monotonic()
        today = self.state.time_of_day(now, now)
        since = self.span.since(today)
        until = math.inf if self.span.zoom is None else self.span.zoom[1]
        rows = {name: thinned([row for row in self.state.history(name, now, since)
                               if row[0] <= until], _MOST_ROWS)
                for name in (*self._figures, *STAGES)}
        first = min((each[0][0] for each in rows.values() if each), default=math.inf)
        ends = self.span.zoom or charts.ends_of(first, today, today - since if math.isfinite(
            since) else None)
        for symbol, figure in self._figures.items():
            _put(figure["chart"], charts.estimate_data(
                rows[symbol], self.state.limits(symbol), self._scales[symbol], ends))
        _put(self._residual_chart, charts.residual_data({s: rows[s] for s in STAGES}, ends))


def _put(chart: ui.echart, data: dict) -> None:
    """Hand a chart what has moved, without sending its frame again."""
    chart.run_chart_method("setOption", data)


def _seconds(milliseconds: object) -> float:
    """Return a time that a browser sent, s; NaN where that is no number."""
    number = isinstance(milliseconds, int | float) and not isinstance(milliseconds, bool)
    return 1e-3 * milliseconds if number else math.nan


def _literal(content: str) -> str:
    """Return a text as JavaScript writes it."""
    return json.dumps(content).replace("<", "\\u003c")
