"""Every HTML page of the program, and a picture of each at two widths and in print.

    python benchmarks/pages.py [--out out/pages] [--only NAME ...] [--redo] [--data ../shared/data]

Answers are kept in OUT/work, so that a change of a page is seen again within a minute; ``--redo``
makes them anew (five to ten minutes).  OUT/NAME.html is the page, OUT/NAME-1280.png and
NAME-400.png show it as a browser does, NAME-print.pdf as a printer does, and OUT/index.html all of
them; ``--images`` also takes those of docs/images anew.  The table says how large each page is,
how long it took to draw, and what its browser complained of.
"""

import argparse
import pickle
import shutil
import time
from pathlib import Path

from pages_parts.browser import Browser
from pages_parts.cases import CASES, Folder
from record import DATA
from rich.console import Console
from rich.table import Table

from eha_monitor.compiled import load_runtime
from eha_monitor.output import write_text

ROOT = Path(__file__).parents[1]
# Page -> picture of the docs, and the elements with which it begins and ends.
IMAGES = {"diagnosis_mismatch": ("diagnosis.png", "#verdict", "#hero"),
          "estimate_air": ("report.png", "h1", "#parameter-beta_e")}


def main() -> None:
    """Draw, take the pictures, print the table."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--out", type=Path, default=ROOT / "out" / "pages")
    options.add_argument("--only", nargs="+", default=list(CASES), choices=list(CASES))
    options.add_argument("--redo", action="store_true", help="make the answers anew")
    options.add_argument("--data", type=Path, default=DATA)
    options.add_argument("--images", action="store_true", help="docs/images of pages, too")
    asked = options.parse_args()
    if asked.redo:
        shutil.rmtree(asked.out / "work", ignore_errors=True)
    folder = Folder(asked.out / "work", asked.data)
    folder.path.mkdir(parents=True, exist_ok=True)
    load_runtime()
    table = Table("page", "kB", "drawn in, s", "of it pictures", "charts", "complaints")
    shown = []
    with Browser() as browser:
        for name in asked.only:
            drawn = page_of(name, folder)
            if drawn is None:
                table.add_row(name, "", "", "", "", "its data are not here")
                continue
            text, spent = drawn
            page = asked.out / f"{name}.html"
            write_text(page, text)
            seen = browser.look(page)
            table.add_row(name, f"{len(text.encode()) / 1e3:.0f}", f"{spent:.2f}",
                          str(text.count("data:image/png")), str(seen.charts),
                          "; ".join(seen.complaints) or "none")
            shown.append(name)
            if asked.images and name in IMAGES:
                picture, first, last = IMAGES[name]
                browser.clip(page, first, last, ROOT / "docs" / "images" / picture)
    write_text(asked.out / "index.html", "<!DOCTYPE html><title>Pages</title>" + "".join(
        f'<h2><a href="{n}.html">{n}</a> (<a href="{n}-print.pdf">print</a>)</h2>'
        f'<img src="{n}-1280.png" width="640" alt=""> <img src="{n}-400.png" width="200" alt="">'
        for n in shown))
    Console().print(table)
    print(f"written: {asked.out / 'index.html'}")


def page_of(name: str, folder: Folder) -> tuple[str, float] | None:
    """Return a page and the processor time that it took; None where its data are missing."""
    answer, draw = CASES[name]
    kept = folder.path / f"{name}.pickle"
    if not kept.exists():
        made = answer(folder)
        if made is None:
            return None
        kept.write_bytes(pickle.dumps(made))
    answer = pickle.loads(kept.read_bytes())
    started = time.process_time()
    return draw(answer, folder), time.process_time() - started


if __name__ == "__main__":
    main()
