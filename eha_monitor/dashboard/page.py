"""The page: built once for each browser, then kept up to date from the states."""

import time
from pathlib import Path
from urllib.parse import urlencode

from nicegui import ui

from eha_monitor.dashboard import words
from eha_monitor.dashboard.detail import Detail, Level, button, heading, tagged, text
from eha_monitor.dashboard.events import QUALITY, EventLog
from eha_monitor.dashboard.state import CHOICES, Actuator, Span, View
from eha_monitor.health.alarms import WATCHED
from eha_monitor.health.judge import SEVERITY

STYLE, SCRIPT = (Path(__file__).with_name(f"page.{kind}") for kind in ("css", "js"))
# How often numbers and words are looked up, and how often the charts are drawn, s.
REFRESH_PERIOD, POSITION_PERIOD, CHART_PERIOD = 0.2, 0.5, 1.0
_EVENTS = 12  # events on the page; all that are kept are in the file


class Page:
    """Builds the elements into the current NiceGUI context and keeps them up to date."""

    def __init__(self, shown: dict[str, Actuator], log: EventLog):
        self.shown, self.log, self.span = shown, log, Span()
        wanted = ui.context.client.request.query_params.get("actuator", "")
        self.chosen = wanted if wanted in shown else next(iter(shown))
        self._logged = (-1, "")
        self._title = ""
        ui.colors(primary="#0d4f86")
        ui.add_css(STYLE.read_text(encoding="utf-8"))
        ui.add_body_html(f"<script>\n{SCRIPT.read_text(encoding='utf-8')}</script>")
        with ui.element("main").classes("page"):
            self._build_head()
            self._tiles = {name: self._build_tile(name) for name in shown}
            self._build_controls()
            with ui.element("div").classes("cards wide") as self._cards:
                pass
            self._build_log()
        self._build_detail()
        ui.timer(REFRESH_PERIOD, self.refresh, immediate=False)
        ui.timer(POSITION_PERIOD, lambda: self.detail.draw_position(), immediate=True)
        ui.timer(CHART_PERIOD, lambda: self.detail.draw_charts(), immediate=True)

    def choose(self, name: str) -> None:
        """Show another actuator in full."""
        if name == self.chosen:
            return
        self.chosen = name
        ui.navigate.history.replace(f"/?{urlencode({'actuator': name})}")
        self._build_detail()

    def _build_detail(self) -> None:
        self._cards.clear()
        with self._cards:
            self.detail = Detail(self.shown[self.chosen], self.span, self._follow_span)
        self._follow_span()
        self.refresh()
        self.detail.draw_position()

    def _build_head(self) -> None:
        with ui.element("header").classes("head wide"):
            self._name = tagged(heading("h1", ""), "name")
            self._overall = Level("overall")
            ui.element("div").classes("grow")
            self._live = Level("live")
        self._where = text("", "note wide", "rig")
        self._banner = text("", "banner wide", "silence").props('role="alert"')
        with ui.element("nav").classes("tiles wide") as self._strip:
            pass

    def _build_tile(self, name: str) -> tuple:
        """Make the short form of an actuator, by which it is chosen."""
        with self._strip, ui.element("button").classes("tile") as tile:
            tagged(tile, f"tile-{name}")
            tile.on("click", lambda: self.choose(name))
            with ui.element("div").classes("title"):
                text(name, "name")
                level = Level(f"tile-{name}-level")
            numbers = [text("", "number") for _ in WATCHED]
            last = text("", "note")
        self._strip.set_visibility(len(self.shown) > 1)
        return tile, level, numbers, last

    def _build_controls(self) -> None:
        with ui.element("div").classes("controls wide"):
            text("Charts show", "note")
            tagged(ui.toggle(list(CHOICES), value=self.span.choice,
                             on_change=lambda event: self._choose_span(event.value)
                             ).props("no-caps unelevated dense"), "range")
            self._back = button("Follow the data again", "back",
                                lambda: self._choose_span(self.span.choice))
            self._zoomed = text("", "note", "zoomed")
            self._hint = text("drag over a chart to look closer", "note mouse")
            ui.element("div").classes("grow")
            with tagged(ui.element("a").classes("plain"), "csv") as self._csv:
                ui.label("CSV of the charts")

    def _choose_span(self, choice: str) -> None:
        self.span.choose(choice)
        self.detail.reset_zoom()
        self._follow_span()

    def _follow_span(self) -> None:
        """Bring charts and controls to the chosen stretch of time."""
        zoom = self.span.zoom
        self._back.set_visibility(zoom is not None)
        self._zoomed.set_text("" if zoom is None else " to ".join(
            words.clock_text(each) for each in zoom) + ", held")
        self._hint.set_visibility(zoom is None)
        self._csv.props(f'href="/estimates.csv?{self.span.query(self.chosen)}" download')
        self.detail.draw_charts()

    def _build_log(self) -> None:
        with ui.element("section").classes("card wide"):
            with ui.element("div").classes("title"):
                heading("h2", "Events")
                ui.element("div").classes("grow")
                quality = ui.checkbox("with warnings about the samples").props("dense")
                self._quality = tagged(quality, "quality")
                with tagged(ui.element("a").classes("plain"), "events-csv").props(
                        'href="/events.csv" download'):
                    ui.label("CSV of all events")
            self._events = tagged(ui.element("div").classes("events"), "events")
            self._older = text("", "note")

    def refresh(self) -> None:
        """Bring everything but the charts up to date."""
        now = time.monotonic()
        views = {name: each.state.view(now) for name, each in self.shown.items()}
        self._refresh_head(views[self.chosen])
        for name, view in views.items():
            self._refresh_tile(name, view)
        self.detail.refresh(views[self.chosen])
        self._refresh_title(views)
        self._refresh_log()

    def _refresh_head(self, view: View) -> None:
        shown = self.shown[self.chosen]
        silence = words.silence_text(view, shown.state.settings, shown.topics)
        self._banner.set_text(silence)
        self._banner.set_visibility(bool(silence))
        self._name.set_text(f"Actuator {shown.name}")
        live, last = words.last_data(view, time.time())
        self._live.show("OK" if live else "STALE", "● live" if live else "◌ no data")
        rig = f"rig {view.hardware}, " if view.hardware != shown.name else ""
        self._where.set_text(f"{rig}{last}, namespace {shown.namespace}, "
                             f"ROS domain {shown.domain}")
        level, content = words.overall(view)
        quiet = words.quiet(view)
        self._overall.show(level, content + ", acknowledged" * quiet, quiet)

    def _refresh_tile(self, name: str, view: View) -> None:
        tile, level, numbers, last = self._tiles[name]
        if len(self.shown) < 2:
            return
        level.show(*words.overall(view), quiet=words.quiet(view))
        scales = words.scales(self.shown[name].state.settings)
        for watched, label in zip(WATCHED, numbers, strict=True):
            symbol = watched.symbol
            number = words.shown(view.value[symbol], view.stddev[symbol], scales[symbol])
            label.set_text(words.short(symbol, number))
        asks = len(words.waiting(view))
        last.set_text(f"{asks} to acknowledge" if asks else
                      words.last_data(view, time.time())[1].partition(", stamped")[0])
        here = name == self.chosen
        if here != ("chosen" in tile.classes):
            tile.classes(**{"add" if here else "remove": "chosen"})
            tile.props(f'aria-pressed="{"true" if here else "false"}"')

    def _refresh_title(self, views: dict[str, View]) -> None:
        """Say in the browser's tab what is worst and whether it asks for somebody."""
        asks = sum(len(words.waiting(view)) for view in views.values())
        worst = max((words.overall(view)[0] for view in views.values()), key=SEVERITY.index)
        title = (f"({asks}) " if asks else "") + f"{words.level_text(worst)}: " + (
            self.chosen if len(views) == 1 else f"{len(views)} actuators")
        if title != self._title:
            self._title = title
            ui.page_title(title)

    def _refresh_log(self) -> None:
        without = "" if self._quality.value else QUALITY
        if (self.log.count, without) == self._logged:
            return
        self._logged = self.log.count, without
        found = self.log.latest(without=without)
        self._events.clear()
        with self._events:
            for event in found[:_EVENTS]:
                with ui.element("div").classes("event"):
                    text(words.clock_text(event.time_s), "time")
                    sign = words.SIGNS.get(event.level, "")
                    whose = f"{event.actuator}: " if len(self.shown) > 1 else ""
                    text(f"{sign} {whose}{event.kind}".strip(), "kind")
                    text(event.text, "message").props("tabindex=0")
        more = len(found) - _EVENTS
        nothing = "" if found else "Nothing has changed since the dashboard was started."
        self._older.set_text(f"{more} older ones are in the file." if more > 0 else nothing)
