"""Whether the time to a limit is what it is said to be: simulated lives of leak, air and friction.

    python benchmarks/life_histories.py [--seed 1] [--lives 500] [--healthy 1000]
                                        [--keep lives.jsonl] [--record]

Each life is a health number over irregular recordings with noise that is partly known, outliers,
missing recordings and a long pause: linear, accelerating, running in and growing later, a random
walk with drift, with repairs that set it back, or healthy without any growth.  They are followed
recording by recording (:mod:`eha_monitor.archive.history`).  Measured:

- coverage: share of the 90 % intervals told at 50, 60, 70, 80 and 90 % of the life (since the
  last repair) that hold the true time of the passage;
- warned: share of the lives in which the growth is told at 80 % of the life;
- false alarms: share of healthy lives in which growth is ever told (500 lives hold about 80
  healthy ones; ``--healthy`` more are run for this figure alone).

Four minutes of a core; with ``--keep`` a run that was ended goes on where it was.
"""

import json
import math
import time
from dataclasses import dataclass
from pathlib import Path

import record

import eha_monitor  # noqa: F401  before numpy, as everywhere
from eha_monitor.archive.history import BEYOND, TOLD, Series

import numpy as np  # isort: skip

KINDS = ("linear", "accelerating", "running_in", "random_walk", "repaired", "healthy")
QUANTITIES = {"leakage, mL/min": (20.0, 60.0, 150.0, 400.0), "free air, %": (0.1, 0.5, 1.5, 4.0),
              "friction, N": (20.0, 80.0, 150.0, 500.0)}
DAY = 86400.0
ASKED = (0.5, 0.6, 0.7, 0.8, 0.9)
AHEAD = 0.8
COVERED, WARNED, FALSE = (0.85, 0.95), 0.95, 0.005


@dataclass(frozen=True)
class Life:
    """One machine.

    ``time`` (n,) s, ``value``, ``stddev`` (n,); ``end`` is when the truth passes the limit, s, or
    inf; ``begin`` the last repair, or the start.
    """

    kind: str
    time: np.ndarray
    value: np.ndarray
    stddev: np.ndarray
    limit: float
    begin: float
    end: float


def growth(kind: str, rng: np.random.Generator, share: np.ndarray) -> np.ndarray:
    """Return the truth over ``share`` of the life, 0 to 1 and beyond; 1 is first passed at 1."""
    if kind == "linear":
        onset = rng.uniform(0.0, 0.3)
        return np.maximum(share - onset, 0.0) / (1.0 - onset)
    if kind == "accelerating":
        if rng.random() < 0.5:
            return share ** rng.uniform(1.5, 4.0)
        k = rng.uniform(2.0, 5.0)
        return np.expm1(k * share) / np.expm1(k)
    if kind == "running_in":
        top, fast = rng.uniform(0.1, 0.35), rng.uniform(0.03, 0.1)
        onset, power = rng.uniform(0.3, 0.6), rng.uniform(1.0, 2.5)
        settled = top * -np.expm1(-share / fast)
        later = np.maximum(share - onset, 0.0) / (1.0 - onset)
        end = top * -np.expm1(-1.0 / fast)
        return settled + (1.0 - end) * later**power
    raise ValueError(kind)


def walk(rng: np.random.Generator, fine: np.ndarray) -> np.ndarray:
    """Return a Wiener process with drift over ``fine`` shares of its mean life."""
    step = np.diff(fine, prepend=0.0)
    spread = rng.uniform(0.05, 0.3)
    return np.cumsum(step + spread * np.sqrt(step) * rng.standard_normal(len(fine)))


