"""How far what the model lacks can have moved a parameter.

A misfit shows in the innovations; what of it looks like the parameter does not.  So the stage is
run again over some seconds with terms that the balance may lack, each with an unknown
coefficient: the innovations z are linear in the coefficients near by, z(theta) = z_0 + H theta,
and the least squares of z with a prior P_0 that allows each term to be as large as the whole force
(or pump flow), a sensor's scale or the pump's to be off by OFF_SCALE and a signal to be late by
LATE_S, give theta, its covariance C, and the parameter's value with it,

    C = (H'H/rho + P_0^-1)^-1,    theta_1 = theta_0 - C (H'z/rho + P_0^-1 theta_0),
    reach = |shift| + 2 sigma,

where sigma is that of the shift by C and rho the variance ratio (:mod:`consistency`) that
remains: the innovations are then still not white, the data count for less, and the shift is
taken sqrt(rho) times and a quarter larger, for what the terms do not describe.  Where the motion
does not tell a term from the parameter, C is that of the prior and the reach is large: a triangle
at one speed does not tell dry friction from viscous friction.

A force that the model lacks adds to B, so its reach is in N·s/m; a flow scales beta_e, so that
reach is of ln beta_e, as in :class:`judge.Rebase`.  The reach covers dry, quadratic, direction
dependent and pre-sliding friction, spring, load, leakage, pump gain, slip and lag (tests).  It is
too short for a line between pump and cylinder and for a wrong mass in beta_e; and in beta_e for a
late drive at a single sine, and for a lag or a large leakage at a triangle, whose corners alone
show beta_e.
"""

import math
from collections import deque
from collections.abc import Callable, Collection, Generator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from eha_monitor.estimation import stage_two
from eha_monitor.estimation.consistency import SMALLEST_SAMPLES, variance_ratios
from eha_monitor.estimation.discretisation import GAIN, LOOP, MASS
from eha_monitor.estimation.inputs import StageInputs
from eha_monitor.estimation.results import CONVERGED, ParameterEstimate
from eha_monitor.estimation.stage_two import new_state_two
from eha_monitor.estimation.stages import constants_two, run_stage_one_kernel
from eha_monitor.settings.monitor import Settings

WINDOW_S = 5.0  # over so many seconds
SHORTEST_S = 2.0
MEMORY_S = 30.0
EXPLAINED = 1.6  # variance ratio that is the filters' own (:data:`consistency.TOLERANCE`)
SAFETY = 1.25
STEPS = 4  # of Gauss and Newton, at most
NEAR = 1e-4  # step of the slopes
NEARER = 0.1  # of the reach: a step that moves the parameter by less is the last
FARTHEST = 0.5  # a step of ln c
BROAD = 3.0  # prior sigma of ln c: any
HALF = 10  # samples on each side over which a slope is taken
TURNING = 0.05  # of the rms speed, over which a dry friction turns over
NOWHERE = math.inf
# What a sensor or a pump may be off, where the rest of a force or a flow may be all of it.
LATE_S = 5e-3
OFF_SCALE = 0.1

# Takes coefficients; returns the whitened innovations (n,) and the parameter.
Run = Callable[[np.ndarray], tuple[np.ndarray, float]]


@dataclass(frozen=True)
class Explained:
    """Parameter with the terms fitted: its value, sigma by theirs, the ratio that remains."""

    value: float
    stddev: float
    ratio: float

    def reach(self, present: float) -> float:
        """Return how far ``present`` may be off."""
        rest = math.sqrt(self.ratio) if self.ratio > EXPLAINED else 1.0
        found = SAFETY * rest * abs(present - self.value) + 2.0 * self.stddev
        return found if math.isfinite(found) else NOWHERE


class Look:
    """A look under way, one filter run at a time: all at once it would hold up the samples.

    A copy of what an estimator knows has no look under way.
    """

    def __init__(self):
        self._runs: Generator | None = None

    def begin(self, runs: Generator) -> None:
        """Take what :func:`reaches_of` returns."""
        self._runs = runs

    @property
    def under_way(self) -> bool:
        """Whether there is one."""
        return self._runs is not None

    def go_on(self) -> dict[str, float] | None:
        """Make the next run; return what was found, once it is."""
        try:
            next(self._runs)
        except StopIteration as end:
            self._runs = None
            return end.value
        return None

    def __deepcopy__(self, memo: dict) -> "Look":
        return Look()


def finished(runs: Generator):
    """Make all runs; return what was found."""
    look = Look()
    look.begin(runs)
    while look.under_way:
        found = look.go_on()
    return found


class Reaches:
    """How far a mismatch that stands can have moved each parameter: the most of the last looks.

    A value under a mismatch is an average over half a minute, in which the motion may have been
    another one.
    """

    def __init__(self):
        self._looks: dict[str, deque[tuple[float, float]]] = {}

    def note(self, time_s: float, found: Mapping[str, float]) -> None:
        """Take a look at ``time_s``; a parameter that it does not tell is absent."""
        for name, reach in found.items():
            looks = self._looks.setdefault(name, deque())
            looks.append((time_s, reach))
            while time_s - looks[0][0] > MEMORY_S:
                looks.popleft()

    def most(self) -> dict[str, float]:
        """Return the largest by symbol."""
        return {name: max(reach for _, reach in looks) for name, looks in self._looks.items()}


