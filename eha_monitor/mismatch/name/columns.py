"""The columns of the joint selection: what each suspect does to the innovations.

A column is the sensitivity to one number times the prior deviation of that number, so that
amplitudes of all columns have the prior N(centre, 1).  Suspects are

    base        B, beta_e and the small timing errors that every record has: always there
    rig         numbers of the config within their tolerance: always there
    wrong rig   the same numbers, beyond it
    effects     every start of every entry of the catalogue, and those that the model already has
    unnamed     smooth unknown functions of the motion, one group of columns each

For each balance an unknown function is put together from hat functions of one signal, or of that
signal times another, or of time; a unit of it acts as an unknown force, flow or shaft speed
(:mod:`eha_monitor.mismatch.name.gram`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from eha_monitor import ties
from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.data.inputs import CLOSED, FORCED
from eha_monitor.mismatch.diagnosis import INTERMITTENT
from eha_monitor.mismatch.likelihood.along import filtered_tracks
from eha_monitor.mismatch.likelihood.fit import Fit, Free, filtered, spread, step_of
from eha_monitor.mismatch.likelihood.gains import linear_of, smallest_unknowns
from eha_monitor.mismatch.name.candidates import RIG, candidate
from eha_monitor.mismatch.name.gram import carried, injected
from eha_monitor.mismatch.name.starts import (
    Start,
    continuing,
    directions_of,
    free_parameter,
    own_sizes,
    possible,
    starts_of,
)
from eha_monitor.physics import signals as s
from eha_monitor.physics.effects import CATALOGUE, NAMES
from eha_monitor.physics.parameters import BASE_KEYS, effect_values
from eha_monitor.physics.plant import Y_FLOW, Y_FORCE, Y_P1, Y_P2, Y_SPEED
from eha_monitor.settings.rig import TOLERATED

ALWAYS = ""  # owner of what every model has
TANGENT = 0.05  # of a start's size: where the innovations answer in proportion
RIG_STEP = 1e-3  # of a tolerance's logarithm: for its sensitivity
ASTRAY, ASTRAY_OWNER = 1e30, "astray"  # a run that went astray says nothing
LOOSE = 0.1  # of a logarithm: a number that may be off by so much does not act in proportion
FAR_OFF = 5.0  # of its deviations: where such a number is tried, either way
MAKEUP = "makeup_conductance"
INVERSE = ("mass", "volume_1", "volume_2")
REPLACING = 100  # variants from here on grow out of an effect that the model has


@dataclass(frozen=True)
class Column:
    """One number that may differ from the model at hand."""

    owner: str  # effect, unnamed term, ``rig.<key>``, or ``ALWAYS``
    variant: int  # which of the owner's starts; -1 where the model has it
    name: str  # of the number, as in :class:`Free`
    centre: float = 0.0  # prior mean less the present value, in prior deviations
    lower: float = -np.inf  # bounds of the amplitude
    upper: float = np.inf
    free: Free | None = None  # how it is fitted; None for unnamed terms
    start: Start | None = None  # of the effect that it brings in
    size: bool = False  # it is a size: without it its effect is absent
    # Of its logarithm: how far a wrong number of the rig moves with an amplitude of 1
    step: float = 0.0


@dataclass(frozen=True)
class Columns:
    """All columns at a fit."""

    what: tuple[Column, ...]  # (m - 1 + k,) whose they are
    values: list[np.ndarray]  # for each stretch (n, c, m), innovations first
    # (k,) (place, factor) of columns that are others times a factor
    copies: tuple[tuple[int, float], ...] = ()


HATS = 9  # of a signal
BLOCK, MOST_BLOCKS = 1.0, 30  # s of a time in which an unknown load is constant; how many
PLACES = {"force": Y_FORCE, "flow": Y_FLOW, "drive": Y_SPEED}
ACTING = 0.4  # of its largest: a load that comes and goes is there


@dataclass(frozen=True)
class Unnamed:
    """A smooth unknown function."""

    name: str  # e.g. ``force of x``
    balance: str  # ``force``, ``flow`` across, ``flow_1``, ``flow_2`` into one chamber, ``drive``
    # For each stretch (n, k) hat functions times the signal that it scales
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


def rig_free(experiment: Experiment, beside: Sequence[str] = ()) -> tuple[Free, ...]:
    """Return the numbers of the rig that this experiment can determine, as logarithms.

    Each has the prior of its tolerance (``rig.tolerance``).  What is nil or unknown is none.

    ``beside`` : members of a model; a number that is the same equation as one of them stays out.
    """
    equal = {candidate(name).equals for name in beside if name in CATALOGUE}
    rig, policy = experiment.settings.rig, experiment.policy
    if experiment.mode == FORCED:
        keys = {"mass"}
    else:
        keys = set(TOLERATED)
        if experiment.mode != CLOSED or experiment.wanted_speed:
            keys -= {"position_gain"}
    found = []
    for place, key in BASE_KEYS.items():
        value = getattr(rig, key) if key in keys and RIG + key not in equal else None
        if value:
            width = rig.tolerance.log_spread(key)
            reach = float(np.exp(policy.sure * width))  # what is further off is wrong
            most = value * reach
            if key == MAKEUP and value < rig.leakage:
                most = min(most, rig.leakage)  # of which it is a part
            found.append(Free(RIG + key, place, value / reach, most,
                              float(np.log(value)), width, True))
    return tuple(found)


def runs_of(experiment: Experiment, theta: np.ndarray, active: np.ndarray, gains: np.ndarray
            ) -> list[np.ndarray]:
    """Return the innovations of the used channels at all samples, (n, c) for each stretch.

    Their rows are contiguous, as compiled code wants them.
    """
    return [np.ascontiguousarray(filtered(experiment, stretch, theta, active, gains)[0][
        :, experiment.columns]) for stretch in experiment.stretches]


def columns_at(experiment: Experiment, fit: Fit, unnamed: bool = True, suspects: bool = True,
               terms: Sequence[Unnamed] | None = None) -> Columns:
    """Return innovations and columns at a fit, under its gains.

    ``unnamed`` : also unknown functions: ``terms``, or those of :func:`unnamed_of`.
    ``suspects`` : also the effects that the model does not have.
    """
    present = runs_of(experiment, fit.theta, fit.active, fit.gains)
    what: list[Column] = []
    moves: list[tuple[np.ndarray, np.ndarray, float]] = []  # theta, active, over how many units

    def moved(f: Free, owner: str, variant: int, size: bool = False) -> None:
        """Add a number that the model has."""
        if f.of_rig:
            theta, step = fit.theta.copy(), max(RIG_STEP * f.spread, 1e-5)
            theta[f.place] *= np.exp(step)
        else:
            theta, step = step_of(f, fit.theta, experiment.log_step)
        now = f.inward(fit.theta[f.place])
        what.append(Column(owner, variant, f.name, (f.prior - now) / f.spread,
                           (f.inward(f.lower) - now) / f.spread,
                           (f.inward(f.upper) - now) / f.spread, f, size=size))
        moves.append((theta, fit.active, step / f.spread))

    small_timing = [f for f in fit.free  # errors that every record has, and that have no name
                    if f.owner and f.owner not in fit.named and not f.of_rig]
    for f in (*(f for f in fit.free if not f.owner), *small_timing,
              *rig_free(experiment, fit.named)):
        moved(f, ALWAYS, -1)
    for name in effects_of(fit):
        sizes = {p.name for p in CATALOGUE[name].sizes}
        for f in fit.free:
            if f.owner == name:
                moved(f, name, -1, f.symbol in sizes)
    for name in NAMES if suspects else ():
        if name in fit.named or experiment.active[NAMES.index(name)] or not possible(
                name, experiment):
            continue
        for variant, start in enumerate(starts_of(name, experiment)):
            entering(fit, start, variant, what, moves)
    for place, start in enumerate(grown_from(experiment, fit) if suspects else ()):
        if possible(start.effect, experiment):
            entering(fit, start, REPLACING + place, what, moves)

    if terms is None:
        terms = unnamed_of(experiment, fit) if unnamed else []
    sizes = [term.basis[0].shape[1] for term in terms]
    # In one block, as large as is given back to the system when it is freed.
    bounds = np.cumsum([0, *map(len, present)])
    block = np.empty((bounds[-1], present[0].shape[1], 1 + len(moves) + sum(sizes)))
    values = [block[first:last] for first, last in pairwise(bounds)]

    def one(place: int) -> bool:
        theta, active, units = moves[place]
        good = True
        for into, run, part in zip(values, runs_of(experiment, theta, active, fit.gains), present,
                                   strict=True):
            with np.errstate(invalid="ignore"):  # a run that went astray is not used
                np.subtract(run, part, out=run)
            run /= units
            good &= bool((np.abs(run[np.isfinite(part)]) < ASTRAY).all())
            into[:, :, 1 + place] = run if good else 0.0
        return good

    keep = spread(one, range(len(moves)))
    for into, part in zip(values, present, strict=True):
        into[:, :, 0] = part
    if terms:
        columns_of(experiment, fit, terms, [part[:, :, 1 + len(moves):] for part in values])
    what = [column if good else replace(column, owner=ASTRAY_OWNER)
            for column, good in zip(what, keep, strict=True)]
    what += [Column(term.name, 0, term.name, size=True)
             for term, size in zip(terms, sizes, strict=True) for _ in range(size)]
    wrong = [i for i, c in enumerate(what) if c.owner == ALWAYS and c.free.of_rig]
    far = experiment.policy.wrong
    copies = [(1 + i, far) for i in wrong]
    what += [Column(what[i].name, -1 if what[i].name in fit.named else 0, what[i].name,
                    free=what[i].free, size=True, step=far * what[i].free.spread)
             for i in wrong]
    for i in wrong if suspects else ():
        f = what[i].free
        if f.name not in fit.named and f.spread > LOOSE:
            # The rates are linear in most numbers, and in the inverse of a mass or a volume.
            turned = -1.0 if f.symbol in INVERSE else 1.0
            for variant, sign in enumerate((-1.0, 1.0), 1):
                step = sign * FAR_OFF * f.spread
                what.append(Column(f.name, variant, f.name, 0.0, 0.0, 1.5, f, size=True,
                                   step=step))
                copies.append((1 + i, turned * float(np.expm1(turned * step)) / f.spread))
    return Columns(tuple(what), values, tuple(copies))


def effects_of(fit: Fit) -> tuple[str, ...]:
    """Return the effects that a model has, without the numbers of the rig that it calls wrong."""
    return tuple(name for name in fit.named if name in CATALOGUE)


def grown_from(experiment: Experiment, fit: Fit) -> list[Start]:
    """Return starts of effects that contain one that the model has, or share what it contains.

    They begin where that one stands, so that only what they add is judged.
    """
    found = []
    for name in effects_of(fit):
        family = {name, *CATALOGUE[name].contains}
        for other in NAMES:
            if other in fit.named or not family & {other, *CATALOGUE[other].contains}:
                continue
            found += [replace(continuing(start, effect_values(fit.theta, name)), replaces=name)
                      for start in starts_of(other, experiment)]
    return found


def entering(fit: Fit, start: Start, variant: int, what: list, moves: list) -> None:
    """Add the columns of an effect at one of its starts."""
    effect, values = CATALOGUE[start.effect], dict(start.values)
    sizes = own_sizes(start)
    if not sizes:  # another shape only: all of it, or nothing
        theta, active = directions_of(fit, start)[0]
        p = effect.sizes[0]
        what.append(Column(start.effect, variant, f"{start.effect}.{p.name}", 0.0, 0.0, 1.0,
                           free_parameter(start, p), start, True))
        moves.append((theta, active, 1.0))
        return
    smooth = all(np.isfinite(p.neutral) and (start.among == 1 or p.unit not in ("s", "m"))
                 for p in sizes)
    share = TANGENT if smooth else 1.0
    for p, (theta, active) in zip(sizes, directions_of(fit, start, share), strict=True):
        f = free_parameter(start, p)
        if p.log or not np.isfinite(p.neutral):  # all or nothing, at this start
            what.append(Column(start.effect, variant, f.name, 0.0, 0.0, 1.5, f, start, True))
            moves.append((theta, active, 1.0))
            continue
        width = values[p.name] - p.neutral
        units = width / f.spread
        lower, upper = sorted(((p.lower - p.neutral) / f.spread, (p.upper - p.neutral) / f.spread))
        what.append(Column(start.effect, variant, f.name, 0.0, lower, upper, f, start, True))
        moves.append((theta, active, share * units))


def placed(column: Column, amplitude: float) -> float:
    """Return the value of a size that enters with an amplitude, SI."""
    return column.free.outward(column.free.prior + amplitude * column.free.spread)