def life(kind: str, rng: np.random.Generator) -> Life:
    """Draw a life."""
    low, high, least, most = QUANTITIES[rng.choice(list(QUANTITIES))]
    level, limit = rng.uniform(low, high), rng.uniform(least, most)
    span = rng.uniform(60, 150)  # recordings
    gap = DAY * np.exp(rng.uniform(np.log(0.5), np.log(7.0)))
    length = span * gap
    parts, starts, begin = [], [0.0], 0.0
    fine = np.linspace(0.0, 3.0, 6001)
    if kind == "repaired":
        for _ in range(rng.integers(1, 3)):
            starts.append(starts[-1] + rng.uniform(0.4, 0.8) * length)
        begin = starts[-1]
    for _ in starts:
        inner = rng.choice(KINDS[:2]) if kind == "repaired" else kind
        if inner == "healthy":
            parts.append(np.zeros_like(fine))
        elif inner == "random_walk":
            parts.append(walk(rng, fine))
        else:
            parts.append(growth(inner, rng, fine))
    offsets = [0.0, *rng.uniform(-0.05, 0.15, len(starts) - 1)]  # a repair is not always perfect
    parts = [part + offset * np.maximum(1.0 - fine, 0.0)
             for part, offset in zip(parts, offsets, strict=True)]
    if kind == "healthy" and rng.random() < 0.3:  # other oil, another level: no growth
        starts.append(rng.uniform(0.2, 0.8) * length)
        parts.append(np.full_like(fine, rng.uniform(-0.2, 0.2)))
    passed = np.flatnonzero(parts[-1] >= 1.0)
    end = begin + fine[passed[0]] * length if len(passed) and kind != "healthy" else np.inf
    last = min(end, begin + 2.99 * length) if kind != "healthy" else length
    times = moments(rng, gap, last)
    which = np.searchsorted(starts, times, side="right") - 1
    truth = np.array([np.interp((t - starts[i]) / length, fine, parts[i])
                      for t, i in zip(times, which, strict=True)])
    noise = np.exp(rng.uniform(np.log(0.005), np.log(0.05)))
    known = rng.uniform(0.2, 1.0) * noise * rng.uniform(0.5, 1.5, len(times))
    seen = truth + np.hypot(known, noise * rng.uniform(0.0, 1.0)) * rng.standard_normal(len(times))
    wild = rng.random(len(times)) < rng.uniform(0.0, 0.04)
    seen[wild] += rng.choice([-1, 1], wild.sum()) * rng.uniform(5, 30, wild.sum()) * noise
    way = limit - level
    return Life(kind, times, level + way * seen, way * known, limit, begin, end)


def moments(rng: np.random.Generator, gap: float, last: float) -> np.ndarray:
    """Return when recordings are made: regular or by chance, some missing, a long pause."""
    count = int(1.5 * last / gap) + 20
    gaps = gap * (rng.uniform(0.8, 1.2, count) if rng.random() < 0.5
                  else rng.gamma(1.5, 1 / 1.5, count))
    times = np.cumsum(gaps)
    times = times[rng.random(count) > rng.uniform(0.0, 0.3)]
    if rng.random() < 0.3:
        start = rng.uniform(0.2, 0.7) * last
        times = times[(times < start) | (times > start + rng.uniform(0.03, 0.1) * last)]
    return times[times < last]


def follow(one: Life) -> dict:
    """Follow a life; returns when growth was first told, and what was told when it was asked."""
    series = Series(one.limit)
    span = one.end - one.begin
    asked = [] if np.isinf(span) else [one.begin + share * span for share in ASKED]
    found = {"kind": one.kind, "ends": bool(np.isfinite(span)), "first": np.inf, "told": {}}
    for t, value, stddev in zip(one.time, one.value, one.stddev, strict=True):
        while asked and t > asked[0]:
            share = ASKED[len(ASKED) - len(asked)]
            found["told"][share] = said(series)
            asked.pop(0)
        series.add(float(t), float(value), float(stddev))
        # Healthy ones have no end: whether growth was ever told is all there is to ask.
        if not found["ends"] and series.certain:
            found["first"] = min(found["first"], t)
    for share in ASKED[len(ASKED) - len(asked):]:
        found["told"][share] = said(series)
    found["end"] = one.end
    found["life"] = span
    return found


def said(series: Series) -> list:
    """Return status, early and late end of what is told now."""
    now = series.forecast()
    return [now.status, now.early, now.late]


