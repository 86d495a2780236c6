"""Channels with stamps of their own onto one uniform grid."""

import hashlib
from collections.abc import Callable

import numpy as np

from eha_monitor.errors import InputError, one_line
from eha_monitor.recordings.cdr import Series
from eha_monitor.recordings.columns import IN_MEMORY, PIECE, Column, blocks
from eha_monitor.recordings.grid import GAP, JITTER, Grid, fit_grid, period_of, repair, tell_gaps
from eha_monitor.recordings.recording import CHANNELS, Recording, sampled_rows, within_limits
from eha_monitor.settings.monitor import Settings

CLOCKS = 2**61  # ns; stamps are held within this range, so that differences do not overflow
SPARSE = 1000  # grid points for each sample, beyond which a recording is refused


def align(series: dict[str, tuple[Series, str]], settings: Settings, *, source: str = "",
          losses: list[str] | tuple[str, ...] = ()) -> Recording:
    """Put channels on one grid; gaps stay NaN, and what was repaired is said.

    The grid is that of ``x``, or of the channel with the most samples where there is no ``x``.
    Raises InputError if the stamps are too sparse for a grid.

    Parameters
    ----------
    series : channel -> (series in SI, topic or "").
    settings : ``rig.sample_time`` is the sample time where the stamps agree within 5 %.
    source : file, for errors.
    losses : sentences to begin with.
    """
    said = list(losses)
    series = {name: (within_range(found, name, topic, source, said), topic)
              for name, (found, topic) in series.items()}
    if not series:
        raise InputError(f"{source}: no channel to align")
    reference = "x" if "x" in series else max(series, key=lambda name: len(series[name][0].values))
    leader, topic = series[reference]
    label = topic or reference
    if topic and not leader.stamped:
        said.append(f"{label}: no header stamps, log times are used")
    keep, jumped = repair(leader.stamp_ns, label, said)
    origin = int(leader.stamp_ns[keep[0]])
    t = (leader.stamp_ns[keep] - origin) * 1e-9
    grid = fit_grid(t, leader.values[keep], settings.rig.sample_time)
    tell_grid(grid, label, settings.rig.sample_time, said)
    points = (int(grid.index[-1]) + 1 if grid.mode != "instants"
              else int((t[-1] - t[0]) / grid.step + JITTER) + 1)
    if points > SPARSE * len(t) + 1000:
        raise InputError(f"{source}: {label}: {len(t)} samples over {t[-1]:.6g} s are too sparse "
                         f"for a sample time of {grid.step:g} s")
    logs = leader.log_ns[keep]  # between these the kept stretch was recorded
    window = (int(logs.min()), int(logs.max())) if jumped else None

    axes: dict[tuple, tuple] = {}
    columns: dict[str, np.ndarray] = {}
    for name in sorted(series, key=lambda name: (name != reference, CHANNELS.index(name))):
        found, topic = series[name]
        key = (topic or name, hashlib.sha256(np.ascontiguousarray(found.stamp_ns)).digest())
        if key not in axes:
            shared = len(axes) == 0  # the reference comes first
            axes[key] = ((keep, t, grid) if shared else
                         _axis(found, topic or name, leader, keep, origin, grid, window, said))
        columns[name] = placing(found.values, axes[key], grid)(0, points)
        tell_rate(name, axes[key], grid, said)
    columns = {name: columns[name] for name in CHANNELS
               if name in columns and (name == reference or np.isfinite(columns[name]).any())}
    return recording_of(columns, grid, origin, source, said)


def recording_of(columns: dict[str, np.ndarray], grid: Grid, origin: int, source: str,
                 said: list[str]) -> Recording:
    """Return the recording of channels on a grid, whose time is from ``origin`` on, ns."""
    columns = released(columns, grid.step, said)
    tell_gaps(columns, grid.step, said)
    return Recording(grid.step, columns, max(0, origin + round(grid.start * 1e9)), source,
                     tuple(dict.fromkeys(map(one_line, said))))


def within_range(found: Series, name: str, topic: str, source: str, said: list[str]) -> Series:
    """Blank what is no measurement and clip stamps that would overflow; count NaN."""
    values = np.asarray(found.values, dtype=float)
    missing = int(np.sum(np.isnan(values)))
    if missing:
        said.append(f"{name}: {missing} of {len(values)} values are NaN")
    stamps = np.clip(found.stamp_ns, -CLOCKS, CLOCKS)
    # Before the grid: what is interpolated from a wild sample is wild as well.
    values, told = within_limits(name, values, (stamps - stamps[0]) * 1e-9,
                                 ": ".join(part for part in (source, topic) if part))
    said += told
    return Series(stamps, np.clip(found.log_ns, 0, CLOCKS), values, found.stamped)


