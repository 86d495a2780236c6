"""What repeats from recording to recording but has no name, and what could be explained at all.

A Gaussian process in random Fourier features (Rahimi and Recht 2007): f(z) = phi(z)'w with the
squared-exponential kernel's spectrum drawn once, and w from ridge regression.  Of each recording
only phi'phi and phi'r are kept, so that leaving one out is a subtraction.  Fitted to what the
named terms leave it is the machine's discrepancy; fitted to the balance itself it is the flexible
reference, which knows no physics and shows what the signals could explain.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from eha_monitor.balances.candidates import Scale, stop
from eha_monitor.balances.course import Course

FEATURES = 200
WIDTHS = (1.0, 2.0)  # of the kernel, times the root of the number of signals
RIDGES = (1e-2, 1e-1, 1.0)  # of the mean eigenvalue
SWITCH = 1.0  # s after a switch or start that count as its transient
LAGS = (0.1, 0.3)  # s


@dataclass(frozen=True)
class Learned:
    """How far a flexible function of the motion explains signals, recordings left out.

    Attributes
    ----------
    before, after : (r,) error of each recording before and after, in the unit of the sizes given.
    """

    before: np.ndarray
    after: np.ndarray

    @property
    def removed(self) -> float:
        """Share of the squared error that repeats and is learned, at least 0."""
        return float(max(0.0, 1.0 - np.sum(self.after**2) / max(np.sum(self.before**2), 1e-300)))


def signals_of(course: Course, balance: str, scale: Scale) -> np.ndarray:
    """Return the signals that a flexible function may use, (m, f).

    For the force no pressure is among them, since the force is made of them; for the flow no
    velocity.
    """
    side, since = course.commanded, since_switch(course)
    speed = course.v if balance == "force" else course.omega
    found = [course.x, speed, side, np.exp(-since / 0.2), np.exp(-since / 1.0) * side]
    found += [_lagged(speed, lag, course.dt) for lag in LAGS]
    if balance == "force":
        found += [course.a, np.tanh(course.v / (0.05 * scale.speed)),
                  stop(course.x, 0.02 * scale.travel), stop(course.x, 0.15 * scale.travel)]
        found += [] if course.omega is None else [course.omega]
    else:
        found += [course.p1, course.p2, course.rate_1, course.rate_2]
    return course.in_band(np.column_stack(found))


def since_switch(course: Course) -> np.ndarray:
    """Return the time since valve or pump last changed side or started, (m,) s; long before."""
    side = course.commanded
    signal = np.abs(course.v if course.demand is None else course.demand)
    active = signal > 0.05 * np.quantile(signal, 0.98)
    events = np.concatenate([[False], (side[1:] != side[:-1]) | (active[1:] & ~active[:-1])])
    places = np.where(events, np.arange(len(side)), -(10**6))
    return (np.arange(len(side)) - np.maximum.accumulate(places)) * course.dt


def _lagged(values: np.ndarray, lag: float, dt: float) -> np.ndarray:
    steps = max(1, round(lag / dt))
    return np.concatenate([np.full(steps, values[0]), values[:-steps]])


def learned(signals: Sequence[np.ndarray], targets: Sequence[np.ndarray],
            good: Sequence[np.ndarray], sizes: Sequence[float], seed: int = 0) -> Learned:
    """Fit targets by a flexible function of the signals, each recording left out in turn.

    Parameters
    ----------
    signals : (m, f) of each recording; targets (m,), good (m,) bool what is compared.
    sizes : by which each recording's error is divided.
    """
    pooled = np.concatenate([part[there] for part, there in zip(signals, good, strict=True)])
    centre, spread = pooled.mean(axis=0), np.maximum(pooled.std(axis=0), 1e-300)
    rng = np.random.default_rng(seed)
    draws = rng.standard_normal((pooled.shape[1], FEATURES))
    phase = rng.uniform(0.0, 2.0 * np.pi, FEATURES)
    before = np.array([np.sqrt(np.mean(r[there] ** 2)) / size for r, there, size in zip(
        targets, good, sizes, strict=True)])
    best = Learned(before, np.full(len(before), np.inf))
    for width in WIDTHS:
        rows = []
        for part, there in zip(signals, good, strict=True):
            z = np.clip((part[there] - centre) / spread, -4.0, 4.0)
            waves = np.cos(z @ draws / (width * np.sqrt(z.shape[1])) + phase)
            rows.append(np.column_stack([np.ones(len(z)), z, waves]))
        grams = [row.T @ row / size**2 for row, size in zip(rows, sizes, strict=True)]
        sides = [row.T @ r[there] / size**2 for row, r, there, size in zip(
            rows, targets, good, sizes, strict=True)]
        gram, side = sum(grams), sum(sides)
        for ridge in RIDGES:
            after = np.empty(len(rows))
            for i, row in enumerate(rows):
                part = gram - grams[i]
                part[np.diag_indices(len(part))] += ridge * np.trace(gram) / len(gram) * 1e-2
                left = targets[i][good[i]] - row @ np.linalg.solve(part, side - sides[i])
                after[i] = np.sqrt(np.mean(left**2)) / sizes[i]
            if np.sum(after**2) < np.sum(best.after**2):
                best = Learned(before, after)
    return best


@dataclass(frozen=True)
class Regime:
    """Where an error lies.

    Attributes
    ----------
    name : ``after a switch``, ``at rest`` or ``while moving``.
    energy, time : its shares of the squared error and of the time.
    """

    name: str
    energy: float
    time: float


def regimes(balance: str, courses: Sequence[Course], left: Sequence[np.ndarray]
            ) -> tuple[Regime, ...]:
    """Return how an error of a balance is shared out between transients, rest and motion."""
    sums = dict.fromkeys(("after a switch", "at rest", "while moving"), (0.0, 0.0))
    for course, r in zip(courses, left, strict=True):
        new, moving = (course.compared(one) for one in (since_switch(course) < SWITCH,
                                                        course.moving))
        for name, here in (("after a switch", new), ("at rest", ~new & ~moving),
                           ("while moving", ~new & moving)):
            here = here & course.compared(course.counted(balance))
            energy, time = sums[name]
            sums[name] = energy + float(np.sum(r[here] ** 2)), time + float(here.sum())
    total = [max(sum(one[i] for one in sums.values()), 1e-300) for i in (0, 1)]
    return tuple(Regime(name, energy / total[0], time / total[1])
                 for name, (energy, time) in sums.items())


