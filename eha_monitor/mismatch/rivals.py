"""Which latent cause explains a record best: an unknown force, flow, speed, or a sensor's error.

All compete on the likelihood of all channels.  Each is tried in a linear filter over the
innovations of the nominal one, which costs a fraction of a run of the plant.
"""

from dataclasses import dataclass

import numpy as np

from eha_monitor.compiled import njit
from eha_monitor.mismatch.experiment import Experiment
from eha_monitor.mismatch.fit import Fit, filtered, log_likelihood_of, spread, with_unknowns
from eha_monitor.mismatch.gains import Linear, linear_of
from eha_monitor.mismatch.innovations import FORCED, N_FILTERED, riccati
from eha_monitor.mismatch.search import limits_of
from eha_monitor.physics.plant import Y_FLOW, Y_FORCE, Y_P1, Y_P2, Y_SPEED

STANDING = 400  # samples after which a rival's gains are taken to stand
SIZES = tuple(10.0**k for k in range(5))  # times the smallest deviation
LASTING = (0.3, 0.02, 5.0)  # s
HOPEFUL = 0.3  # of the best gain at the first try: the others are not pursued
CLOSE = 0.03  # of the best gain: rivals nearer than that share the blame


@dataclass(frozen=True)
class Rival:
    """Something latent that may be behind the innovations: an unknown or a sensor's error.

    Attributes
    ----------
    name : what it is, e.g. ``force`` or ``sensor_p1``; ``balance`` whose share it counts to.
    smallest : deviation at which it does not show, in its unit.
    state : place of the unknown among the filter's states; -1 for what is none of them.
    outputs : (sensor, weight): what it adds to the measured outputs.
    inputs : (state, weight): what it adds to a state in a sample.
    """

    name: str
    balance: str
    smallest: float
    state: int = -1
    outputs: tuple[tuple[int, float], ...] = ()
    inputs: tuple[tuple[int, float], ...] = ()


@njit(nogil=True)
def rival_innovations(e, columns, drive, a, h, gains, out):
    """Filter the innovations of another filter with a model that has latent states more.

    For a linear plant the truth's deviation from that filter's prediction follows
    d' = A d - (A K) e with e = H d + noise, whatever the filter missed; so these are exactly the
    innovations that the larger model would have had.

    Parameters
    ----------
    e : (n, N_OUTPUTS) innovations of the null filter, NaN where nothing was measured.
    columns : outputs that are used.
    drive : (m, N_FILTERED, N_OUTPUTS) A K of the null filter; the last serves from there on.
    a, h, gains : (N, N), (N_OUTPUTS, N), (m, N, N_OUTPUTS) of the larger model.
    out : (n, N_OUTPUTS) written.
    """
    size = a.shape[0]
    d, other = np.zeros(size), np.zeros(size)
    for k in range(e.shape[0]):
        gain = gains[min(k, gains.shape[0] - 1)]
        given = drive[min(k, drive.shape[0] - 1)]
        for j in columns:
            total = e[k, j]
            for i in range(size):
                total -= h[j, i] * d[i]
            out[k, j] = total
        for j in columns:
            if np.isfinite(out[k, j]):
                for i in range(size):
                    d[i] += gain[i, j] * out[k, j]
        for i in range(size):
            total = 0.0
            for j in range(size):
                total += a[i, j] * d[j]
            if i < given.shape[0]:
                for j in columns:
                    if np.isfinite(e[k, j]):
                        total -= given[i, j] * e[k, j]
            other[i] = total
        for i in range(size):
            d[i] = other[i]


