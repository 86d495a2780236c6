"""The measured motion of a recording on a coarse grid, and which of its samples count.

The balances are compared as they stand, with velocity and acceleration from the position
(inverse dynamics: Gautier, Janot, Vandanjon 2013).  Both sides of a balance pass the same
low-pass without phase, so that a linear law stays exactly that law whatever the band.
"""

from dataclasses import dataclass

import numpy as np
from scipy.signal import butter, sosfiltfilt

from eha_monitor.errors import InputError
from eha_monitor.estimation.rig_model import force_missing, force_of
from eha_monitor.estimation.sensors import noise_levels, without_spikes
from eha_monitor.mismatch.data.inputs import filled
from eha_monitor.mismatch.data.stops import between_stops
from eha_monitor.recordings.recording import Recording, sample_of
from eha_monitor.settings.monitor import Settings

MOTION, BAND = 20.0, 5.0  # Hz: pass bands of the motion, and of every balance
GRID, COARSE = 32, 4  # points in a period of ``BAND``; each so-many-th of them is compared
APART = 0.1  # s: how far the balance's low-pass mixes a sample with its neighbours
STANDING = 0.02  # of the top speed: below it dry friction takes any value
DEAD = 0.02  # s: a value that does not change for longer while others do ...
JUMPED = 5.0  # ... times the usual largest step away from what comes before or after
SHORTEST = 0.5  # s of usable recording
COMMANDED, MEASURED = 0.005, 0.05  # of its size: a smaller demand has no sign; noise-free, noisy
TRAVEL = 20.0  # times the position's noise: less is no motion


@dataclass(frozen=True)
class Course:
    """A recording on a grid of ``GRID * BAND`` Hz; (m,) each, SI, not yet in the band.

    Attributes
    ----------
    source : file it came from.
    dt : spacing of the grid, s.
    x, v, a : position, velocity, acceleration.
    force : A1 p1 - A2 p2, or the measured force.
    p1, p2, rate_1, rate_2 : pressures and their rates; None where not recorded.
    omega : pump speed, rad/s; None where not recorded.
    demand : what the drive or valve is commanded, any unit: only its sign is used; None if no
        channel says.
    quiet : share of its usual size below which the demand has no sign.
    good : (m,) bool, measured on all channels and away from stops.
    moving : (m,) bool, fast enough for dry friction to have a sign.
    """

    source: str
    dt: float
    x: np.ndarray
    v: np.ndarray
    a: np.ndarray
    force: np.ndarray
    p1: np.ndarray | None
    p2: np.ndarray | None
    rate_1: np.ndarray | None
    rate_2: np.ndarray | None
    omega: np.ndarray | None
    demand: np.ndarray | None
    quiet: float
    good: np.ndarray
    moving: np.ndarray

    def __len__(self) -> int:
        return len(self.x)

    @property
    def speed(self) -> float:
        """Top speed, m/s."""
        return float(np.quantile(np.abs(self.v[self.good]), 0.998))

    @property
    def direction(self) -> np.ndarray:
        """Sign of the velocity, linear through zero below the standing speed; (m,)."""
        return np.clip(self.v / max(STANDING * self.speed, 1e-12), -1.0, 1.0)

    @property
    def every(self) -> int:
        """Of the grid's points each so-many-th is compared; the finer ones keep signs in place."""
        return max(1, round(COARSE / (GRID * BAND * self.dt)))

    def in_band(self, columns: np.ndarray) -> np.ndarray:
        """Return columns (m, k) or (m,) after the low-pass of every balance, compared points."""
        return _low_pass(columns, BAND, self.dt)[:: self.every]

    def compared(self, values: np.ndarray) -> np.ndarray:
        """Return values (m,) at the compared points."""
        return values[:: self.every]

    @property
    def step(self) -> float:
        """Spacing of the compared points, s."""
        return self.every * self.dt


