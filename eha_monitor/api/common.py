"""What functions and records of the Python interface share: calls, errors, progress, tables."""

import copy
import os
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from eha_monitor.errors import InputError, refused
from eha_monitor.progress import Report, silent

if TYPE_CHECKING:
    import pandas


Progress = bool | Report
READING = 0.03  # of a diagnosis' progress is the reading
_WIDTH = 78  # of a line of progress
_one = threading.RLock()


@contextmanager
def calling() -> Iterator[None]:
    """Calculate, and no other thread meanwhile; what the system refuses is bad input.

    Raises InputError: in place of an OSError, with the same line that the command prints.
    """
    with _one:
        try:
            yield
        except OSError as problem:
            raise InputError(refused(problem)) from problem


def reporter(progress: Progress) -> Report:
    """Return what a calculation reports its progress to: (text, share from 0 to 1).

    That is nobody (False), a line on the standard error (True), or a function of one's own.
    """
    if callable(progress):
        return progress
    return _line if progress else silent


def _line(text: str, share: float) -> None:
    """Write over the line before, as terminals and notebooks show it."""
    line = f"{100 * min(max(share, 0.0), 1.0):3.0f} % {text}"[:_WIDTH]
    end = "\n" if share >= 1.0 else ""
    print(f"\r{line:{_WIDTH}}", end=end, file=sys.stderr, flush=True)


def _after_fork() -> None:
    """Forget what a forked process has not got: the other threads, and what they hold."""
    global _one
    _one = threading.RLock()
    if fit := sys.modules.get("eha_monitor.mismatch.likelihood.fit"):
        fit.workers.cache_clear()


os.register_at_fork(after_in_child=_after_fork)


Part = TypeVar("Part")
_PAGE = """\
<div class="eha-monitor"><p><strong>{{ title }}</strong>{% if text %}<br>{{ text }}{% endif %}</p>
{% if rows %}<table>
<thead><tr>{% for name in columns %}<th style="text-align:left">{{ name }}</th>{% endfor %}</tr>
</thead>
<tbody>{% for row in rows %}<tr>
{%- for cell in row %}<td style="text-align:left">{{ cell }}</td>{% endfor %}</tr>
{% endfor %}</tbody></table>{% endif %}
{% for note in notes %}<p><small>{{ note }}</small></p>
{% endfor %}</div>"""


class ReadOnly(dict):
    """A mapping that cannot be changed; ``dict(mapping)`` is a copy that can."""

    def _refuse(self, *_: Any, **__: Any):
        raise TypeError("a result cannot be changed; dict(...) of it is a copy that can")

    __setitem__ = __delitem__ = __ior__ = _refuse
    clear = pop = popitem = setdefault = update = _refuse

    def __reduce__(self):
        return type(self), (dict(self),)


def read_only(part: Part) -> Part:
    """Return records, mappings and arrays that cannot be changed; no number is copied."""
    if isinstance(part, np.ndarray):
        shown = part.view()
        shown.flags.writeable = False
        return shown
    if isinstance(part, dict):
        return ReadOnly((key, read_only(value)) for key, value in part.items())
    if isinstance(part, (tuple, list)):
        return tuple(read_only(one) for one in part)
    if is_dataclass(part) and not isinstance(part, (type, Record)):
        made = copy.copy(part)  # not replace: nothing is checked or measured again
        for field in fields(part):
            object.__setattr__(made, field.name, read_only(getattr(part, field.name)))
        return made
    return part


class Record:
    """A record that a notebook shows as a short table.

    The answers are dataclasses that extend what the calculation returns (its records know
    nothing of tables and pages); :meth:`_protect` keeps their mappings and arrays from being
    written.
    """

    def _protect(self) -> None:
        for one in fields(self):
            object.__setattr__(self, one.name, read_only(getattr(self, one.name)))

    __post_init__ = _protect

    def __setstate__(self, state: dict) -> None:
        """Take the state of a pickle, which does not keep that arrays cannot be written."""
        self.__dict__.update(state)
        self._protect()

    def _repr_html_(self) -> str:
        """Return the short table of a notebook, escaped."""
        title, text, columns, rows, notes = self._short()
        return _page().render(title=title, text=text, columns=columns, rows=rows, notes=notes)

    def __repr__(self) -> str:
        title, text, _, rows, _ = self._short()
        lines = [title, *([text] if text else []), *("  ".join(row) for row in rows)]
        return f"<eha_monitor.{type(self).__name__}: " + "\n  ".join(lines) + ">"

    def _short(self) -> tuple[str, str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        """Return title, sentence, names of columns, rows, notes."""
        raise NotImplementedError


@cache
def _page():
    import jinja2

    return jinja2.Environment(autoescape=True, trim_blocks=True).from_string(_PAGE)


def frame_of(rows: Iterable[Mapping[str, Any]], columns: Sequence[str], index: str = ""
             ) -> "pandas.DataFrame":
    """Return rows as a table that has its columns also where there is no row."""
    import pandas

    frame = pandas.DataFrame(list(rows), columns=list(columns))
    return frame.set_index(index) if index else frame


def chosen(what: Any, makers: Mapping[str, Callable], name: str) -> Callable:
    """Return the maker of a table or picture by its name; ``name`` is the argument's.

    Raises InputError if there is none of that name; it names those that there are.
    """
    if not isinstance(what, str) or what not in makers:
        raise InputError(f"{name}: expected one of {', '.join(makers)}, got {what!r}")
    return makers[what]