def larger_model(m: Linear, used: np.ndarray, dt: float,
                 rivals: tuple[tuple[Rival, float, float], ...]
                 ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return A, H and gains of the null model with some (rival, deviation, lasting) in it."""
    n = N_FILTERED + sum(rival.state < 0 for rival, _, _ in rivals)
    a, h = np.zeros((n, n)), np.zeros((len(m.r), n))
    q, start = np.zeros(n), np.zeros(n)
    a[:N_FILTERED, :N_FILTERED], h[:, :N_FILTERED] = m.a, m.h
    q[:N_FILTERED], start[:N_FILTERED] = m.q, m.start
    place = N_FILTERED
    for rival, deviation, lasting in rivals:
        i = rival.state
        if i < 0:
            i, place = place, place + 1
        for output, weight in rival.outputs:
            h[output, i] = weight
        for state, weight in rival.inputs:
            a[state, i] = weight
        a[i, i] = np.exp(-dt / lasting)
        start[i] = deviation**2
        q[i] = deviation**2 * (1.0 - a[i, i] ** 2)
    gains = np.zeros((STANDING, n, len(m.r)))
    count = riccati(a, h, q, m.r, np.diag(start), used, gains)
    return a, h, gains[:count]


def rivals_of(experiment: Experiment, m: Linear) -> list[Rival]:
    """Return what may be behind the mismatch in the channels of this record."""
    small, large = limits_of(experiment)
    found = [Rival(balance, balance, low, state)
             for balance, state, low, high in zip(
                 ("force", "flow", "drive"), (Y_FORCE, Y_FLOW, Y_SPEED), small.as_array(),
                 large.as_array(), strict=True) if high > low]
    used = experiment.used
    if experiment.mode != FORCED:
        if used[2] and used[3]:  # out of both chambers alike: leakage to outside, air
            found.append(Rival("mean_flow", "flow", small.flow, inputs=(
                (Y_P1, m.a[Y_P1, Y_FLOW]), (Y_P2, -m.a[Y_P2, Y_FLOW]))))
            found.append(Rival("both_pressures", "sensor", experiment.noise[2],
                               outputs=((2, 1.0), (3, -1.0))))
        found += [Rival(f"sensor_{output}", "sensor", experiment.noise[output],
                        outputs=((output, 1.0),)) for output in (0, 2, 3) if used[output]]
    return found


def latent_gains(experiment: Experiment, fit: Fit) -> dict[str, tuple[Rival, float]]:
    """Return each rival by name, and what it gains, log units, at its best."""
    null = with_unknowns(experiment, fit, limits_of(experiment)[0])
    m = linear_of(experiment, null.theta, null.active, null.unknowns)
    columns, drive = experiment.columns, m.a @ null.gains
    records = [(filtered(experiment, stretch, null.theta, null.active, null.gains)[0],
                stretch.counted) for stretch in experiment.stretches]
    start = log_likelihood_of(null.e)

    def gain(rival: Rival, size: float, lasting: float) -> float:
        a, h, gains = larger_model(m, experiment.used, experiment.dt,
                                   ((rival, size * rival.smallest, lasting),))
        parts = []
        for e, counted in records:
            out = np.full_like(e, np.nan)
            rival_innovations(e, columns, drive, a, h, gains, out)
            parts.append(out[counted])
        return log_likelihood_of(np.concatenate(parts)[:, columns]) - start

    def first(rival: Rival) -> tuple[float, float]:
        return max((gain(rival, size, LASTING[0]), size) for size in SIZES)

    def further(task: tuple[Rival, float, float]) -> float:
        rival, reached, start = task
        for lasting in LASTING[1:]:
            size = start
            value = gain(rival, size, lasting)
            for factor in (10.0, 0.1):
                while SIZES[0] <= size * factor <= SIZES[-1]:
                    other = gain(rival, size * factor, lasting)
                    if other <= value:
                        break
                    size, value = size * factor, other
            reached = max(reached, value)
        return reached

    rivals = rivals_of(experiment, m)
    found = spread(first, rivals)
    worthy = HOPEFUL * max((value for value, _ in found), default=0.0)
    tasks = [(rival, *one) for rival, one in zip(rivals, found, strict=True) if one[0] > worthy]
    gains = {rival.name: (rival, value) for rival, (value, _) in zip(rivals, found, strict=True)}
    for (rival, _, _), value in zip(tasks, spread(further, tasks), strict=True):
        gains[rival.name] = (rival, value)
    return gains


def shares_of(gains: dict[str, tuple[Rival, float]]) -> tuple[dict[str, float], float, list[int]]:
    """Return shares of force, flow, drive and sensor, the best gain, and the sensors suspected."""
    shares = dict.fromkeys(("force", "flow", "drive", "sensor"), 0.0)
    best = max((value for _, value in gains.values()), default=0.0)
    if best <= 0.0:
        return shares, 0.0, []
    for rival, value in gains.values():
        weight = float(np.exp((value - best) / (CLOSE * best + 3.0)))
        shares[rival.balance] = max(shares[rival.balance], weight)
    total = sum(shares.values())
    sensors = [(value, rival) for rival, value in gains.values() if rival.outputs]
    outputs = [output for output, _ in max(sensors, key=lambda row: row[0])[1].outputs
               ] if sensors else []
    return {balance: value / total for balance, value in shares.items()}, best, outputs
