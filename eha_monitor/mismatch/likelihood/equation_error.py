"""What is left of each balance on the measured motion: the error of the equations themselves.

A filter predicts the position from the force and asks which model predicts best.  Where the force
is told by noisy sensors and the position by an encoder that is worth a thousandth of it, that
question has a wrong answer: a model with a false mass, which does not respond to the noise, wins.
There the balances are taken as they stand, with velocity and acceleration from the position, all
low-passed alike, and the error is that of the noisy side: inverse dynamics, as rigs are identified
in practice (Gautier, Janot, Vandanjon 2013).  It also serves circuits whose mean pressure the
model does not know (valves and an accumulator around a single-rod cylinder): the flow balance is
that of the chamber with the higher pressure, the one that the pump fills.
"""

from functools import lru_cache

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from eha_monitor.mismatch.data.experiment import Experiment, Stretch
from eha_monitor.mismatch.data.inputs import CLOSED, FORCED, OPEN, filled
from eha_monitor.mismatch.likelihood.along import contributions_along, drive_along
from eha_monitor.physics import signals as s
from eha_monitor.physics.contributions import circuit_of, new_memory

MOTION, BAND = 20.0, 5.0  # Hz: pass bands of the motion, and of every balance
FINE, COARSE = 8, 4  # points in a period of ``BAND``; each so-many-th of them is compared
STANDING = 0.02  # of the top speed: below, dry friction takes any value, and tells nothing
SETTLING, RISING = 0.5, 0.05  # s; share of the highest pressure that it may change by in that
DIED_OUT = 2.5  # periods of the cutoff after which a low-pass has forgotten
APART = 0.1  # s on both sides of what is not counted that the low-pass mixes with it
MOST_KEPT = 256  # stretches whose motion is kept at hand


class Motion:
    """The measured motion of a stretch on a grid of ``FINE * BAND`` Hz; SI, (m,) each.

    ``track`` (m, N_SIGNALS) signals; ``acceleration``, ``rate_1``, ``rate_2`` in m/s^2 and Pa/s;
    ``force`` that drives, N; ``compared`` places that enter the fit; ``telling`` for force, flow
    and drive (m,) bool, where the balance tells something.
    """

    def __init__(self, experiment: Experiment, stretch: Stretch):
        dt = experiment.dt
        self.every = max(1, round(1.0 / (FINE * BAND * dt)))
        self.dt = self.every * dt
        smooth = low_pass(min(MOTION, 0.2 / dt), dt)
        self.smooth = Smoother(min(MOTION, 0.2 / dt), dt, self.every)
        self.band = Smoother(BAND, self.dt)

        def fine(values):
            return smooth(filled(values))[:: self.every]

        rig, z = experiment.settings.rig, stretch.z
        x = smooth(filled(z[:, 0]))
        v = np.gradient(x, dt)
        self.track = np.zeros((len(x[:: self.every]), s.N_SIGNALS))
        self.track[:, s.T] = np.arange(len(self.track)) * self.dt
        self.track[:, s.X], self.track[:, s.V] = x[:: self.every], v[:: self.every]
        self.acceleration = np.gradient(v, dt)[:: self.every]
        if experiment.mode == FORCED:
            p1, p2 = stretch.p1, stretch.p2
            self.force = fine(stretch.u[:, 0])
        else:
            p1, p2 = filled(z[:, 2]), filled(z[:, 3])
            self.force = fine(rig.area_1 * p1 - rig.area_2 * p2)
            self.track[:, s.OMEGA] = fine(stretch.u[:, 0] if experiment.mode == OPEN else z[:, 4])
            self.track[:, s.X_D] = fine(stretch.u[:, 0])
        self.track[:, s.P1], self.track[:, s.P2] = fine(p1), fine(p2)
        self.rate_1 = np.gradient(self.track[:, s.P1], self.dt)
        self.rate_2 = np.gradient(self.track[:, s.P2], self.dt)
        reach = max(1, round(APART / dt))
        apart = np.convolve(~stretch.counted, np.ones(2 * reach + 1), mode="same") > 0.5
        self.compared = np.arange(0, len(self.track), COARSE)
        self.compared = self.compared[~apart[:: self.every][self.compared]]
        fast = np.abs(self.track[:, s.V]) > STANDING * experiment.ranges.speed
        moving = np.convolve(~fast, np.ones(5), mode="same") < 0.5
        self.telling = (moving, self._settled(), np.ones(len(moving), dtype=bool))

    def _settled(self) -> np.ndarray:
        """Tell where the higher pressure stays, (m,) bool.

        While it rises, hoses and accumulator swallow what no parameter of the chambers stands for.
        """
        pressure = self.band(np.maximum(self.track[:, s.P1], self.track[:, s.P2]))
        reach = max(1, round(0.5 * SETTLING / self.dt))
        padded = np.pad(pressure, reach, mode="edge")
        change = np.abs(padded[2 * reach :] - padded[: -2 * reach])
        return change < RISING * max(float(np.quantile(pressure, 0.98)), 1e-300)


def low_pass(cutoff: float, dt: float):
    """Return a zero-phase low-pass (Butterworth, fourth order, both ways) of ``cutoff`` Hz."""
    from scipy.signal import butter, sosfiltfilt  # takes half of the start of ``diagnose``

    sections = butter(4, cutoff, fs=1.0 / dt, output="sos")
    return lambda values: sosfiltfilt(sections, values)


