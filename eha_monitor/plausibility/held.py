"""Pressures and forces that stand still while the machine moves: a clipped sensor, a set-point.

A smooth signal turns at its highest value with a flat top, and is gone from it again by its own
curvature.  One that is cut off comes to its highest value steeply, stays there to the last digit,
and leaves it steeply.  A set-point stands to the last digit between its steps.
"""

from dataclasses import dataclass

import numpy as np

from eha_monitor.plausibility.moments import stretch_of
from eha_monitor.quantity import quantity, share
from eha_monitor.recordings.position import astray, noise_of
from eha_monitor.recordings.recording import ChannelFinding, Recording
from eha_monitor.words import listed

LOOKED_AT = ("p1", "p2", "force")  # a position stands at a stop, a speed at the drive's limit
FEWEST = 8  # samples in a run
OFTEN = 0.005  # of the samples
MOVED = 0.02  # of its span must something else have moved meanwhile
MOVES = 10.0  # standard deviations of its noise
CUT_OFF = 0.02  # of its span: so much of a top must be missing
STEPS = 4.0  # of the resolution: flatter tops are rounded, not cut off
HELD_S = 0.1
MOSTLY = 0.5  # of the samples
# A noisy value repeats by chance for some samples, a quantised one for longer where the motion is
# slow.  Longer than this, and than so many times what is usual, is frozen: live and offline.
SHORTEST_S = 0.25
STUCK_S = 1.0
SAME = 1e-12  # of the largest value
TIMES = 4.0
USUAL = 0.98  # quantile of a motion's steps, and by share of its time of its pauses
JUMPED = 5.0  # usual steps by which a frozen value is left: a piston goes on from where it stood
JUMPS = 0.05  # of its span, the usual change from one value to the next
GOES_ON = 0.1  # of what a demand moves
SHOWN = 3  # stretches in a sentence


@dataclass(frozen=True)
class _Runs:
    """Samples of equal value, one after the other: first, one behind the last, and the value."""

    starts: np.ndarray
    stops: np.ndarray
    values: np.ndarray

    def of(self, kept: np.ndarray) -> "_Runs":
        return _Runs(self.starts[kept], self.stops[kept], self.values[kept])

    @property
    def lengths(self) -> np.ndarray:
        return self.stops - self.starts


@np.errstate(over="ignore", invalid="ignore")  # of values that are no signals
def held(recording: Recording) -> tuple[ChannelFinding, ...]:
    """Return the pressures and forces that are cut off, or that stand between steps."""
    piece = slice(*stretch_of(recording))
    channels = {name: np.asarray(values[piece], dtype=float)
                for name, values in recording.channels.items() if name != "temperature"}
    found = []
    for name in LOOKED_AT:
        values = channels.get(name)
        if values is None or np.isfinite(values).sum() < FEWEST:
            continue
        span = float(np.nanmax(values) - np.nanmin(values))
        runs = _still_while_others_move(name, channels) if span > 0.0 else None
        if runs is None or not len(runs.starts):
            continue
        said = _stairs(runs, values, span, recording.sample_time, name) or _cut(
            runs, values, span, name)
        if said:
            found.append(ChannelFinding(f"{name} {said}", "hold", (name,)))
    for name in LOOKED_AT:
        if said := _stuck(name, channels, recording.sample_time, piece.start
                          * recording.sample_time):
            found.append(ChannelFinding(said, "hold", (name,)))
    whole = {name: np.asarray(values, dtype=float)
             for name, values in recording.channels.items() if name in ("x", "p1", "p2", "omega")}
    if said := _frozen(whole, recording.sample_time) or _stands_to_the_end(recording):
        found.append(ChannelFinding(said, "hold", ("x",)))
    found += [ChannelFinding(said, "hold", ("x",)) for said in _astray(recording)]
    return tuple(found)