def followed(seed: int, lives: int, healthy: int, keep: Path | None) -> list[dict]:
    """Return the lives, each with a generator of its own; those that ``keep`` has are read."""
    kinds = [KINDS[i % len(KINDS)] for i in range(lives)] + ["healthy"] * healthy
    known: dict = {}
    if keep is not None and keep.exists():
        known = {tuple(one["key"]): one for one in map(json.loads, keep.open())}
    found = []
    for i, kind in enumerate(kinds):
        key = (seed, i, kind)
        if key not in known:
            one = follow(life(kind, np.random.default_rng([seed, i])))
            known[key] = json.loads(json.dumps(one | {"key": key}))
            if keep is not None:
                with keep.open("a") as file:
                    file.write(json.dumps(known[key]) + "\n")
        found.append(known[key])
    return found


def summary(lives: list[dict]) -> dict:
    """Return the figures of followed lives."""
    inside, width, warned, by_kind = [], [], [], {}
    for one in lives:
        if not one["ends"]:
            continue
        told = [(early, late) for status, early, late in one["told"].values() if status == TOLD]
        hits = [early <= one["end"] <= late for early, late in told]
        inside += hits
        width += [(late - early) / one["life"] for early, late in told]
        warned.append(one["told"][str(AHEAD)][0] in (TOLD, BEYOND))
        kind = by_kind.setdefault(one["kind"], ([], []))
        kind[0].extend(hits)
        kind[1].append(warned[-1])
    healthy = [math.isfinite(one["first"]) for one in lives if one["kind"] == "healthy"]
    return {"coverage": np.mean(inside), "asked": len(inside), "width": np.median(width),
            "warned": np.mean(warned), "ended": len(warned), "false": np.mean(healthy),
            "healthy": len(healthy),
            "kinds": {kind: (np.mean(hits), len(hits), np.mean(warn), len(warn))
                      for kind, (hits, warn) in by_kind.items()}}


def main() -> None:
    """Print the table."""
    parser = record.options(__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--lives", type=int, default=500)
    parser.add_argument("--healthy", type=int, default=1000)
    parser.add_argument("--keep", type=Path, metavar="FILE", help="results so far")
    given = parser.parse_args()
    started = time.perf_counter()
    found = summary(followed(given.seed, given.lives, given.healthy, given.keep))
    wall = time.perf_counter() - started
    print(f"90 % intervals hold the truth: {found['coverage']:.1%} of {found['asked']} "
          f"(asked {COVERED[0]:.0%} to {COVERED[1]:.0%}); median width {found['width']:.1%} of "
          "the life")
    print(f"warned 20 % of the life ahead: {found['warned']:.1%} of {found['ended']} lives that "
          f"end (asked {WARNED:.0%})")
    print(f"false alarms: {found['false']:.2%} of {found['healthy']} healthy lives (asked at "
          f"most {FALSE:.1%})")
    for kind, (hits, count, warn, lives_) in found["kinds"].items():
        print(f"  {kind:13} coverage {hits:6.1%} of {count:4}, warned {warn:6.1%} of {lives_}")
    print(f"{wall:.0f} s")
    if given.record:
        figures = {"coverage": record.spread(100 * found["coverage"], "%"),
                   "intervals": record.spread(found["asked"]),
                   "width": record.spread(100 * found["width"], "%"),
                   "warned": record.spread(100 * found["warned"], "%"),
                   "ended": record.spread(found["ended"]),
                   "false": record.spread(100 * found["false"], "%"),
                   "healthy": record.spread(found["healthy"])}
        for kind, (hits, count, warn, lives_) in found["kinds"].items():
            figures |= {f"{kind}_coverage": record.spread(100 * hits, "%"),
                        f"{kind}_intervals": record.spread(count),
                        f"{kind}_warned": record.spread(100 * warn, "%"),
                        f"{kind}_lives": record.spread(lives_)}
        record.write("life_histories", figures, ("eha_monitor/archive/history.py",
                                                 "eha_monitor/archive/history.py"), "commit")


if __name__ == "__main__":
    main()
