"""One line of the diagnostics, before it is a message and after it was one."""

from dataclasses import dataclass, field


@dataclass(frozen=True)
class Finding:
    """One line of the diagnostics.

    Attributes
    ----------
    name : stable, without the hardware's name.
    level : ``OK``, ``WARN``, ``ERROR`` or ``STALE``.
    message : a sentence.
    values : key -> number or text; numbers are written so that plotting tools read them.
    """

    name: str
    level: str
    message: str
    values: dict[str, float | int | str] = field(default_factory=dict)