def _astray(recording: Recording) -> list[str]:
    """Return what the position does that no piston does, in words."""
    x, dt = recording.get("x"), recording.sample_time
    off, said = astray(x, dt), []
    size = quantity(off.size, "m", 2)
    if len(off.out):
        said.append(f"x drops out {_when(off.out * dt)}, by up to {size} within a sample and "
                    "back: a loose contact, a cable, or an encoder; what lies between is left out")
    if len(off.jumps):
        at = listed([f"{one * dt:.2f}" for one in off.jumps[:SHOWN]])
        more = f" s and {len(off.jumps) - SHOWN} more times" if len(off.jumps) > SHOWN else " s"
        said.append(f"x jumps at {at}{more}, by up to {size} within a sample, as no piston does: "
                    "an encoder that loses counts, a sensor that slips, or rows that are missing")
    if len(off.noisy):
        said.append(f"x is up to {quantity(off.noise, '', 2)} times as noisy as usual "
                    f"{_when(off.noisy * dt)}: a loose contact, a cable, or an encoder; these "
                    "stretches are left out")
    return said


def _when(stretches: np.ndarray) -> str:
    """Return first and last second of some stretches (m, 2), in words."""
    shown = ", ".join(f"{first:.2f}–{last:.2f}" for first, last in stretches[:SHOWN])
    more = f" s and {len(stretches) - SHOWN} more" if len(stretches) > SHOWN else " s"
    return f"at {shown}{more}"


def _stands_to_the_end(recording: Recording) -> str:
    """Return from when on the position keeps one value while its demand goes on, in words, or "".

    Longer than at any other time.
    """
    x, wanted = recording.get("x"), recording.get("x_d")
    there = np.flatnonzero(np.isfinite(x) & np.isfinite(wanted))
    if len(there) < FEWEST:
        return ""
    x, wanted, dt = x[there], wanted[there], recording.sample_time
    changes = np.flatnonzero(np.diff(x) != 0.0)
    if not len(changes):
        return ""
    last, pauses = int(changes[-1]) + 1, np.diff(changes)
    goes_on = float(np.ptp(wanted[last:]))
    if not is_frozen((len(x) - last) * dt, float(pauses.max(initial=0)) * dt, STUCK_S) or (
            goes_on < GOES_ON * np.ptp(wanted)):
        return ""
    return (f"x stands still from {there[last] * dt:.2f} s to the end, to the last digit, while "
            f"its demand goes on by {quantity(goes_on, 'm', 2)}: a frozen sensor, a blocked "
            "piston, or a drive that is off")


def is_frozen(still: float, usual: float, shortest: float = SHORTEST_S) -> bool:
    """Tell whether a channel stands still for longer than one that moves does, s."""
    return still >= max(shortest, TIMES * usual)


def _frozen(channels: dict[str, np.ndarray], dt: float) -> str:
    """Return where the position is frozen while the machine moves, in words, or "".

    At rest nothing else moves, and a piston that sticks goes on from where it stood.
    """
    x = channels.get("x")
    if x is None or np.isfinite(x).sum() < FEWEST:
        return ""
    steps = np.abs(np.diff(x))
    changes = steps[np.isfinite(steps) & (steps > 0.0)]
    if not len(changes) or len(channels) < 2:
        return ""
    runs = _still_while_others_move("x", channels)
    jump = np.append(np.nan_to_num(steps), 0.0)[runs.stops - 1] > JUMPED * np.quantile(
        changes, USUAL)
    ordinary = runs.lengths[~jump] * dt
    usual = float(ordinary.max()) if len(ordinary) else 0.0
    frozen = runs.of(jump & np.array([is_frozen(one, usual) for one in runs.lengths * dt],
                                     dtype=bool))
    if not len(frozen.starts):
        return ""
    where = _when(np.column_stack([frozen.starts, frozen.stops]) * dt)
    return (f"x stands still {where} while the pressures or the pump move, and then "
            "jumps: a frozen sensor, or a logger that repeats its last value")


def _stuck(name: str, channels: dict[str, np.ndarray], dt: float, begins: float) -> str:
    """Return where a channel stays at one value while others move, in words, or "".

    Far longer than at any other time, and between its extremes: a chamber stays at the source's
    pressure.  In a steady stroke only the position moves: that is not asked.
    """
    values = channels.get(name)
    if values is None or np.isfinite(values).sum() < FEWEST:
        return ""
    others = {one: rows for one, rows in channels.items() if one != "x"}
    runs, (low, high) = _still_while_others_move(name, others), (
        np.nanmin(values), np.nanmax(values))
    if not len(runs.starts):
        return ""
    longest = int(np.argmax(runs.lengths))
    at, lasts = runs.values[longest], float(runs.lengths[longest]) * dt
    usual = float(runs.lengths[runs.values != at].max(initial=0)) * dt  # a gap may part it
    if not is_frozen(lasts, usual, STUCK_S) or min(at - low, high - at) < MOVED * (high - low):
        return ""
    return (f"{name} stands still at {begins + runs.starts[longest] * dt:.2f}–"
            f"{begins + runs.stops[longest] * dt:.2f} s while other channels change: a frozen "
            "sensor, or a logger that repeats its last value")