def reaches_of(stages: Collection[str], inputs: StageInputs, settings: Settings,
               parameters: Mapping[str, ParameterEstimate], stage_two_had: tuple[float, float]
               ) -> Generator[None, None, dict[str, float]]:
    """Find by symbol how far the misfit of some stages can have moved what it taints.

    This and what it calls stop after each run of a filter (:class:`Look`, :func:`finished`).

    Parameters
    ----------
    stages : ``one``, ``two``, ``joint``: whose innovations do not fit.
    inputs : of some seconds.
    parameters : as they are now.
    stage_two_had : B that stage two takes, N·s/m, and the relative change of beta_e with it.
    """
    damping, sensitivity = stage_two_had
    found: dict[str, float] = {}
    b, beta = parameters["B"], parameters["beta_e"]
    off = b.stddev if b.status == "converged" else settings.stage_two.damping_stddev
    if b.status == "converged" and {"one", "joint"} & set(stages):
        reach = yield from reach_one(inputs, settings, b.value)
        if reach is not None:
            found["B"] = reach
            off = max(off, reach)
    if beta.status != "converged" or inputs.no_drive is not None:
        return found
    if {"two", "joint"} & set(stages):
        reach = yield from reach_two(inputs, settings, beta.value,
                                     (damping, min(off, abs(damping))))
        if reach is not None:
            found["beta_e"] = reach
    elif "B" in found:
        found["beta_e"] = abs(sensitivity * found["B"])
    return found


def explain(run: Run, sigmas: np.ndarray, steps: int
            ) -> Generator[None, None, Explained | None]:
    """Fit the terms' coefficients to the innovations; None where there are too few.

    Parameters
    ----------
    run : see :data:`Run`.
    sigmas : (k,) prior standard deviations of the coefficients.
    steps : Gauss-Newton steps, at most.
    """
    theta, rho = np.zeros(len(sigmas)), 1.0
    z, value = run(theta)
    stddev = NOWHERE
    for _ in range(steps):
        moved = []
        for unit in np.eye(len(sigmas)):
            yield
            moved.append(run(theta + NEAR * unit))
        slopes = np.stack([(one - z) / NEAR for one, _ in moved], axis=1)
        to_value = np.array([(other - value) / NEAR for _, other in moved])
        good = np.isfinite(z) & np.isfinite(slopes).all(axis=1)
        if good.sum() < SMALLEST_SAMPLES or not np.isfinite(to_value).all():
            return None
        h, seen = slopes[good], z[good]
        for _ in range(3):  # the ratio that remains belongs to the step, and the step to it
            covariance = np.linalg.inv(h.T @ h / rho + np.diag(sigmas**-2.0))
            step = -covariance @ (h.T @ seen / rho + theta / sigmas**2)
            rho = _ratio(seen + h @ step)
        stddev = float(np.sqrt(to_value @ covariance @ to_value))
        longest = float(np.abs(to_value @ step))
        theta = theta + step
        z, value = run(theta)
        rho = _ratio(z[np.isfinite(z)])
        if longest < NEARER * 2.0 * stddev:
            break
    return Explained(value, stddev, rho)


def _ratio(z: np.ndarray) -> float:
    if len(z) < SMALLEST_SAMPLES or not np.isfinite(z).all():
        return NOWHERE
    return max(1.0, float(variance_ratios(z)[1].max()))


def reach_one(inputs: StageInputs, settings: Settings, present: float
              ) -> Generator[None, None, float | None]:
    """Find how far the force that the model lacks may have moved B from what it is, N·s/m.

    Parameters
    ----------
    inputs : of some seconds.
    present : B as it is estimated.

    Returns
    -------
    float or None
        inf where the terms cannot be fitted; None where these seconds do not tell B.
    """
    force, x = inputs.measured_force, inputs.x
    if not (_known(force) and _known(x)):
        return None
    v = slope(x, inputs.dt)
    turning = np.tanh(v / max(TURNING * _rms(v), 1e-12))
    late = LATE_S * slope(force, inputs.dt)
    terms = np.stack([*_scaled((np.ones(len(x)), _filled(x) - np.nanmean(x), turning,
                                v * np.abs(v), np.abs(v)), _rms(force)),
                      OFF_SCALE * _filled(force), late])

    def filtered(theta: np.ndarray) -> list[np.ndarray]:
        missing = theta @ terms
        hold = inputs.force._replace(start=inputs.force.start + missing,
                                     end=inputs.force.end + missing)
        return run_stage_one_kernel(replace(inputs, force=hold), settings, frozen=True)[0]

    def run(theta: np.ndarray) -> tuple[np.ndarray, float]:
        out = filtered(theta)
        return out[4] / out[5], float(out[2][-1])

    plain = filtered(np.zeros(len(terms)))
    value, stddev = plain[2][-1], plain[3][-1]
    if not stddev <= CONVERGED * abs(value):
        return None
    found = yield from explain(run, np.ones(len(terms)), STEPS)
    if found is None:
        return NOWHERE
    # The filter's own B may still remember another motion, with which it was off otherwise.
    return max(found.reach(present), found.reach(float(value)))


