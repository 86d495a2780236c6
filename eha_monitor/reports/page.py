"""From context to one HTML file that needs nothing else."""

from functools import lru_cache
from typing import Any

import jinja2

from eha_monitor import __version__
from eha_monitor.quantity import NOTE


@lru_cache(maxsize=1)
def _environment() -> jinja2.Environment:
    return jinja2.Environment(
        loader=jinja2.PackageLoader("eha_monitor.reports"), autoescape=True,
        undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True)


def render(template: str, **context: Any) -> str:
    """Return a page of ``templates/``; every value is HTML-escaped."""
    return _environment().get_template(template).render(
        **{"version": __version__, "plus_minus": NOTE, **context})