def _still_while_others_move(name: str, channels: dict[str, np.ndarray]) -> _Runs:
    """Return the runs of equal samples of a channel in which a measured channel moves."""
    values = channels[name]
    # What a resampling to another grid makes of a constant differs in the last digits.
    same = SAME * np.nanmax(np.abs(values), initial=0.0)
    edges = np.flatnonzero(np.r_[True, ~(np.abs(np.diff(values)) <= same), True])
    runs = _Runs(edges[:-1], edges[1:], values[edges[:-1]])
    runs = runs.of((runs.lengths >= FEWEST) & np.isfinite(runs.values))
    moved = np.zeros(len(runs.starts), dtype=bool)
    for other in ("x", "p1", "p2", "omega"):
        if other == name or other not in channels or not len(moved):
            continue
        theirs = channels[other]
        least = max(MOVED * float(np.nanmax(theirs) - np.nanmin(theirs)),
                    MOVES * noise_of(theirs)) if np.isfinite(theirs).any() else np.inf
        moved |= np.array([
            np.nanmax(part, initial=-np.inf) - np.nanmin(part, initial=np.inf) > least
            for part in map(theirs.__getitem__, map(slice, runs.starts, runs.stops))])
    return runs.of(moved)


def _stairs(runs: _Runs, values: np.ndarray, span: float, dt: float, name: str) -> str:
    """Return that a channel stands between steps, in words, or ""."""
    long = runs.of(runs.lengths * dt >= HELD_S)
    part = float(long.lengths.sum()) / len(values)
    changes = np.abs(np.diff(values))
    jump = float(np.median(changes[changes > 0.0])) if (changes > 0.0).any() else 0.0
    if part < MOSTLY or jump < JUMPS * span:
        return ""
    return (f"stands still in {share(part, 2)} of the motion, and then jumps by "
            f"{_shown(jump, name)}: it may be a set-point (another column), a "
            "slow logger, or too coarse a sensor")


def _cut(runs: _Runs, values: np.ndarray, span: float, name: str) -> str:
    """Return at which of its ends a channel is cut off, in words, or ""."""
    steps = np.abs(np.diff(values))
    smallest = float(np.quantile(steps[steps > 0.0], 0.1)) if (steps > 0.0).any() else 0.0
    least = max(CUT_OFF * span, STEPS * smallest)
    for sign, end, word in ((1.0, np.nanmax(values), "highest"),
                            (-1.0, np.nanmin(values), "lowest")):
        flat = runs.of(runs.values == end)
        cut = flat.of(np.array([_missing(sign * values, a, b) > least for a, b in zip(
            flat.starts, flat.stops, strict=True)], dtype=bool))
        part = float(cut.lengths.sum()) / len(values)
        if part > OFTEN:
            limit = "a relief valve holds it" if sign > 0 else "the chamber runs empty"
            or_ = f", or {limit}" if name != "force" else ""
            return (f"stays at exactly {_shown(float(end), name)}, its {word} value, in "
                    f"{share(part, 2)} of the samples while the machine moves: its sensor may be "
                    f"at the end of its range{or_}")
    return ""


def _shown(value: float, name: str) -> str:
    return quantity(value, "N", 4) if name == "force" else f"{value / 1e5:.4g} bar"


def _missing(values: np.ndarray, start: int, stop: int) -> float:
    """Return how high a parabola would rise above a flat top with the slopes at its ends.

    The smaller of both slopes counts.  A top that the recording begins or ends with counts for
    none: a steady motion may begin or end there.
    """
    n = stop - start
    reach = max(3, n // 4)
    slopes = []
    for side in (values[max(start - reach, 0):start][::-1], values[stop:stop + reach]):
        side = side[np.isfinite(side)]
        if len(side) < 3:
            return 0.0
        steps = np.arange(1, len(side) + 1)
        slopes.append(float(np.sum((values[start] - side) * steps) / np.sum(steps**2)))
    return min(slopes) * n / 4.0
