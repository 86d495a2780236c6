"""Rivals without a name: smooth unknown functions of the motion, one group of columns each.

For each balance a term that no entry of the catalogue has is put together from hat functions of
one signal, or of that signal times another, or of time; a unit of it acts as an unknown force,
flow or shaft speed (:mod:`eha_monitor.mismatch.name.gram`).
"""

from dataclasses import dataclass

import numpy as np

from eha_monitor import ties
from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.data.inputs import CLOSED, FORCED
from eha_monitor.mismatch.diagnosis import INTERMITTENT
from eha_monitor.mismatch.likelihood.along import filtered_tracks
from eha_monitor.mismatch.likelihood.fit import Fit, spread
from eha_monitor.mismatch.likelihood.gains import linear_of, smallest_unknowns
from eha_monitor.mismatch.name.gram import carried, injected
from eha_monitor.physics import signals as s
from eha_monitor.physics.plant import Y_FLOW, Y_FORCE, Y_P1, Y_P2, Y_SPEED

HATS = 9  # of a signal
BLOCK, MOST_BLOCKS = 1.0, 30  # s of a time in which an unknown load is constant; how many
PLACES = {"force": Y_FORCE, "flow": Y_FLOW, "drive": Y_SPEED}
ACTING = 0.4  # of its largest: a load that comes and goes is there


@dataclass(frozen=True)
class Unnamed:
    """A smooth unknown function.

    Attributes
    ----------
    name : e.g. ``force of x``; ``balance`` it acts in: ``force``, ``flow`` across, ``flow_1`` and
        ``flow_2`` into one chamber, ``drive``.
    basis : for each stretch (n, k) hat functions times the signal that it scales.
    """

    name: str
    balance: str
    basis: tuple[np.ndarray, ...]


def hats(values: list[np.ndarray], count: int) -> list[np.ndarray]:
    """Return hat functions over the quantiles that the values cover, (n, count) each."""
    whole = np.concatenate(values)
    low, high = np.quantile(whole, [0.002, 0.998])
    if not high > low:
        return [np.zeros((len(v), 0)) for v in values]
    centres = np.linspace(low, high, count)
    width = centres[1] - centres[0]
    return [np.maximum(0.0, 1.0 - np.abs(np.clip(v, low, high)[:, None] - centres) / width)
            for v in values]


def blocks_of(experiment: Experiment) -> tuple[list[np.ndarray], int]:
    """Return for each stretch (n,) the block of time of each sample, and how many there are."""
    duration = sum(len(stretch) for stretch in experiment.stretches) * experiment.dt
    length = max(BLOCK, duration / MOST_BLOCKS)
    found, total = [], 0
    for stretch in experiment.stretches:
        which = (np.arange(len(stretch)) * experiment.dt / length).astype(int) + total
        found.append(which)
        total = int(which.max()) + 1
    return found, total


def loads_of(experiment: Experiment, amplitudes: np.ndarray
             ) -> tuple[tuple[float, float, float], ...]:
    """Return when an unknown load acts, (from s, to s, N against positive motion).

    ``amplitudes`` : (k,) of the blocks of time, in units of the prior.
    """
    newtons = experiment.policy.matters * smallest_unknowns(experiment).force * amplitudes
    counted = np.bincount(np.concatenate(blocks_of(experiment)[0]), np.concatenate(
        [stretch.counted for stretch in experiment.stretches]), len(newtons))
    for block in np.flatnonzero(counted == 0):  # held out: as on both sides of it
        beside = newtons[[b for b in (block - 1, block + 1) if 0 <= b < len(newtons)]]
        newtons[block] = beside[ties.largest(-np.abs(beside))]
    acting = np.abs(newtons) > ACTING * np.abs(newtons).max()
    found: list[list[float]] = []
    for stretch, which in zip(experiment.stretches, blocks_of(experiment)[0], strict=True):
        open_ = False
        for block in np.unique(which):
            here = np.flatnonzero(which == block)
            start, stop = (stretch.start + experiment.dt * k for k in (here[0], here[-1] + 1))
            same = open_ and np.sign(found[-1][2]) == np.sign(newtons[block])
            if acting[block] and same:
                width = found[-1][1] - found[-1][0]
                found[-1][2] = (found[-1][2] * width + newtons[block] * (stop - start)) / (
                    width + stop - start)
                found[-1][1] = stop
            elif acting[block]:
                found.append([start, stop, float(newtons[block])])
            open_ = bool(acting[block])
    return tuple((float(a), float(b), float(c)) for a, b, c in found)


