"""Acknowledgements in a file beside the monitor's bags: a dashboard that starts anew has them."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

from eha_monitor.errors import InputError
from eha_monitor.health.alarms import SEVERITY
from eha_monitor.health.judge import Finding
from eha_monitor.output import write_bytes


@dataclass(frozen=True)
class Acknowledgement:
    """Who acknowledged an alarm, when (time of day, s since the epoch) and at which level.

    ``since`` is the alarm's own time of that level, as the monitor gives it.
    """

    who: str
    time_s: float
    level: str
    since: str = ""

    def over(self, finding: Finding) -> bool:
        """Tell whether the alarm is OK again, or raised to a higher level."""
        return finding.word == "OK" or (
            finding.raised and SEVERITY.index(finding.word) > SEVERITY.index(self.level))

    def of(self, finding: Finding) -> bool:
        """Tell whether the alarm is still the one of before this process: unchanged since."""
        return finding.word == self.level and since(finding) == self.since


def since(finding: Finding) -> str:
    """Return since when an alarm has its level, as the monitor gives it."""
    return str(finding.values.get("since_s", ""))


def read(path: Path) -> dict[str, Acknowledgement]:
    """Return by the name of the alarm what a file has; nothing where there is none.

    Raises
    ------
    InputError
        If it cannot be read, or is no such file.
    """
    try:
        tree = json.loads(path.read_text(encoding="utf-8"))
        return {str(name): Acknowledgement(str(one["who"]), float(one["time_s"]),
                                           str(one["level"]), str(one["since"]))
                for name, one in tree.items() if one["level"] in SEVERITY}
    except FileNotFoundError:
        return {}
    except OSError as problem:
        raise InputError(f"{path}: cannot read: {problem.strerror}") from problem
    except (ValueError, TypeError, KeyError, AttributeError) as problem:
        raise InputError(f"{path}: expected the acknowledgements that a dashboard wrote"
                         ) from problem


def write(path: Path, given: dict[str, Acknowledgement]) -> None:
    """Write them; see :func:`read`.

    Raises
    ------
    InputError
        If the place cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as problem:
        raise InputError(f"{path.parent}: cannot make the folder: {problem.strerror}"
                         ) from problem
    write_bytes(path, json.dumps({name: asdict(one) for name, one in given.items()},
                                 indent=1).encode())
