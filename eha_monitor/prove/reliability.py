"""Are the probabilities of the answers honest: what was said with 90 % has to be so in 90 %."""

import math
from collections.abc import Iterable, Sequence

BINS = 10  # of equal width, from 0 to 1


def statement(of: str, said: object, right: bool | None) -> list[dict]:
    """Return a statement with its probability; none where either is missing.

    Parameters
    ----------
    of : what is stated: an effect, a number of the rig, ``consistent`` or ``unexplained``.
    said : its probability.
    right : whether it is so; None where nobody knows.
    """
    if right is None or not isinstance(said, int | float) or not 0.0 <= said <= 1.0:
        return []
    return [{"of": of, "said": float(said), "right": bool(right)}]


def statements_of(answer: dict, findings: Iterable[dict], paired: Sequence[str],
                  consistent: bool | None, unexplained: bool | None) -> list[dict]:
    """Return all statements of an answer.

    Parameters
    ----------
    findings : what it says of rig numbers.
    paired : names that stand for something that is there.
    consistent, unexplained : whether these are so; None where nobody knows.
    """
    stated = answer.get("probability") or {}
    found = statement("consistent", stated.get("consistent"), consistent)
    found += statement("unexplained", stated.get("unexplained"), unexplained)
    for one in answer["effects"]:
        found += statement(one["name"], one.get("probability"), one["name"] in paired)
    for one in findings:
        found += statement(one["number"], one.get("probability"), one["number"] in paired)
    return found


def reliability_of(statements: Sequence[dict]) -> list[dict]:
    """Return the bins that hold statements: their edges, ``n``, mean said and share right."""
    bins: dict[int, list[dict]] = {}
    for one in statements:
        bins.setdefault(min(int(one["said"] * BINS), BINS - 1), []).append(one)
    return [{"low": place / BINS, "high": (place + 1) / BINS, "n": len(mine),
             "said": math.fsum(one["said"] for one in mine) / len(mine),
             "right": sum(one["right"] for one in mine) / len(mine)}
            for place, mine in sorted(bins.items())]


def calibration_error(bins: Sequence[dict]) -> float | None:
    """Return the expected calibration error: |said - right|, each bin by its statements."""
    count = sum(one["n"] for one in bins)
    if not count:
        return None
    return math.fsum(one["n"] * abs(one["said"] - one["right"]) for one in bins) / count