class Smoother:
    """The same low-pass as its impulse response, cut where it has died out: much quicker.

    ``every`` : of its output each so-many-th value is kept.
    """

    def __init__(self, cutoff: float, dt: float, every: int = 1):
        self.reach, self.every = max(4, round(DIED_OUT / cutoff / dt)), every
        impulse = np.zeros(6 * self.reach + 1)
        impulse[3 * self.reach] = 1.0
        taps = low_pass(cutoff, dt)(impulse)[2 * self.reach : 4 * self.reach + 1]
        self.taps = taps / taps.sum()

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Return the low-passed values, (n / every,); both ends are mirrored through a point."""
        longer = np.pad(values, self.reach, mode="reflect", reflect_type="odd")
        if self.every == 1:
            return np.convolve(longer, self.taps, mode="valid")
        return sliding_window_view(longer, len(self.taps))[:: self.every] @ self.taps


@lru_cache(maxsize=MOST_KEPT)
def _motion(key: tuple, holder) -> Motion:
    return Motion(*holder.held)


class _Holder:
    """Carries what cannot be hashed past the cache."""

    def __init__(self, experiment, stretch):
        self.held = experiment, stretch

    def __hash__(self):
        return 0

    def __eq__(self, other):
        return isinstance(other, _Holder)


def motion_of(experiment: Experiment, stretch: Stretch) -> Motion:
    """Return the motion of a stretch, made once for each set of counted samples."""
    return _motion((id(stretch.z), id(stretch.u), id(stretch.counted)),
                   _Holder(experiment, stretch))


def residuals(experiment: Experiment, theta: np.ndarray, active: np.ndarray) -> np.ndarray:
    """Return what is left of the balances at the compared samples, (c N, c).

    Columns: force in N, where the pump speed is known flow in m^3/s, and where its demand is known
    shaft speed in rad/s.
    Each balance has rows of its own, NaN elsewhere: one's noise says nothing about another's.
    """
    left = np.concatenate([_residuals_of(experiment, stretch, theta, active)
                           for stretch in experiment.stretches])
    n, columns = left.shape
    rows = np.full((columns * n, columns), np.nan)
    for j in range(columns):
        rows[j * n : (j + 1) * n, j] = left[:, j]
    return rows


def _residuals_of(experiment, stretch, theta, active) -> np.ndarray:
    motion = motion_of(experiment, stretch)
    left = np.stack([motion.band(row) for row in left_along(
        experiment, stretch, theta, active)], axis=1)
    for j in range(left.shape[1]):
        left[~motion.telling[j], j] = np.nan
    return left[motion.compared]


def left_along(experiment: Experiment, stretch: Stretch, theta: np.ndarray, active: np.ndarray
               ) -> list[np.ndarray]:
    """Return what is left of each balance on the fine grid of a stretch, not yet low-passed.

    Force in N, flow in m^3/s, shaft speed in rad/s; (m,) each.
    """
    motion = motion_of(experiment, stretch)
    track = motion.track
    c = np.zeros((len(track), s.N_CONTRIBUTIONS))
    contributions_along(track, motion.dt, 2, theta, active, new_memory(), c)
    found = [motion.force - theta[s.B] * track[:, s.V] - c[:, s.FORCE]
             - (theta[s.M] + c[:, s.MASS]) * motion.acceleration]
    if experiment.mode != FORCED:
        found.append(_flow(theta, track, motion, c))
    if experiment.mode == CLOSED:
        made = np.zeros(len(stretch))
        drive_along(filled(stretch.z[:, 0]), stretch.u, experiment.dt, 1, theta,
                    circuit_of(theta, active), made)
        found.append(track[:, s.OMEGA] - motion.smooth(made))
    return found


def _flow(theta, track, motion, c) -> np.ndarray:
    """Return what is left of the flow into the chamber of the higher pressure, as of chamber 1."""
    ratio = theta[s.AREA_2] / theta[s.AREA_1]
    pumped = theta[s.D_P] * (track[:, s.OMEGA] + c[:, s.SPEED])
    crossing = 0.5 * (theta[s.C_T] - theta[s.G_MAKEUP]) * (track[:, s.P1] - track[:, s.P2])
    left = []
    for sign, share, pressure, rate, chamber, volume, more, flow, area in (
            (1.0, 1.0, s.P1, motion.rate_1, s.VOL_1, s.VOLUME_1, s.COMPLIANCE_1, s.FLOW_1,
             s.AREA_1),
            (-1.0, ratio, s.P2, motion.rate_2, s.VOL_2, s.VOLUME_2, s.COMPLIANCE_2, s.FLOW_2,
             s.AREA_2)):
        into = (sign * (share * pumped - theta[area] * track[:, s.V] - crossing)
                - theta[s.G_MAKEUP] * (track[:, pressure] - theta[s.P_CHARGE]) + c[:, flow])
        capacity = (theta[chamber] + c[:, volume]) * (1.0 / theta[s.BETA_E] + c[:, more])
        left.append(sign / share * (into - capacity * rate))
    return np.where(track[:, s.P1] > track[:, s.P2], left[0], left[1])
