"""Where model and recording disagree: balance, regime, intervals, and the missing term's shape.

Latent causes (an unknown force, flow, speed, or a sensor's error) compete on the likelihood of all
channels.  Each is tried in a linear filter over the innovations of the nominal one, which costs a
fraction of a run of the plant.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from eha_monitor import ties
from eha_monitor.balances import places
from eha_monitor.balances.candidates import SIDES
from eha_monitor.compiled import njit
from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.data.inputs import FORCED
from eha_monitor.mismatch.diagnosis import INTERMITTENT, Curve, Location
from eha_monitor.mismatch.likelihood.fit import (
    Fit,
    covariance_of,
    filtered,
    log_likelihood_of,
    spread,
    step_of,
    whitener,
    with_unknowns,
)
from eha_monitor.mismatch.likelihood.gains import Linear, linear_of
from eha_monitor.mismatch.likelihood.innovations import N_FILTERED, riccati
from eha_monitor.mismatch.locate.terms import (
    BALANCES,
    Missing,
    missing_terms,
    needed,
    sensor_errors,
)
from eha_monitor.mismatch.name.candidates import candidate
from eha_monitor.mismatch.name.starts import limits_of
from eha_monitor.physics import signals as s
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.physics.plant import Y_FLOW, Y_FORCE, Y_P1, Y_P2, Y_SPEED

STANDING = 400  # samples after which a rival's gains are taken to stand
SIZES = tuple(10.0**k for k in range(5))  # times the smallest deviation
LASTING = (0.3, 0.02, 20.0)  # s
HOPEFUL = 0.3  # of the best gain at the first try: the others are not pursued
FAR = 1.25  # from its prior: B by that many times, beta_e by that factor
REFITS = 3  # Gauss-Newton steps of B and beta_e, the weights renewed at each
CLOSE = 0.03  # of the best gain: rivals nearer than that share the blame


@dataclass(frozen=True)
class Rival:
    """Something latent that may be behind the innovations: an unknown or a sensor's error."""

    name: str  # what it is, e.g. ``force`` or ``sensor_p1``
    balance: str  # whose share it counts to
    smallest: float  # deviation at which it does not show, in its unit
    state: int = -1  # place among the filter's states; -1: none of them
    # (sensor, weight): what it adds to the measured outputs
    outputs: tuple[tuple[int, float], ...] = ()
    # (state, weight): what it adds to a state in a sample
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