def unnamed_of(experiment: Experiment, fit: Fit) -> list[Unnamed]:
    """Return the unknown functions that compete, along the filtered motion of a fit."""
    tracks = filtered_tracks(experiment, fit)
    x = [track[:, s.X] for track in tracks]
    v = [track[:, s.V] for track in tracks]
    sense = [np.tanh(one / max(0.01 * experiment.ranges.speed, 1e-9)) for one in v]
    of_x, of_v = hats(x, HATS), hats(v, HATS)
    blocks, total = blocks_of(experiment)
    of_time = [(which[:, None] == np.arange(total)).astype(float) for which in blocks]

    def times(basis, signal):
        return tuple(one * other[:, None] for one, other in zip(basis, signal, strict=True))

    found = [Unnamed("force of v", "force", tuple(of_v)),
             Unnamed("force of x", "force", tuple(of_x)),
             Unnamed("force of x and direction", "force", times(of_x, sense)),
             Unnamed(INTERMITTENT, "force", tuple(of_time))]
    if experiment.mode != FORCED:
        dp = [track[:, s.P1] - track[:, s.P2] for track in tracks]
        omega = [track[:, s.OMEGA] for track in tracks]
        scale = max(float(np.quantile(np.abs(np.concatenate(dp)), 0.98)), 1e-9)
        relative = [one / scale for one in dp]
        angle = [np.cumsum(one) * experiment.dt for one in omega]
        found += [Unnamed("flow of v", "flow", tuple(of_v)),
                  Unnamed("flow of x", "flow", tuple(of_x)),
                  Unnamed("flow of dp", "flow", tuple(hats(dp, HATS))),
                  Unnamed("flow of x and dp", "flow", times(of_x, relative)),
                  Unnamed("flow of the shaft's angle", "flow", tuple(
                      np.column_stack([f(k * one) for k in (1, 2, 3, 7, 9, 11)
                                       for f in (np.cos, np.sin)]) for one in angle))]
        if experiment.mode == CLOSED:
            found += [Unnamed("speed of omega", "drive", tuple(hats(omega, HATS))),
                      Unnamed("speed of x", "drive", tuple(of_x))]
    return [one for one in found if one.basis[0].shape[1]]


def columns_of(experiment: Experiment, fit: Fit, unnamed: list[Unnamed],
               into: list[np.ndarray]) -> None:
    """Write the innovations' sensitivities to unnamed terms, (n, c, m) for each stretch.

    A unit is the prior deviation.
    """
    linear = linear_of(experiment, fit.theta, fit.active, fit.unknowns)
    small = dict(zip(PLACES, smallest_unknowns(experiment).as_array(), strict=True))
    used = experiment.columns

    def entering(balance: str) -> np.ndarray:
        """Return what a unit adds to the state over a sample, (N,)."""
        plain, _, chamber = balance.partition("_")
        into = experiment.policy.matters * small[plain] * carried(linear.a, PLACES[plain])
        if chamber:  # nothing into the other one
            into[Y_P2 if chamber == "1" else Y_P1] = 0.0
        if chamber == "2":  # the unknown flow goes out of chamber 2, this one into it
            into *= -1.0
        return into

    enters = np.concatenate([np.repeat(
        entering(one.balance)[:, None], one.basis[0].shape[1], axis=1)
        for one in unnamed], axis=1)
    gains = np.ascontiguousarray(fit.gains[:, :, used])

    def write(i: int) -> None:
        stretch = experiment.stretches[i]
        forcing = np.concatenate([one.basis[i] for one in unnamed], axis=1)
        forcing[:-1] = 0.5 * (forcing[:-1] + forcing[1:])
        missing = np.ascontiguousarray(~np.isfinite(stretch.z[:, used]))
        injected(np.ascontiguousarray(forcing), missing, linear.a,
                 np.ascontiguousarray(linear.h[used]), gains, enters, into[i])

    spread(write, range(len(into)))
