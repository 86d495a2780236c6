"""Channels with stamps of their own onto one uniform grid."""

import hashlib
from collections.abc import Callable

import numpy as np

from eha_monitor.errors import InputError, one_line
from eha_monitor.recordings.between import interpolate, released
from eha_monitor.recordings.cdr import Series
from eha_monitor.recordings.dating import EVENER, beside, evenness
from eha_monitor.recordings.grid import JITTER, Grid, fit_grid, repair, tell_gaps
from eha_monitor.recordings.recording import CHANNELS, Recording, within_limits
from eha_monitor.settings.monitor import Settings

CLOCKS = 2**61  # ns; stamps are held within this range, so that differences do not overflow
SPARSE = 1000  # grid points for each sample, beyond which a recording is refused


def align(series: dict[str, tuple[Series, str]], settings: Settings, *, source: str = "",
          losses: list[str] | tuple[str, ...] = ()) -> Recording:
    """Put channels on one grid; gaps stay NaN, and what was repaired is said.

    The grid is that of ``x``, or of the channel with the most samples where there is no ``x``.

    Parameters
    ----------
    series : channel -> (series in SI, topic or "").
    settings : ``rig.sample_time`` is the sample time where the stamps agree within 5 %.
    source : file, for errors.
    losses : sentences to begin with.

    Raises
    ------
    InputError
        If the stamps are too sparse for a grid.
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
    columns = released(columns, grid.step, said)
    tell_gaps(columns, grid.step, said)
    return Recording(sample_time=grid.step, channels=columns,
                     start_ns=max(0, origin + round(grid.start * 1e9)), source=source,
                     losses=tuple(dict.fromkeys(map(one_line, said))))


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
    """Return the stamps of a topic; without any, see :mod:`eha_monitor.recordings.dating`."""
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