def _axis(found: Series, label: str, leader: Series, led, origin: int, grid: Grid, window, said):
    """Return (kept samples, their times, their grid) of a topic other than the reference."""
    stamps = _dated(found, label, leader, led, said)
    chosen = np.arange(len(stamps))
    if window is not None:
        margin = 0.5e9 * grid.step
        inside = (found.log_ns >= window[0] - margin) & (found.log_ns <= window[1] + margin)
        if inside.any():
            chosen = chosen[inside]
    chosen = chosen[repair(stamps[chosen], label, said)[0]]
    first, last = int(leader.stamp_ns[led[0]]), int(leader.stamp_ns[led[-1]])
    if stamps[chosen[0]] > last or stamps[chosen[-1]] < first:
        # Another clock (sim time, a controller's own): the recorder's log times join them.
        offset = int(np.median(leader.stamp_ns[led] - leader.log_ns[led])
                     - np.median(stamps[chosen] - found.log_ns[chosen]))
        if abs(offset) > 1_000_000_000:
            said.append(f"{label}: its clock is {-offset * 1e-9:.6g} s off, aligned by log time")
            stamps = stamps + offset
    t = (stamps[chosen] - origin) * 1e-9
    own = fit_grid(t, found.values[chosen], grid.step)
    if own.mode != "exact":
        tell_grid(own, label, own.step, said)
    return chosen, t, own


def _dated(found: Series, label: str, leader: Series, led, said: list[str]) -> np.ndarray:
    """Return the stamps of a topic; of one without any, by itself or by others (below)."""
    if found.stamped or not leader.stamped:
        return found.stamp_ns
    order = led[np.argsort(leader.log_ns[led], kind="stable")]
    by_others = beside(found.log_ns, leader.log_ns[order], leader.stamp_ns[order])
    if not evenness(by_others) > EVENER * evenness(found.log_ns):
        return found.stamp_ns
    said.append(f"{label}: no stamps, and received in bursts; dated by the stamps of what was "
                "received with it")
    return by_others


def placing(values: np.ndarray, axis: tuple, grid: Grid) -> Callable[[int, int], np.ndarray]:
    """Return what gives rows ``start`` to ``stop`` of the grid of one channel.

    Directly where its times fall on the grid, else interpolated.
    """
    keep, t, own = axis
    times = own.times(t)
    place = (times - grid.start) / grid.step
    index = np.round(place)
    level = abs(own.step / grid.step - 1) < 0.1  # a slower one is interpolated in between
    if level and (np.abs(place - index) <= JITTER).all() and (np.diff(index) > 0).all():
        def direct(start: int, stop: int) -> np.ndarray:
            column = np.full(stop - start, np.nan)
            inside = (index >= start) & (index < stop)
            column[index[inside].astype(np.int64) - start] = values[keep[inside]]
            return column

        return direct

    def between(start: int, stop: int) -> np.ndarray:
        return interpolate(times, values[keep], grid.start + np.arange(start, stop) * grid.step,
                           cubic=own is grid)

    return between


def tell_rate(name: str, axis: tuple, grid: Grid, said: list[str]) -> None:
    """Say that a channel has a rate of its own, so that what lies between is interpolated."""
    keep, _, own = axis
    if len(keep) > 2 and not 1 / 1.1 < own.step / grid.step < 1.1:
        said.append(f"{name}: {1 / own.step:.4g} Hz, interpolated to {1 / grid.step:.4g} Hz")


def tell_grid(grid: Grid, label: str, nominal: float, said: list[str]) -> None:
    """Say what was made of stamps that are not those of the config."""
    if grid.mode == "snapped":
        said.append(f"{label}: stamps jitter by {grid.jitter * 1e3:.3g} ms rms about an even "
                    f"sampling of {grid.step * 1e3:.6g} ms; the even times are used")
    elif grid.mode == "instants":
        said.append(f"{label}: sampled unevenly (steps off by {grid.jitter * 1e3:.3g} ms rms); "
                    f"interpolated to {grid.step * 1e3:.6g} ms")
    elif abs(grid.step / nominal - 1) > 1e-6:
        said.append(f"{label}: the stamps give a sample time of {grid.step * 1e3:.6g} ms, the "
                    f"config {nominal * 1e3:.6g} ms; the stamps are used")


