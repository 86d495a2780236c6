"""From context to one HTML file that needs nothing else."""

import os
from functools import lru_cache
from pathlib import Path
from typing import Any

import jinja2

from eha_monitor import __version__
from eha_monitor.errors import InputError


@lru_cache(maxsize=1)
def _environment() -> jinja2.Environment:
    return jinja2.Environment(
        loader=jinja2.PackageLoader("eha_monitor.reports"), autoescape=True,
        undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True)


def render(template: str, **context: Any) -> str:
    """Return a page of ``templates/``; every value is HTML-escaped."""
    return _environment().get_template(template).render(version=__version__, **context)


def write_page(path: str | Path, html: str) -> None:
    """Write the page to a temporary name beside ``path``, then rename it.

    Raises
    ------
    InputError
        If the place cannot be written; an older report there is untouched.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        # File names may hold bytes that are no text; they must not cost the report.
        temporary.write_bytes(html.encode("utf-8", errors="replace"))
        temporary.replace(path)
    except OSError as problem:
        if temporary.is_file():
            temporary.unlink()
        raise InputError(f"{path}: cannot write the report: {problem.strerror}") from problem
