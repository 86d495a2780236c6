"""Curves of a trial: detection and calibration.

Detection: the probability of the right name against what can be detected at all.  Calibration:
what was stated with 90 % has to be so in 90 %.
"""

import math
from collections.abc import Iterable, Sequence
from itertools import pairwise

import numpy as np
from scipy.optimize import minimize

RIGHT = ("exact", "class")
POINT = 0.95
FEWEST = 4  # cases of an effect that get a curve of their own
STEEP, STEEP_SPREAD = 1.1, 0.6  # of the logarithm of the slope: prior, from which few cases borrow
PLACE_SPREAD = 2.0  # of the logarithm of the middle
BINS = 10  # of stated probabilities, of equal width, from 0 to 1
EDGES = (0.0, 0.5, 1.0, 1.4, 2.0, 3.0, 5.0, 10.0, 30.0, 100.0, np.inf)


def curve_of(units: np.ndarray, right: np.ndarray) -> dict:
    """Fit P = 1/(1 + (m/u)^b) and return it.

    Parameters
    ----------
    units : (n,) strength in units of what an oracle just detects.
    right : (n,) bool, the right name or its declared class was said.

    Returns
    -------
    dict
        ``middle`` m, ``slope`` b, ``point_95`` units at which P is 95 %, ``n``.
    """
    u = np.log(np.maximum(np.asarray(units, dtype=float), 0.03))
    right = np.asarray(right, dtype=bool)

    def cost(p: np.ndarray) -> float:
        at = np.exp(p[1]) * (u - p[0])
        signed = np.where(right, at, -at)
        return float(np.logaddexp(0.0, -signed).sum() + 0.5 * (p[0] / PLACE_SPREAD) ** 2
                     + 0.5 * ((p[1] - STEEP) / STEEP_SPREAD) ** 2)

    start = min(((place, STEEP) for place in np.linspace(-2.0, 6.0, 17)),
                key=lambda p: cost(np.array(p)))
    found = minimize(cost, np.array(start), method="Nelder-Mead")
    middle, slope = float(np.exp(found.x[0])), float(np.exp(found.x[1]))
    return {"middle": middle, "slope": slope, "n": len(right),
            "point_95": middle * (POINT / (1.0 - POINT)) ** (1.0 / slope)}


def curves_of(detection: list[dict]) -> dict[str, dict]:
    """Return the curve of all single effects together (``all``), and of each with cases enough.

    Empty without an oracle: then nobody knows what can be detected.
    """
    known = [one for one in detection if one["units"] is not None]
    found = {}
    for name in ("all", *sorted({one["effect"] for one in known})):
        mine = [one for one in known if name in ("all", one["effect"])]
        if len(mine) >= FEWEST:
            found[name] = curve_of(np.array([one["units"] for one in mine]),
                                   np.array([one["said"] in RIGHT for one in mine]))
    return found


def binned(detection: list[dict]) -> list[dict]:
    """Return shares of right names by units, with Wilson's 68 % interval."""
    found = []
    known = [one for one in detection if one["units"] is not None]
    for low, high in pairwise(EDGES):
        mine = [one for one in known if low <= one["units"] < high]
        if not mine:
            continue
        n, hits = len(mine), sum(one["said"] in RIGHT for one in mine)
        p = hits / n
        low_share, high_share = wilson(p, n)
        place = np.exp(np.mean(np.log([max(one["units"], 0.1) for one in mine])))
        found.append({"units": float(place), "share": p, "n": n,
                      "low": float(low_share), "high": float(high_share)})
    return found


def wilson(share: np.ndarray | float, n: np.ndarray | int) -> tuple:
    """Return the ends of Wilson's 68 % interval of shares of n cases, the share inside."""
    middle = (share + 0.5 / n) / (1.0 + 1.0 / n)
    half = np.sqrt(share * (1.0 - share) / n + 0.25 / n**2) / (1.0 + 1.0 / n)
    return np.minimum(middle - half, share), np.maximum(middle + half, share)


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
