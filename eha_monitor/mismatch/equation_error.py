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
from scipy.signal import butter, sosfiltfilt

from eha_monitor.mismatch.experiment import Experiment, Stretch
from eha_monitor.mismatch.innovations import CLOSED, FORCED, OPEN
from eha_monitor.mismatch.inputs import filled
from eha_monitor.mismatch.missing import contributions_along, drive_along
from eha_monitor.physics import signals as s
from eha_monitor.physics.contributions import circuit_of, new_memory

MOTION, BAND = 20.0, 5.0  # Hz: pass bands of the motion, and of every balance
FINE, COARSE = 8, 4  # points in a period of ``BAND``; each so-many-th of them is compared
STANDING = 0.02  # of the top speed: below, dry friction takes any value, and tells nothing
APART = 0.1  # s on both sides of what is not counted that the low-pass mixes with it
MOST_KEPT = 256  # stretches whose motion is kept at hand


class Motion:
    """The measured motion of a stretch on a grid of ``FINE * BAND`` Hz; SI, (m,) each.

    ``track`` (m, N_SIGNALS) signals; ``acceleration``, ``rate_1``, ``rate_2`` in m/s^2 and Pa/s;
    ``force`` that drives, N; ``compared`` places that enter the fit, ``moving`` (m,) bool.
    """

    def __init__(self, experiment: Experiment, stretch: Stretch):
        dt = experiment.dt
        self.every = max(1, round(1.0 / (FINE * BAND * dt)))
        self.dt = self.every * dt
        cutoff = min(MOTION, 0.2 / dt)
        self.smooth = low_pass(cutoff, dt)
        self.band = low_pass(BAND, self.dt)

        def fine(values):
            return self.smooth(filled(values))[:: self.every]

        rig, z = experiment.settings.rig, stretch.z
        x = self.smooth(filled(z[:, 0]))
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
        self.moving = np.convolve(~fast, np.ones(5), mode="same") < 0.5


def low_pass(cutoff: float, dt: float):
    """Return a zero-phase low-pass (Butterworth, fourth order, both ways) of ``cutoff`` Hz."""
    sections = butter(4, cutoff, fs=1.0 / dt, output="sos")
    return lambda values: sosfiltfilt(sections, values)


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
    track = motion.track
    c = np.zeros((len(track), s.N_CONTRIBUTIONS))
    contributions_along(track, motion.dt, 2, theta, active, new_memory(), c)
    v = track[:, s.V]
    force = (motion.force - theta[s.B] * v - c[:, s.FORCE]
             - (theta[s.M] + c[:, s.MASS]) * motion.acceleration)
    found = [np.where(motion.moving, motion.band(force), np.nan)]
    if experiment.mode != FORCED:
        found.append(motion.band(_flow(theta, track, motion, c)))
    if experiment.mode == CLOSED:
        made = np.zeros(len(stretch))
        drive_along(filled(stretch.z[:, 0]), stretch.u, experiment.dt, 1, theta,
                    circuit_of(theta, active), made)
        speed = track[:, s.OMEGA] - motion.smooth(made)[:: motion.every]
        found.append(motion.band(speed))
    return np.stack(found, axis=1)[motion.compared]


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
