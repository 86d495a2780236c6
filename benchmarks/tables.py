"""The tables of README and docs, made of what the benchmarks recorded.

    python benchmarks/tables.py [--again]        # or: make figures

Between ``<!-- figures: NAME -->`` and ``<!-- /figures -->`` stands what the template
``benchmarks/figures/NAME.md.j2`` makes of ``benchmarks/figures/*.json``.  A template names a file
by its stem: ``speed.both`` is the figure ``both`` of ``speed.json``.  What the tables cannot tell,
a file that is older than the code it measures, is printed with the command that makes it anew;
``--again`` first runs those commands that take a minute.
"""

import argparse
import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from record import FIGURES, ROOT, digest

MARKED = re.compile(r"(<!-- figures: (\w+) -->\n).*?(<!-- /figures -->)", re.DOTALL)
LOST = 100.0  # %


def main() -> None:
    """Write the tables; tell which files are older than the code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--again", action="store_true",
                        help="run what is too old and takes a minute")
    if parser.parse_args().again:
        for file in files():
            made = read(file)
            if made["held_by"] == "source" and too_old(file):
                subprocess.run([sys.executable, *shlex.split(made["command"])[1:]], cwd=ROOT,
                               check=True)
    for page in pages():
        text = page.read_text(encoding="utf-8")
        if (made := with_tables(text)) != text:
            page.write_text(made, encoding="utf-8")
            print(f"{page.relative_to(ROOT)} is written")
    for file in files():
        for line in too_old(file):
            print(line, file=sys.stderr)


def pages() -> list[Path]:
    """Return the pages that may hold tables."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def files() -> list[Path]:
    """Return what the benchmarks recorded."""
    return sorted(FIGURES.glob("*.json"))


def read(file: Path) -> dict:
    """Return a file of figures."""
    return json.loads(file.read_text(encoding="utf-8"))


def with_tables(text: str) -> str:
    """Return a page with its tables as the files have them now."""
    room = Environment(loader=FileSystemLoader(FIGURES), undefined=StrictUndefined,
                       trim_blocks=True, lstrip_blocks=True, autoescape=False)  # Markdown
    room.filters |= {"number": number, "ranged": ranged, "extremes": extremes, "change": change,
                     "told": told}
    known = {file.stem: (made := read(file))["figures"] | {"made": made} for file in files()}
    return MARKED.sub(lambda found: found[1] + room.get_template(f"{found[2]}.md.j2").render(
        known).strip() + "\n" + found[3], text)


def number(figure: dict, digits: int | None = None) -> str:
    """Return the median, with so many decimals; without: three digits, thousands apart."""
    return written(figure["value"], digits)


def ranged(figure: dict, digits: int | None = None) -> str:
    """Return the median, and the smallest and the largest of several."""
    middle, low, high = (written(figure[key], digits) for key in ("value", "min", "max"))
    return middle if low == high else f"{middle} ({low} to {high})"


def extremes(figure: dict, digits: int | None = None) -> str:
    """Return the smallest and the largest: where several values are one figure."""
    return f"{written(figure['min'], digits)} to {written(figure['max'], digits)}"


def change(figure: dict) -> str:
    """Return a change in per cent; one that is no longer a number of this rig is ``lost``."""
    value = figure["value"]
    return "lost" if value is None or abs(value) >= LOST else f"{round(value, 2) + 0.0:.2f} %"


def written(value: float | None, digits: int | None) -> str:
    """Return a number as a table shows it; where there is none, a dash."""
    if value is None:
        return "–"
    if digits is None and value:
        value = float(f"{value:.3g}")
        digits = 0 if abs(value) >= 100 else 1 if abs(value) >= 10 else 2
    return f"{value:,.{digits or 0}f}".replace(",", " ")


def told(made: dict) -> str:
    """Return where figures come from: the line below a table."""
    machine = made["machine"]  # null where it was not written down
    words = [f"`{made['command']}`, {made['date']}, commit {made['commit']}"
             + (" with changes upon it" if made["dirty"] else "")]
    if made.get("copied"):
        words.append("written by hand")
    if machine is not None:
        steps = f"{machine['filterpy_steps_per_s']:,.0f}".replace(",", " ")
        words.append(f"{machine['cores']} cores ({machine['model']}, load {machine['load']:g}) of "
                     f"{steps} plain filterpy steps a second each")
    return "; ".join(words) + "."


def too_old(file: Path) -> list[str]:
    """Return a line for each part of the code that has changed since the file was made."""
    made = read(file)
    again = f"run `{made['command']}`, then `make figures`"
    name = file.relative_to(ROOT)
    if made.get("copied"):
        return [f"{name} is written by hand: {again}"]
    return [f"{name} is older than {part}: {again}" for part, known in made["measures"].items()
            if not (ROOT / part).exists() or known != digest(part)]  # a room may be gone


if __name__ == "__main__":
    main()