def course_of(recording: Recording, settings: Settings) -> Course:
    """Return the measured motion of a recording.

    Raises
    ------
    InputError
        If position or force are missing, or less than ``SHORTEST`` s are usable.
    """
    rig, recording = settings.rig, sample_of(recording)
    why = force_missing(rig, [name for name in recording.channels if recording.has(name)])
    if why:
        raise InputError(f"{recording.source}: {why}")
    dt = recording.sample_time
    names = [name for name in ("x", "x_d", "omega", "omega_d", "p1", "p2", "force")
             if recording.has(name)]
    noise = noise_levels(recording, settings.noise)
    cleaned, _ = without_spikes({name: recording.channels[name] for name in names}, noise)
    cleaned = {name: np.where(_dead(values, dt), np.nan, values)
               for name, values in cleaned.items()}
    needed = [name for name in names if name not in ("x_d", "omega_d")]
    missing = ~np.all([np.isfinite(cleaned[name]) for name in needed], axis=0)
    whole = {name: filled(values) for name, values in cleaned.items()}
    away = np.zeros(len(recording), dtype=bool)
    for first, last in between_stops(whole["x"], force_of(rig, whole), dt):
        away[first:last] = True

    every = max(1, round(1.0 / (GRID * BAND * dt)))
    cutoff = min(MOTION, 0.2 / dt)
    reach = max(1, round(APART / dt))
    bad = np.convolve(missing | ~away, np.ones(2 * reach + 1), mode="same") > 0.5
    bad[:reach] = bad[-reach:] = True

    def fine(values):
        return _low_pass(values, cutoff, dt)[::every]

    x = _low_pass(whole["x"], cutoff, dt)
    v = np.gradient(x, dt)
    a, step, good = np.gradient(v, dt)[::every], every * dt, ~bad[::every]
    if good.sum() * step < SHORTEST:
        raise InputError(f"{recording.source}: expected at least {SHORTEST:g} s of motion away "
                         f"from stops with all channels, found {good.sum() * step:.1f} s")
    v = v[::every]
    p1, p2, omega = (fine(whole[name]) if name in whole else None
                     for name in ("p1", "p2", "omega"))
    top = np.quantile(np.abs(v[good]), 0.998)
    slow = np.abs(v) < STANDING * top
    slow[1:] |= v[1:] * v[:-1] <= 0.0  # a quick reversal may fall between two points
    near = max(1, round(APART / step))
    moving = np.convolve(slow, np.ones(2 * near + 1), mode="same") < 0.5
    moving &= np.ptp(x[::every][good]) > TRAVEL * noise["x"].value
    demand = whole.get("omega_d", whole.get("omega"))
    return Course(
        recording.source, step, x[::every], v, a, fine(force_of(rig, whole)), p1, p2,
        None if p1 is None else np.gradient(p1, step),
        None if p2 is None else np.gradient(p2, step), omega,
        None if demand is None else fine(demand), (COMMANDED if "omega_d" in whole
                                                           else MEASURED),
        good, moving & good)


def _low_pass(values: np.ndarray, cutoff: float, dt: float) -> np.ndarray:
    """Return values (n,) or (n, k) behind a Butterworth low-pass of ``cutoff`` Hz, both ways."""
    sections = butter(4, cutoff, fs=1.0 / dt, output="sos")
    return sosfiltfilt(sections, values, axis=0, padlen=min(len(values) - 1, round(1.0 / dt)))


def _dead(values: np.ndarray, dt: float) -> np.ndarray:
    """Return which samples are dead, (n,) bool: held for long, and far from before or after.

    A sensor that drops to nil or a logger that repeats its last value; a position at rest is
    neither, since it goes on from where it stood.
    """
    starts = np.flatnonzero(np.concatenate([[True], values[1:] != values[:-1]]))
    lengths = np.diff(np.append(starts, len(values)))
    jumps = np.abs(np.diff(values))
    moved = jumps[np.isfinite(jumps) & (jumps > 0.0)]
    if not len(moved):
        return np.zeros(len(values), dtype=bool)
    far = JUMPED * np.quantile(moved, 0.98)
    before = np.concatenate([[0.0], jumps])[starts]
    after = np.append(jumps, 0.0)[starts + lengths - 1]
    dead = (lengths * dt > DEAD) & (np.maximum(np.nan_to_num(before), np.nan_to_num(after)) > far)
    return np.repeat(dead, lengths)
