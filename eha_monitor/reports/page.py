"""From context to one HTML file that needs nothing else."""

import re
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from typing import Any

import jinja2
from markupsafe import Markup

from eha_monitor import __version__
from eha_monitor.quantity import NOTE
from eha_monitor.reports.charts import packed_library

_HEADING = re.compile(r"<h2(?: id=\"([^\"]*)\")?>(.*?)</h2>", re.DOTALL)


@dataclass(frozen=True)
class Contents:
    """A page's text with an id at each heading, and id and words of each."""

    body: Markup
    links: tuple[tuple[str, Markup], ...]


@lru_cache(maxsize=1)
def _environment() -> jinja2.Environment:
    made = jinja2.Environment(
        loader=jinja2.PackageLoader("eha_monitor.reports"), autoescape=True,
        undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    made.filters |= {"contents": contents, "for_script": for_script}
    return made


def render(template: str, **context: Any) -> str:
    """Return a page of ``templates/``; every value is HTML-escaped.

    plotly.js and the page's own script go into it where there is a chart to draw.
    """
    text = _environment().get_template(template).render(
        **{"version": __version__, "plus_minus": NOTE, **context})
    if '<script type="application/json">' in text and (library := packed_library()):
        own = resources.files("eha_monitor.reports").joinpath("templates/charts.js").read_text(
            encoding="utf-8")
        text = text.replace("</body>", f'<script type="text/plain" id="plotly">{library}</script>'
                                       f"\n<script>\n{own}</script>\n</body>")
    return text


def contents(body: Markup) -> Contents:
    """Return what a list of contents needs: headings without an id get one of their words.

    >>> contents(Markup("<h2>Identifiability from the channels</h2>")).links
    (('identifiability-from-the-channels', Markup('Identifiability from the channels')),)
    """
    links: list[tuple[str, Markup]] = []

    def marked(found: re.Match) -> str:
        words = Markup(found[2])
        key = found[1] or "-".join(re.findall(r"\w+", words.striptags().lower()))
        links.append((key, words))
        return f'<h2 id="{key}">{words}</h2>'

    return Contents(Markup(_HEADING.sub(marked, str(body))), tuple(links))


def for_script(text: str) -> Markup:
    """Return JSON so that nothing in it ends the script element that holds it."""
    return Markup(text.replace("<", "\\u003c").replace("\u2028", "\\u2028"))
