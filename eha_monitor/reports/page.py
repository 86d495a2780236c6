"""From tables, figures and sentences to one HTML file that needs nothing else."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from typing import Any

import jinja2
from markupsafe import Markup, escape

from eha_monitor import __version__
from eha_monitor.quantity import NOTE
from eha_monitor.reports.figure import Figure
from eha_monitor.reports.plotly_chart import chart_json, packed_library
from eha_monitor.reports.still_image import image_uri

_HEADING = re.compile(r"<h2(?: id=\"([^\"]*)\")?>(.*?)</h2>", re.DOTALL)
_MOST_OPEN = 6  # rows of a long table that are shown without a click


@dataclass(frozen=True)
class Cell:
    """A cell of a table.

    Attributes
    ----------
    text : what it says; ``note`` in small letters under it.
    kind : classes of its look: ``value``, ``number``, ``key``, ``message``, ``good``, ...
    badge : level or status that is set off by its colour, behind the text; ``level`` names the
        colour where that is not the badge itself.
    exact : the value and its standard deviation, SI, for whoever reads the page by program.
    title : what a mouse that rests there reads.
    mark, link : name of the number for programs, address that the text leads to.
    """

    text: str
    kind: str = ""
    note: str = ""
    badge: str = ""
    level: str = ""
    exact: tuple[float, float | None] | None = None
    title: str = ""
    mark: str = ""
    link: str = ""


@dataclass(frozen=True)
class Table:
    """Rows of cells under a head; on a phone each row is a card with the heads as labels.

    ``rest`` rows are shown on request; ``key`` is the id in the page, ``note`` stands below.
    """

    head: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    key: str = ""
    note: str = ""
    rest: tuple[tuple[Cell, ...], ...] = ()

    def __bool__(self) -> bool:
        """Return whether there is a row to show."""
        return bool(self.rows)


@dataclass(frozen=True)
class FirstScreen:
    """What fits on one screen: the verdict, the picture, B and beta_e, and what to do.

    Attributes
    ----------
    kind : ``ok``, ``warn``, ``error`` or ``unknown``: the colour of the verdict.
    head, message : its first words and its sentence; ``doubts`` limit it.
    wrong : what is wrong with the config, said before the verdict, each with its doubt or "".
    channels : what stands against the channels, said before all.
    picture, caption : the figure that shows it.
    parameters : B and beta_e, and what is to be read of them.
    sentences : what the verdict means for them.
    actions : what to do, the most important first.
    verdict : for programs.
    """

    kind: str
    head: str
    message: str
    doubts: tuple[str, ...] = ()
    wrong: tuple[tuple[str, str], ...] = ()
    picture: Figure | None = None
    caption: str = ""
    parameters: Table | None = None
    sentences: tuple[str, ...] = ()
    actions: tuple[str, ...] = ()
    verdict: str = ""
    channels: tuple[str, ...] = ()


@dataclass(frozen=True)
class Contents:
    """A page's text with an id at each heading, and id and words of each."""

    body: Markup
    links: tuple[tuple[str, Markup], ...]


def table(head: str, rows: Sequence[Sequence[str | Cell]], kinds: str = "", key: str = "",
          note: str = "", fold: bool = False) -> Table:
    """Return a table.

    Parameters
    ----------
    head : names of the columns, with ``|`` between.
    rows : of cells; those that are text get the look of their column.
    kinds : looks of the columns, with ``|`` between.
    fold : whether a long one shows its first rows only, until more are requested.
    """
    names = tuple(part.strip() for part in head.split("|"))
    looks = [part.strip() for part in kinds.split("|")] if kinds else [""] * len(names)
    made = tuple(tuple(one if isinstance(one, Cell) else Cell(str(one), looks[i])
                       for i, one in enumerate(row)) for row in rows)
    shown = _MOST_OPEN if fold and len(made) > _MOST_OPEN + 2 else len(made)
    return Table(names, made[:shown], key, note, made[shown:])


def markdown(one: Table) -> str:
    """Return a table in Markdown."""
    lines = [one.head, ("---",) * len(one.head),
             *(tuple(cell.text for cell in row) for row in (*one.rows, *one.rest))]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


@lru_cache(maxsize=1)
def _environment() -> jinja2.Environment:
    made = jinja2.Environment(
        loader=jinja2.PackageLoader("eha_monitor.reports"), autoescape=True,
        undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    made.filters |= {"contents": contents, "for_script": for_script, "image": image_uri,
                     "chart": chart_json, "coded": coded}
    return made


def render(template: str, **context: Any) -> str:
    """Return a page of ``templates/``; every value is HTML-escaped.

    plotly.js and the page's own script go into it where there is a chart to draw.
    """
    library = packed_library()
    text = _environment().get_template(template).render(
        **{"version": __version__, "plus_minus": NOTE, "interactive": bool(library), **context})
    if library and '<script type="application/json">' in text:
        own = resources.files("eha_monitor.reports").joinpath("templates/charts.js").read_text(
            encoding="utf-8")
        text = text.replace("</body>", f'<script type="text/plain" id="plotly">{library}</script>'
                                       f"\n<script>\n{own}</script>\n</body>")
    return text


def contents(body: Markup) -> Contents:
    """Return what a list of contents needs: headings without an id get one of their words.

    >>> contents(Markup("<h2>Measured and estimated motion</h2>")).links
    (('measured-and-estimated-motion', Markup('Measured and estimated motion')),)
    """
    links: list[tuple[str, Markup]] = []

    def marked(found: re.Match) -> str:
        words = Markup(found[2])
        key = found[1] or "-".join(re.findall(r"\w+", words.striptags().lower()))
        links.append((key, words))
        return f'<h2 id="{key}">{words}</h2>'

    return Contents(Markup(_HEADING.sub(marked, str(body))), tuple(links))


def coded(text: str) -> Markup:
    """Return an escaped text in which what stands between backticks is code.

    >>> coded("run `advise <bag>`")
    Markup('run <code>advise &lt;bag&gt;</code>')
    """
    return Markup(re.sub("`([^`]*)`", r"<code>\1</code>", str(escape(text))))


def for_script(text: str) -> Markup:
    """Return JSON so that nothing in it ends the script element that holds it."""
    return Markup(text.replace("<", "\\u003c").replace("\u2028", "\\u2028"))
