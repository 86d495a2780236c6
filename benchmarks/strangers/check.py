"""The plant against itself: balances, step size, stability, plausible levels."""

from dataclasses import dataclass

import numpy as np

from strangers.plant import (
    N_STATE,
    P1,
    P2,
    PA,
    WARM,
    Constants,
    F,
    V,
    W,
    X,
    fine_run,
    friction_force,
    moving,
    rates,
    rest,
)
from strangers.rigs import Rig


@dataclass(frozen=True)
class Checked:
    """What was found of one rig.

    Attributes
    ----------
    flow : largest error of a chamber's volume balance over the run, as a share of what was
        pumped.
    energy : error of the work balance of the piston, as a share of the work of the pressures.
    step : largest change of x on halving the step, over the position's noise; likewise
        ``step_p`` of p1 - p2 over the pressures' noise.
    damping : real part of the slowest-dying oscillation of the closed loop about x = 0, 1/s;
        negative is stable.  The loop is taken as continuous, with the hold as a lag of half
        its period.
    lowest : smallest pressure, absolute Pa.
    rpm, speed : largest shaft speed and piston speed (m/s).
    swept : swept volume over the smaller chamber's volume.
    """

    flow: float
    energy: float
    step: float
    step_p: float
    damping: float
    lowest: float
    rpm: float
    speed: float
    swept: float

    def faults(self) -> list[str]:
        """Return what is not as it must be."""
        rules = (("flow balance", self.flow < 1e-4), ("energy balance", self.energy < 1e-3),
                 ("step size, x", self.step < 0.05), ("step size, p", self.step_p < 0.05),
                 ("stability", self.damping < -0.5), ("vacuum", self.lowest > 5e4),
                 ("shaft speed", self.rpm < 6000), ("piston speed", self.speed < 0.5),
                 ("volume", self.swept < 0.5))
        return [name for name, good in rules if not good]


def check(rig: Rig) -> Checked:
    """Return the figures of one rig."""
    c = Constants(*map(float, rig.plant))
    out, time, at, _ = fine_run(rig)
    steps = round((time[at[1]] - time[at[0]]) / (time[1] - time[0]))
    finer, _, at_2, _ = fine_run(rig, substeps=2 * steps)
    coarse, fine = out[at], finer[at_2]
    spread = max(rig.sensors.position_noise, 1e-9)
    after = out[at[0]:]
    return Checked(
        flow=_flow(after, time, c, rig.drive.hold > 0), energy=_energy(after, time, c),
        step=float(np.abs(coarse[:, X] - fine[:, X]).max() / spread),
        step_p=float(np.abs((coarse - fine)[:, [P1, P2]]).max() / rig.sensors.pressure_noise),
        damping=_damping(rig, c), lowest=float(out[:, [P1, P2]].min()),
        rpm=float(np.abs(after[:, W]).max() * 30 / np.pi),
        speed=float(np.abs(after[:, V]).max()),
        swept=float(max(np.ptp(after[:, X]) * c.area_1 / c.volume_1,
                        np.ptp(after[:, X]) * c.area_2 / c.volume_2)))


def _integral(values, h):
    """Return the running integral of (m,) by the trapezoid."""
    return np.concatenate([[0.0], np.cumsum(0.5 * h * (values[1:] + values[:-1]))])


def _flow(y, time, c, held):
    """Compare oil that went in, by quadrature, with compressed oil, int (V/beta) dp."""
    h = time[1] - time[0]
    # Where the drive jumps, the speed that acts in a step is that at its beginning.
    pumped = np.concatenate([[0.0], np.cumsum(h * y[:-1, W])])
    if c.lag > 0.0 or not held:
        pumped = _integral(y[:, W], h)
    worst = 0.0
    second = c.makeup if c.makeup_2 < 0 else c.makeup_2
    case_2 = c.case_leakage if c.case_leakage_2 < 0 else c.case_leakage_2
    for p, area, volume, sign, displacement, g, leak in (
            (y[:, P1], c.area_1, c.volume_1, 1.0, c.displacement_1, c.makeup, c.case_leakage),
            (y[:, P2], c.area_2, c.volume_2, -1.0, c.displacement_2, second, case_2)):
        q = (-sign * c.cross_leakage * (y[:, P1] - y[:, P2]) - leak * (p - c.tank)
             + g * (y[:, PA] - p)
             + c.check_valve * np.maximum(0.0, y[:, PA] - c.cracking - p))
        into = sign * displacement * pumped - sign * area * (y[:, X] - y[0, X]) + _integral(q, h)
        room = volume + sign * area * y[:, X]
        stored = np.concatenate(
            [[0.0], np.cumsum(0.5 * (room[1:] + room[:-1]) * np.diff(p))]) / c.bulk_modulus
        turned = max(np.ptp(displacement * pumped), area * np.ptp(y[:, X]))
        worst = max(worst, float(np.abs(into - stored).max() / turned))
    return worst


def _energy(y, time, c):
    """Compare the work of the pressures with friction, load and kinetic energy."""
    h = time[1] - time[0]
    v = np.array([moving(speed, c) for speed in y[:, V]])
    force = c.area_1 * y[:, P1] - c.area_2 * y[:, P2]
    viscous = c.damping * (1.0 - c.damping_drop * y[:, WARM]) * v
    dry = np.array([friction_force(*row, c)[0] for row in zip(
        y[:, V], y[:, F], force - viscous - c.load, strict=True)])
    work = _integral(force * v, h)
    spent = _integral((viscous + dry + c.load) * v, h)
    kinetic = 0.5 * c.mass * (v * v - v[0] ** 2)
    total = _integral(np.abs(force * v), h)[-1]
    return float(np.abs(work - spent - kinetic).max() / total)


def _damping(rig, c):
    """Return the largest real part of the linearised loop's oscillating poles."""
    # Dry friction only damps: the loop must be stable without it.
    slip = c._replace(friction=0.0, lag=max(c.lag, 1e-5)
                      + 0.5 * rig.drive.hold / rig.rate, check_valve=0.0)
    y = rest(slip, 0.0)
    plus, minus = np.empty(N_STATE), np.empty(N_STATE)
    kept = [X, V, P1, P2, W]
    jacobian = np.empty((5, 5))
    for k, (j, step) in enumerate(zip(kept, (1e-6, 1e-5, 1e2, 1e2, 1e-2), strict=True)):
        for sign, into in ((1.0, plus), (-1.0, minus)):
            z = y.copy()
            z[j] += sign * step
            rates(z, -slip.gain * z[X], slip, into)
        jacobian[:, k] = ((plus - minus) / (2 * step))[kept]
    poles = np.linalg.eigvals(jacobian)
    ringing = poles[np.abs(poles.imag) > 1.0]
    return float((ringing if len(ringing) else poles).real.max())