def reach_two(inputs: StageInputs, settings: Settings, present: float,
              damping: tuple[float, float], steps: int = STEPS
              ) -> Generator[None, None, float | None]:
    """Find how far the flow that the model lacks may have moved ln beta_e.

    Parameters
    ----------
    inputs : of some seconds.
    present : beta_e as it is estimated, Pa.
    damping : B that stage two takes, and how far it may be off, N·s/m.
    steps : Gauss-Newton steps, at most.

    Returns
    -------
    float or None
        As :func:`reach_one`.
    """
    model, drive, n = inputs.model, inputs.drive, len(inputs.x)
    k, constants = model.hydraulics, constants_two(inputs, settings)
    b, b_off = damping
    if not (_known(inputs.x) and _known(drive.start) and present > 0 and math.isfinite(b)):
        return None

    def filtered(ln_c: float, flow: np.ndarray, b: float) -> np.ndarray:
        # c is one of the coefficients here.
        state = new_state_two(k, model.beta_0 / present * math.exp(ln_c), 1e-30, True, held=True)
        rows, out = inputs.rows_two(b, 0.0), np.empty((8, n))
        rows = rows._replace(leak_flow=inputs.leak_flow + flow)
        stage_two.run_two(rows, constants, model.effects, state, 0, out, np.empty((1, 4)))
        return out

    plain = filtered(0.0, np.zeros(n), b)
    force = _filled(k[MASS] * plain[2] + b * plain[1])
    speed = _filled(drive.start) if k[LOOP] == 0.0 else _filled(
        k[LOOP] * (drive.start - inputs.x))
    late = LATE_S * slope(speed, inputs.dt)
    slip = force * np.abs(speed)
    terms = np.stack([*_scaled((np.ones(n), force, np.sign(force) * np.sqrt(np.abs(force)), slip,
                                np.tanh(speed / max(TURNING * _rms(speed), 1e-12))),
                               k[GAIN] * _rms(speed)),
                      OFF_SCALE * k[GAIN] * speed, k[GAIN] * late])

    def with_flows(theta: np.ndarray) -> tuple[np.ndarray, float]:
        out = filtered(theta[-1], theta[:-2] @ terms, b + b_off * theta[-2])
        return out[6] / out[7], theta[-1]

    def with_damping(theta: np.ndarray) -> tuple[np.ndarray, float]:
        return with_flows(np.concatenate([np.zeros(len(terms)), theta]))

    fits = []
    for run, count in ((with_damping, 2), (with_flows, len(terms) + 2)):
        sigmas = np.ones(count)
        sigmas[-1] = BROAD
        found = yield from explain(_limited(run), sigmas, steps)
        if found is None:
            return NOWHERE
        fits.append(found)
    # The sigma of what does not explain the misfit says nothing where something else does.
    if not any(found.ratio <= EXPLAINED for found in fits):
        return max(found.reach(0.0) for found in fits)
    return max(found.reach(0.0) if found.ratio <= EXPLAINED else SAFETY * abs(found.value)
               for found in fits)


def _limited(run: Run) -> Run:
    """Keep ln c within what a float of c can be."""
    def limited(theta: np.ndarray) -> tuple[np.ndarray, float]:
        theta = theta.copy()
        theta[-1] = min(max(theta[-1], -2.0 * BROAD), 2.0 * BROAD)
        return run(theta)
    return limited


def slope(values: np.ndarray, dt: float) -> np.ndarray:
    """Return the derivative by the line of least squares over 2 HALF + 1 samples; (n,)."""
    k = np.arange(-HALF, HALF + 1)
    padded = np.pad(_filled(values), HALF, mode="edge")
    return np.convolve(padded, k[::-1] / (dt * (k @ k)), mode="valid")


def _filled(values: np.ndarray) -> np.ndarray:
    """Return the values with gaps filled by straight lines; zeros where there is none."""
    good = np.flatnonzero(np.isfinite(values))
    if not len(good):
        return np.zeros(len(values))
    return np.interp(np.arange(len(values)), good, values[good])


def _known(values: np.ndarray) -> bool:
    return int(np.isfinite(values).sum()) >= SMALLEST_SAMPLES


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(np.square(values))))


def _scaled(terms: tuple[np.ndarray, ...], rms: float) -> list[np.ndarray]:
    """Return the terms, each of rms ``rms``, without those that vanish."""
    return [term * (rms / size) for term in terms if (size := _rms(term)) > 0.0]