def larger_model(m: Linear, used: np.ndarray, dt: float, rival: Rival, deviation: float,
                 lasting: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return A, H and gains of the null model with a rival in it that lasts for so many s."""
    i = rival.state if rival.state >= 0 else N_FILTERED
    n = max(N_FILTERED, i + 1)
    a, h = np.zeros((n, n)), np.zeros((len(m.r), n))
    q, start = np.zeros(n), np.zeros(n)
    a[:N_FILTERED, :N_FILTERED], h[:, :N_FILTERED] = m.a, m.h
    q[:N_FILTERED], start[:N_FILTERED] = m.q, m.start
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


@dataclass(frozen=True)
class Base:
    """A nominal model without unknowns, from which the rivals are judged."""

    linear: Linear  # its linearised plant
    drive: np.ndarray  # (m, N_FILTERED, N_OUTPUTS) A K of its filter
    e: list[np.ndarray]  # for each stretch (n, N_OUTPUTS) its innovations
    # For each base parameter, what a step of it adds to ``e``, and the step's prior
    # deviation in steps
    slopes: list[tuple[list[np.ndarray], float]]


def base_of(experiment: Experiment, fit: Fit) -> Base:
    """Return the base that has the parameters of ``fit``."""
    null = with_unknowns(experiment, fit, limits_of(experiment)[0])

    def run(theta: np.ndarray) -> list[np.ndarray]:
        return [filtered(experiment, stretch, theta, null.active, null.gains)[0]
                for stretch in experiment.stretches]

    free = [f for f in null.free if f.name in ("B", "beta_e")]
    moved = [step_of(f, null.theta, experiment.log_step) for f in free]
    e, *others = spread(run, [null.theta, *(theta for theta, _ in moved)])
    slopes = [([other - one for other, one in zip(parts, e, strict=True)], f.spread / abs(step))
              for parts, f, (_, step) in zip(others, free, moved, strict=True)]
    m = linear_of(experiment, null.theta, null.active, null.unknowns)
    return Base(m, m.a @ null.gains, e, slopes)


def likelihood(experiment: Experiment, base: Base, rival: Rival, size: float, lasting: float,
               refit: bool = False) -> float:
    """Return the log likelihood with a rival of ``size`` times its smallest in the model.

    refit : B and beta_e take one Gauss-Newton step to where the rival wants them: the filter is
        linear in the innovations, and in what a change of a parameter adds to them.
    """
    a, h, gains = larger_model(base.linear, experiment.used, experiment.dt, rival,
                               size * rival.smallest, lasting)
    columns = experiment.columns

    def passed(parts: list[np.ndarray]) -> np.ndarray:
        kept = [np.full_like(e, np.nan) for e in parts]
        for e, out in zip(parts, kept, strict=True):
            rival_innovations(e, columns, base.drive, a, h, gains, out)
        return experiment.counted(kept)[:, columns]

    e = passed(base.e)
    reached = log_likelihood_of(e)
    if not refit or not base.slopes or not np.isfinite(reached):
        return reached
    slopes = [passed(parts) for parts, _ in base.slopes]
    moved = e
    for _ in range(REFITS):
        try:
            w = whitener(covariance_of(moved))
        except np.linalg.LinAlgError:  # the innovations have become one curve in two channels
            return reached
        d = np.stack([(np.nan_to_num(slope) @ w.T).ravel() for slope in slopes], axis=1)
        prior = np.diag([1.0 / deviation for _, deviation in base.slopes])
        right = np.concatenate([-(np.nan_to_num(e) @ w.T).ravel(), np.zeros(len(slopes))])
        steps = np.linalg.lstsq(np.vstack([d, prior]), right, rcond=None)[0]
        moved = e + sum(step * slope for step, slope in zip(steps, slopes, strict=True))
        if not np.isfinite(moved[np.isfinite(e)]).all():
            return reached
        reached = max(reached, log_likelihood_of(moved))
    return reached


def latent_gains(experiment: Experiment, fit: Fit) -> dict[str, tuple[Rival, float]]:
    """Return each rival by name, and what it gains, log units, at its best.

    A wrong model carries B and beta_e off, and with them wrong another cause looks better; so
    where they lie far from their priors the rivals are judged from there too, and refit them.
    """
    fits = [fit]
    theta = fit.theta.copy()
    for f in fit.free:
        if f.name in ("B", "beta_e"):
            theta[f.place] = f.outward(f.prior)
            far = abs(f.inward(fit.theta[f.place]) - f.prior) > (
                np.log(FAR) if f.log else FAR * abs(f.prior))
            if far and len(fits) == 1:
                fits.append(replace(fit, theta=theta))
    bases = [base_of(experiment, one) for one in fits]
    nothing = log_likelihood_of(experiment.counted(bases[0].e)[:, experiment.columns])
    gains: dict[str, tuple[Rival, float]] = {}
    for base in bases:
        for rival, value in gains_from(experiment, base):
            if rival.name not in gains or value - nothing > gains[rival.name][1]:
                gains[rival.name] = (rival, value - nothing)
    return gains


def gains_from(experiment: Experiment, base: Base) -> list[tuple[Rival, float]]:
    """Return the rivals with the best likelihood that each reaches from one base."""
    def first(rival: Rival) -> tuple[float, float]:
        return max((likelihood(experiment, base, rival, size, LASTING[0]), size) for size in SIZES)

    def further(task: tuple[Rival, float, float]) -> float:
        rival, reached, start = task
        best = (reached, start, LASTING[0])
        for lasting in LASTING[1:]:
            size = start
            value = likelihood(experiment, base, rival, size, lasting)
            for factor in (10.0, 0.1):
                while SIZES[0] <= size * factor <= SIZES[-1]:
                    other = likelihood(experiment, base, rival, size * factor, lasting)
                    if other <= value:
                        break
                    size, value = size * factor, other
            best = max(best, (value, size, lasting))
        return likelihood(experiment, base, rival, best[1], best[2], refit=True)

    rivals = rivals_of(experiment, base.linear)
    found = spread(first, rivals)
    values = [value for value, _ in found]
    worthy = min(values) + HOPEFUL * (max(values) - min(values))
    tasks = [(rival, *one) for rival, one in zip(rivals, found, strict=True)]
    hopeful = [task for task in tasks if task[1] >= worthy]
    best = {rival.name: value for rival, value, _ in tasks}
    best.update((task[0].name, value)
                for task, value in zip(hopeful, spread(further, hopeful), strict=True))
    return [(rival, best[rival.name]) for rival in rivals]


def shares_of(gains: dict[str, tuple[Rival, float]]) -> tuple[dict[str, float], float, list[int]]:
    """Return shares of force, flow, drive and sensor, the best gain, and the sensors suspected."""
    shares = dict.fromkeys(BALANCES, 0.0)
    gains = {name: gain for name, gain in gains.items() if np.isfinite(gain[1])}
    best = max((value for _, value in gains.values()), default=0.0)
    if best <= 0.0:
        return shares, 0.0, []
    for rival, value in gains.values():
        weight = float(np.exp((value - best) / (CLOSE * best + 3.0)))
        shares[rival.balance] = max(shares[rival.balance], weight)
    total = sum(shares.values())
    sensors = [(value, rival) for rival, value in gains.values() if rival.outputs]
    outputs = [output for output, _ in ties.best(
        sensors, lambda row: row[0], within=ties.GUESS)[1].outputs] if sensors else []
    return {balance: value / total for balance, value in shares.items()}, best, outputs


LEFT = 30.0  # times the smallest unknowns: the named effects leave something behind
LEARNED = "learned."  # before the balance of a term that was learned


def latent_curves(experiment: Experiment, terms: Sequence[Missing]) -> tuple[Curve, ...]:
    """Return missing terms against time, velocity, position, pressure difference and speed."""
    return tuple(curve for term in terms for curve in places.curves_of(
        term.balance, term.unit, parts_of(experiment, term)))


def parts_of(experiment: Experiment, term: Missing) -> list[places.Part]:
    """Return a missing term as parts of recordings."""
    driven = experiment.mode != FORCED
    pressures = driven or any(np.ptp(one.p1 - one.p2) > 0 for one in experiment.stretches)
    modelled = [None] * len(term.tracks) if term.modelled is None else term.modelled
    return [places.Part(
        stretch.start, experiment.dt, track[:, s.X], track[:, s.V],
        track[:, s.P1] - track[:, s.P2] if pressures else None,
        track[:, s.OMEGA] if driven else None, stretch.counted | stretch.held_out, what, model)
        for stretch, track, what, model in zip(
            experiment.stretches, term.tracks, term.measured, modelled, strict=True)]


def location_of(experiment: Experiment, before: Fit, after: Fit,
                named: Mapping[str, float], terms: Sequence[Missing] | None = None) -> Location:
    """Say where model and recording disagree.

    ``named`` : effect, ``rig.<key>`` or ``learned.<balance>`` -> log evidence; empty where nothing
        explains the mismatch.  What the named effects leave behind counts beside them.
    ``terms`` : :func:`missing_terms` of the named effects, where they are at hand.
    """
    weights = dict.fromkeys(BALANCES, 0.0)
    for name, gain in named.items():
        weights[balance_of(name)] += max(float(gain), 0.0)
    known, outputs = sum(weights.values()), []
    small = limits_of(experiment)[0].as_array()
    if not known or (after.unknowns.as_array() > LEFT * small).any():
        shares, best, outputs = shares_of(latent_gains(experiment, after))
        if not known or best > 0.1 * known:
            for balance, share in shares.items():
                weights[balance] += share * best
    total = sum(weights.values())
    if total <= 0.0:
        return Location(weights, "", ())
    shares = {balance: weight / total for balance, weight in weights.items()}
    balance = ties.best(shares, shares.get)
    mine = [term for term in terms or [] if term.balance == balance]
    if not mine and any(balance_of(name) == balance for name in named if name in CATALOGUE):
        mine = [term for term in missing_terms(experiment, before, after)
                if term.balance == balance]
    if not mine and balance in SIDES:
        mine = [needed(experiment, after, balance)]
    elif not mine:
        mine = sensor_errors(experiment, after, balance, outputs)
    regime = "always"
    if mine:
        parts = parts_of(experiment, mine[-1])
        regime, weight = places.regime_of(balance, parts)
    return Location(shares, regime, places.worst_intervals(parts, weight) if regime != "always"
                    else whole_of(experiment))


def balance_of(name: str) -> str:
    """Return the balance of an effect, a number of the rig (``rig.<key>``), a learned term."""
    if name.startswith(LEARNED):
        return name.removeprefix(LEARNED)
    return "force" if name == INTERMITTENT else candidate(name).balance


def whole_of(experiment: Experiment) -> tuple[tuple[float, float], ...]:
    """Return the stretches themselves, s of the recording."""
    return tuple((round(float(stretch.start), 4),
                  round(float(stretch.start + len(stretch) * experiment.dt), 4))
                 for stretch in experiment.stretches[:places.MOST_INTERVALS])