# ---- What lies between samples, and sensor channels that a logger repeats.
#
# A file at 100 Hz whose pressures come over a bus at 20 Hz holds each of them for five rows.
# Taken as measured in every row they lag by two rows on average and move in steps, and the flow
# balance takes the lag for compliance.  So the rows that repeat are left out, and what lies
# between the new values is interpolated as that of a topic with a rate of its own.

SENSORS = ("x", "v", "p1", "p2", "force")
# A drive may truly hold its speed, and the model has a hold for that: the logger does so only
# where it holds a sensor over as many rows.  A demand is held in any case.
DRIVEN = "omega"
ENOUGH = 50  # clear changes, below which nothing is concluded
CLEAR = 1.5  # of a small change; one step of a coarse sensor says nothing about holding
SMALL = 0.1  # of the changes are smaller: of a coarse sensor they are one step of it
LOOSE = 0.02  # of the clear changes may follow another at once (lost rows, a second source)


def interpolate(t: np.ndarray, values: np.ndarray, at: np.ndarray,
                cubic: bool = False) -> np.ndarray:
    """Interpolate between neighbours, never across a gap of more than GAP periods.

    Parameters
    ----------
    t, values : (n,) rising times in s, and values.
    at : (m,) times wanted, s.
    cubic : through four neighbours where they are close together; smooths noise less.
    """
    out = np.full(len(at), np.nan)
    if len(t) == 0:
        return out
    period = period_of(t)
    near = np.clip(np.searchsorted(t, at), 0, len(t) - 1)
    before = np.clip(near - 1, 0, None)
    near = np.where(np.abs(t[before] - at) < np.abs(t[near] - at), before, near)
    same = np.abs(t[near] - at) <= JITTER * (period or 1.0)
    if len(t) > 1:
        left = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 2)
        width = t[left + 1] - t[left]
        inside = (at >= t[0]) & (at <= t[-1]) & (width <= GAP * period)
        part = (at - t[left]) / width
        linear = values[left] * (1 - part) + values[left + 1] * part
        out[inside] = linear[inside]
        if cubic and len(t) > 3:
            four = np.clip(left, 1, len(t) - 3)[:, None] + np.arange(-1, 3)
            nodes, heights = t[four], values[four]
            apart = nodes[:, :, None] - nodes[:, None, :]
            away = at[:, None, None] - np.broadcast_to(nodes[:, None, :], apart.shape)
            one = np.eye(4, dtype=bool)[None]
            ratio = np.where(one, 1.0, away / np.where(one, 1.0, apart))
            curve = (ratio.prod(axis=2) * heights).sum(axis=1)
            close = inside & (np.diff(nodes, axis=1) <= GAP * period).all(axis=1)
            close &= np.isfinite(curve)
            out[close] = curve[close]
    same &= np.isnan(out)  # at the edge of a gap, or beside a NaN
    out[same] = values[near[same]]
    return out


def hold_of(values: np.ndarray) -> int:
    """Return over how many rows each value is repeated; 1 where every row may be new.

    A coarse sensor repeats values too, as long as the quantity moves by less than its resolution
    in a row.  It then changes by one step of its resolution; a change by more than that, always a
    few rows after the one before, is of a held value.

    ``values`` : (n,) one channel, NaN where missing.
    """
    steps = np.abs(np.diff(values))
    at = np.flatnonzero(steps > 0.0)
    if len(at) <= ENOUGH:
        return 1
    clear = np.flatnonzero(steps[at] > CLEAR * np.quantile(steps[at], SMALL))
    clear = clear[clear > 0]
    if len(clear) < ENOUGH:
        return 1
    apart = at[clear] - at[clear - 1]
    return int(np.median(apart)) if np.quantile(apart, LOOSE) >= 2 else 1


