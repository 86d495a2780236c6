"""One line of the diagnostics, before it is a message and after it was one."""

from dataclasses import dataclass, field

from eha_monitor.health.judge import NOT_JUDGED


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

    @property
    def word(self) -> str:
        """The level as people are told it: OK, WARN, ERROR, STALE or ``not judged``."""
        return NOT_JUDGED if str(self.values.get("not_judged", "0")) == "1" else self.level

    @property
    def raised(self) -> bool:
        """Whether it is WARN or ERROR by judgement."""
        return self.word in ("WARN", "ERROR")
