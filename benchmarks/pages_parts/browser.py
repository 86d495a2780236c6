"""A headless Chromium of this machine that looks at a page as two screens and a printer do."""

import shutil
from dataclasses import dataclass
from pathlib import Path

WIDTHS = (1280, 400)  # CSS pixels
FLAGS = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
         "--disable-background-networking", "--disable-component-update", "--disable-sync"]


@dataclass(frozen=True)
class Seen:
    """What a browser made of a page: interactive charts, and what it complained of."""

    charts: int
    complaints: tuple[str, ...]


class Browser:
    """A context around one Chromium."""

    def __enter__(self) -> "Browser":
        from playwright.sync_api import sync_playwright

        path = shutil.which("chromium") or shutil.which("google-chrome")
        if path is None:
            raise SystemExit("no chromium on this machine (apt-get install chromium)")
        self._playwright = sync_playwright().start()
        self._browser = self._playwright.chromium.launch(executable_path=path, args=FLAGS)
        return self

    def __exit__(self, *exception) -> None:
        self._browser.close()
        self._playwright.stop()

    def clip(self, page: Path, first: str, last: str, picture: Path) -> None:
        """Take the picture of a page from one of its elements to another, for the docs."""
        opened = self._browser.new_page(viewport={"width": WIDTHS[0], "height": 900})
        opened.goto(page.resolve().as_uri())
        opened.evaluate("() => window.allCharts()")
        opened.evaluate("() => document.querySelector('.contents').style.position = 'static'")
        ends = [opened.locator(one).first.bounding_box() for one in (first, last)]
        top, bottom = ends[0]["y"] - 8, ends[1]["y"] + ends[1]["height"] + 8
        opened.screenshot(path=picture, full_page=True, clip={
            "x": 10, "y": max(top, 0), "width": WIDTHS[0] - 20, "height": bottom - max(top, 0)})
        opened.close()

    def look(self, page: Path) -> Seen:
        """Take the pictures of a page beside it."""
        complaints: list[str] = []
        charts = 0
        for width in WIDTHS:
            opened = self._browser.new_page(viewport={"width": width, "height": 900})
            opened.on("console", lambda one: complaints.append(one.text)
                      if one.type in ("error", "warning") else None)
            opened.on("pageerror", lambda one: complaints.append(str(one)))
            opened.on("request", lambda one: complaints.append(f"asks for {one.url}")
                      if not one.url.startswith(("file:", "data:", "blob:")) else None)
            opened.goto(page.resolve().as_uri())
            opened.evaluate("() => window.allCharts ? window.allCharts() : null")
            charts = opened.locator(".js-plotly-plot").count()
            too_wide = opened.evaluate(
                "() => document.documentElement.scrollWidth - innerWidth")
            if too_wide > 0:
                complaints.append(f"{too_wide} px too wide at {width}")
            opened.screenshot(path=page.with_name(f"{page.stem}-{width}.png"), full_page=True)
            if width == WIDTHS[0]:
                opened.pdf(path=page.with_name(f"{page.stem}-print.pdf"), format="A4",
                           print_background=True)
            opened.close()
        return Seen(charts, tuple(dict.fromkeys(complaints)))