def fresh_rows(values: np.ndarray, hold: int) -> np.ndarray:
    """Return the rows at which a value is new, (k,): where it changes, and every ``hold`` after.

    A value that does not change for longer than ``hold`` was measured again and is the same.
    """
    finite = np.isfinite(values)
    new = finite & np.concatenate([[True], (values[1:] != values[:-1])])
    at = np.flatnonzero(new)
    last = np.concatenate([at[1:], [len(values)]])
    # Half of a hold may be missing where two clocks drift past one another.
    again = np.maximum((last - at - (hold + 1) // 2) // hold, 0)
    rows = np.repeat(at, again + 1) + hold * (
        np.arange(np.sum(again + 1)) - np.repeat(np.cumsum(again + 1) - again - 1, again + 1))
    return rows[finite[rows]]


def released(columns: dict[str, np.ndarray], step: float, said: list[str]
             ) -> dict[str, np.ndarray]:
    """Return the columns, each held sensor channel interpolated between its new values.

    Parameters
    ----------
    columns : channel -> (n,) on one grid, SI, NaN where missing.
    step : spacing of the grid, s.
    said : takes a sentence for each channel that was held.
    """
    found, holds = dict(columns), {}
    for name in (*SENSORS, DRIVEN):
        if name not in columns:
            continue
        values, rows = columns[name], len(columns[name])
        hold = hold_of(values if rows <= IN_MEMORY else values[sampled_rows(rows)[:PIECE]])
        if hold == 1 or (name == DRIVEN and hold not in holds.values()):
            continue
        holds[name], found[name] = hold, _between(values, hold, step)
        said.append(f"{name}: {1 / (hold * step):.4g} Hz, each value repeated over {hold} rows; "
                    f"interpolated to {1 / step:.4g} Hz")
    return found


def _between(values: np.ndarray, hold: int, step: float) -> np.ndarray:
    """Return a held channel, interpolated between its new values, (n,)."""
    made = Column()
    for start, stop, _ in blocks(values):
        first, last = max(0, start - 8 * hold), min(len(values), stop + 8 * hold)
        part = values[first:last]
        rows = fresh_rows(part, hold)
        at = np.arange(start - first, stop - first)
        between = interpolate(rows * step, part[rows], at * step, cubic=True)
        # Of the last value before a gap, or the end, nothing follows.
        made.append(np.where(np.isnan(between), part[at], between))
    return made.values()


# ---- When messages without a stamp were sent: when they came, or when others say that came then.
#
# On a busy machine messages wait and are received together.  Their times of receipt then say
# little, and the stamps of the position's messages that waited with them say more.  But a position
# that is sent in blocks, by a node of its own, would put the messages of others in blocks as well.
# So the more even of the two is taken: over the same time its steps have the larger sum of roots
# (Jensen).

EVENER = 1.1  # times the sum of roots: surely the more even
KEPT = 1000  # messages of the position that are remembered
LEAST_NS, WAITS_NS = 1_000, 1_000_000_000  # between two messages; as long as one waits
FADES = 0.98  # of the sums, from one look at the topics to the next: some seconds


def beside(received: np.ndarray, of_received: np.ndarray, of_stamps: np.ndarray) -> np.ndarray:
    """Return the times of messages by the stamps of others that were received about then.

    Parameters
    ----------
    received : (n,) ns, when they were received.
    of_received, of_stamps : (m,) ns of the others, in order of receipt.
    """
    return received + np.rint(np.interp(received, of_received, of_stamps - of_received)).astype(
        np.int64)


def evenness(times: np.ndarray) -> float:
    """Return the sum of the roots of the steps between times: the larger, the more even."""
    return float(np.sum(np.sqrt(np.maximum(np.diff(times), 0.0))))


class _Topic:
    """A topic without stamps: how even its times are, by receipt and by others."""

    def __init__(self):
        self.even = np.zeros(2)
        self.last = (np.empty(0, dtype=np.int64),) * 2
        self.by_others = 0
        self.dated = 0


class Dating:
    """Dates the messages of topics without stamps as they come."""

    def __init__(self):
        self._received = self._stamps = np.empty(0, dtype=np.int64)
        self._topics: dict[str, _Topic] = {}

    def learn(self, received: np.ndarray, stamps: np.ndarray) -> None:
        """Take messages of the position: (n,) ns, when they were received, and their stamps."""
        self._received = np.concatenate((self._received, received))[-KEPT:]
        self._stamps = np.concatenate((self._stamps, stamps))[-KEPT:]

    def dated(self, topic: str, received: np.ndarray) -> np.ndarray:
        """Return the times of messages of a topic, (n,) ns."""
        if not len(self._received):
            return received
        one = self._topics.setdefault(topic, _Topic())
        both = received, beside(received, self._received, self._stamps)
        one.even = FADES * one.even + [evenness(np.concatenate((last, times)))
                                       for last, times in zip(one.last, both, strict=True)]
        one.last = tuple(times[-1:] for times in both)
        if abs(self._stamps[-1] - self._received[-1]) > WAITS_NS:
            one.by_others = 1  # they are of another clock: sim time, or a controller's
        elif one.even[1 - one.by_others] > EVENER * one.even[one.by_others]:
            one.by_others = 1 - one.by_others
        found = both[one.by_others]
        # From one to the other they must not go back: that is what a clock that was set does.
        least = one.dated + LEAST_NS * np.arange(1, 1 + len(found))
        found = np.where((found < least) & (least < found + WAITS_NS), least, found)
        one.dated = int(found[-1])
        return found
