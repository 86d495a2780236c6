"""What every model fits and within which limits; where effects enter it, and are taken out."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.data.inputs import CLOSED, FORCED
from eha_monitor.mismatch.likelihood.fit import Fit, Free
from eha_monitor.mismatch.likelihood.gains import Unknowns, smallest_unknowns
from eha_monitor.mismatch.policy import POLICY, SearchPolicy
from eha_monitor.physics import signals as s
from eha_monitor.physics.effect import Parameter
from eha_monitor.physics.effects import CATALOGUE, NAMES
from eha_monitor.physics.parameters import place_of

LEAST_SHARE, LEAST_OF_MANY = 0.05, 0.3  # of its start: where a size enters at least
LEAST_B = 1e-3  # of its prior: below, there is no viscous damping
LARGEST = 3e4  # times the smallest unknowns; 1e4 times is what the record covers


@dataclass(frozen=True)
class Start:
    """One way in which an effect might enter a model."""

    effect: str
    # All parameters of the effect, a small but visible instance
    values: tuple[tuple[str, float], ...]
    replaces: str = ""  # named effect that it contains and takes the place of, or ""
    among: int = 1  # how many starts the effect has
    policy: SearchPolicy = POLICY  # how wide its numbers' priors are
    step: float = 0.0  # of the integration, s: what lasts less is not resolved


def base_free(experiment: Experiment) -> tuple[Free, ...]:
    """Return the base parameters that this experiment's input mode can tell."""
    one, two = experiment.settings.stage_one, experiment.settings.stage_two
    rig = experiment.settings.rig
    scale = max(one.prior_stddev, one.prior, rig.viscous_damping)
    # A damping is positive.  Beside dry and quadratic friction nothing else keeps it so.
    lowest = LEAST_B * one.prior
    found = [Free("B", s.B, lowest, 1e5 * scale, one.prior, 10.0 * scale)]
    if experiment.mode != FORCED:
        found.append(Free("beta_e", s.BETA_E, 1e5, 1e12, float(np.log(two.prior)), 3.0, True))
    return tuple(found)


def timing_free(experiment: Experiment) -> tuple[Free, ...]:
    """Return the small timing errors that every record has, each at most ``timing`` samples.

    Sensors lag by some microseconds and stamps jitter; with 24 000 samples a delay of 2 % of a
    sample is beyond doubt, and is nobody's fault.  What is larger must be named.
    """
    limit = experiment.policy.timing * experiment.dt
    found, names = [], ("command_delay", "position_delay", "pressure_delay")
    if experiment.mode == FORCED:  # only the difference of the two shows
        named = experiment.active[NAMES.index("pressure_delay")]
        names = () if named else ("position_delay",)
    for name in names:
        if possible(name, experiment) and not experiment.active[NAMES.index(name)]:
            # A pump speed that is read late looks like a late command and an early position.
            lower = -limit if name == "position_delay" else 0.0
            found.append(Free(f"{name}.T", place_of(f"{name}.T"), lower, limit, 0.0, limit))
    return tuple(found)


def config_free(experiment: Experiment, named: Sequence[str] = ()) -> tuple[Free, ...]:
    """Return the sizes of the config's effects, each free within its tolerance.

    What a data sheet or an earlier diagnosis says of a friction or a lag is a little wrong, as
    each number of the rig is, and with thousands of samples a lag that is 4 % off is an encoder
    that is late beyond doubt.  What is further off must be named.

    Parameters
    ----------
    named : effects of a model; of what is one of them, or in one, there are no other numbers.
    """
    taken = {inner for name in named if name in CATALOGUE
             for inner in (name, *CATALOGUE[name].contains)}
    found, width = [], experiment.settings.rig.tolerance.effects
    for name, on in zip(NAMES, experiment.active, strict=False):
        if not on or name in taken or not possible(name, experiment):
            continue
        for p in CATALOGUE[name].sizes:
            place = place_of(f"{name}.{p.name}")
            value = float(experiment.theta[place])
            if value == p.neutral or not np.isfinite(value):
                continue
            log, reach = value > 0.0, experiment.policy.sure * width
            ends = sorted(value * np.exp((-reach, reach)) if log else
                          value * (1.0 + np.array((-reach, reach))))
            found.append(Free(f"{name}.{p.name}", place, max(ends[0], p.lower),
                              min(ends[1], p.upper), float(np.log(value)) if log else value,
                              width if log else width * abs(value), log))
    return tuple(found)


def always_free(experiment: Experiment, named: Sequence[str] = ()) -> tuple[Free, ...]:
    """Return what may err a little in every model with these names, and has none itself."""
    return (*(f for f in timing_free(experiment) if f.owner not in named),
            *config_free(experiment, named))


def stand_again(experiment: Experiment, theta: np.ndarray, active: np.ndarray, free: list[Free],
                named: Sequence[str]) -> None:
    """Let what is no name any more stand as the config has it, and err a little, in place."""
    known = {f.name for f in free}
    back = [f for f in always_free(experiment, named) if f.name not in known]
    for f in back:
        active[NAMES.index(f.owner)] = True
        for p in CATALOGUE[f.owner].parameters:
            place = place_of(f"{f.owner}.{p.name}")
            theta[place] = experiment.theta[place]
    for f in back:
        theta[f.place] = f.outward(f.prior)
    free += back


def limits_of(experiment: Experiment) -> tuple[Unknowns, Unknowns]:
    """Return the smallest and the largest unknowns that are tried."""
    small = smallest_unknowns(experiment).as_array()
    large = LARGEST * small
    if experiment.mode == FORCED:
        large[1:] = small[1:]
    elif experiment.mode != CLOSED or not experiment.used[4]:
        large[2] = small[2]  # without a measured speed it is the same as an unknown flow
    return Unknowns(*small), Unknowns(*large)


def needs(experiment: Experiment, fit: Fit, times: float) -> bool:
    """Tell whether a fit needs an unknown of more than so many times the smallest."""
    small = limits_of(experiment)[0].as_array()
    return bool((fit.unknowns.as_array() > times * small).any())


def with_effect(fit: Fit, start: Start, amplitudes: tuple[float, ...]) -> Fit:
    """Return a fit with an effect entered at a multiple of its start, not yet refitted."""
    values = dict(start.values)
    # Of several starts each stands for its surroundings; the linear guess leads out of them.
    least = LEAST_OF_MANY if start.among > 1 else LEAST_SHARE
    for p, a in zip(own_sizes(start), amplitudes, strict=False):
        if np.isfinite(p.neutral):
            value = a * values[p.name]
            if p.lower >= 0:
                value = max(value, least * values[p.name])
            if start.among > 1 and p.unit in ("s", "m"):  # a shift is linear near itself only
                value = min(value, values[p.name] / LEAST_OF_MANY)
            values[p.name] = min(max(value, p.lower), p.upper)
    placed = replace(start, values=tuple(values.items()))
    theta, active = entered(fit.theta, fit.active, placed)
    gone = {start.effect, start.replaces} - {""}
    free = tuple(f for f in fit.free if f.owner not in gone)
    return replace(fit, theta=theta, active=active, free=free + free_of(start),
                   named=(*fit.named, start.effect))


def without_effect(experiment: Experiment, fit: Fit, name: str) -> Fit:
    """Return a fit with an effect taken out, not yet refitted."""
    active, theta = fit.active.copy(), fit.theta.copy()
    active[NAMES.index(name)] = False
    for p in CATALOGUE[name].parameters:
        theta[place_of(f"{name}.{p.name}")] = 0.0
    free = [f for f in fit.free if f.owner != name]
    named = tuple(other for other in fit.named if other != name)
    stand_again(experiment, theta, active, free, named)
    return replace(fit, theta=theta, active=active, free=tuple(free), named=named)


def expected_likelihood(experiment: Experiment, fit: Fit) -> float:
    """Return the likelihood of a right model, whose innovations are the sensors' noise."""
    return float(-np.sum(np.log(experiment.noise[experiment.columns])
                         * np.isfinite(fit.e).sum(axis=0)))


LOOP_ONLY = ("feedback_delay",)  # shows only where the position loop is part of the model


def possible(name: str, experiment: Experiment) -> bool:
    """Tell whether an effect can show in these channels at all."""
    effect = CATALOGUE[name]
    if name in experiment.without:
        return False
    if name == "pressure_friction" and not any(
            np.ptp(stretch.p1) + np.ptp(stretch.p2) > 0.0 for stretch in experiment.stretches) \
            and experiment.mode == FORCED:
        return False  # at a pressure that nobody knows it is Coulomb friction
    if effect.balance == "force":
        # Where a drive tells the force, its encoder is on its own shaft.
        return name != "backlash" or experiment.mode != FORCED or experiment.by_pressures
    if experiment.mode == FORCED:
        # Of two sensors one may be late.  A force that a drive tells is its own law's: on EMPS a
        # position 0.87 ms late took 17 % of the dry friction and 12 % of B with it.
        return experiment.by_pressures and name in ("position_delay", "pressure_delay")
    if experiment.wanted_speed and name in LOOP_ONLY:
        return False
    pressures = experiment.used[2] or experiment.used[3]
    if effect.balance == "drive":
        return experiment.mode == CLOSED
    if name.startswith("pressure_"):
        return bool(pressures)
    return True


def starts_of(name: str, experiment: Experiment) -> list[Start]:
    """Return where a fit of an effect begins, within its bounds."""
    effect = CATALOGUE[name]
    found, places = [], effect.starts(experiment.ranges)
    if experiment.mode != CLOSED:  # no loop: what the drive reads cannot show
        places = [one for one in places if not one.get("in_loop")] or places
    for given in places:
        values = []
        for p in effect.parameters:
            value = given.get(p.name, p.default if p.default is not None else p.neutral)
            if np.isfinite(value):  # a limit that is not there stays at infinity
                value = min(max(value, p.lower), p.upper)
            values.append((p.name, float(value)))
        found.append(Start(name, tuple(values), "", len(places), experiment.policy,
                           experiment.dt / experiment.steps))
    return found


def entered(theta: np.ndarray, active: np.ndarray, start: Start) -> tuple[np.ndarray, np.ndarray]:
    """Return theta and active with an effect at its start."""
    theta, active = theta.copy(), active.copy()
    if start.replaces:
        active[NAMES.index(start.replaces)] = False
    active[NAMES.index(start.effect)] = True
    for name, value in start.values:
        theta[place_of(f"{start.effect}.{name}")] = value
    return theta, active


def free_parameter(start: Start, p: Parameter) -> Free:
    """Return how a parameter is fitted that enters with a start."""
    name, value = f"{start.effect}.{p.name}", dict(start.values)[p.name]
    place, spread = place_of(name), start.policy.spread
    if p.log:
        return Free(name, place, max(p.lower, p.resolved * start.step, value / spread), p.upper,
                    float(np.log(value)), float(np.log(spread)), True)
    if p.unit == "1" and p.default is None:  # a share is no larger because more was recorded
        return Free(name, place, p.lower, p.upper, p.neutral, p.scale)
    if p.default is None and np.isfinite(p.neutral):
        return Free(name, place, p.lower, p.upper, p.neutral,
                    max(spread * abs(value), 1e-3 * p.scale))
    if p.lower > 0:
        return Free(name, place, p.lower, p.upper, float(np.log(value)), start.policy.shape, True)
    return Free(name, place, p.lower, p.upper, value, max(2.0 * p.scale, abs(value)))


def free_of(start: Start) -> tuple[Free, ...]:
    """Return the fitted parameters of an effect at its start."""
    effect, values = CATALOGUE[start.effect], dict(start.values)
    return tuple(free_parameter(start, p) for p in effect.parameters
                 if p.fitted and np.isfinite(values[p.name]))


def sharing(start: Start, shared: dict[str, float]) -> Start:
    """Return a start with the numbers that another effect has in common, within its own bounds."""
    bounds = {p.name: p for p in CATALOGUE[start.effect].parameters}
    return replace(start, values=tuple(
        (key, min(max(shared[key], bounds[key].lower), bounds[key].upper) if key in shared
         else value) for key, value in start.values))


def continuing(start: Start, held: Mapping[str, float]) -> Start:
    """Return a start with another effect's numbers where it has them and they are in bounds."""
    bounds = {p.name: p for p in CATALOGUE[start.effect].parameters}
    return replace(start, values=tuple(
        (key, held[key] if key in held and bounds[key].lower <= held[key] <= bounds[key].upper
         else value) for key, value in start.values))


def own_sizes(start: Start) -> list[Parameter]:
    """Return the sizes that a start brings in: those of the effect that it replaces are there.

    Empty where it brings in another shape only.
    """
    values = dict(start.values)
    shared = {p.name for p in CATALOGUE[start.replaces].sizes} if start.replaces else set()
    return [p for p in CATALOGUE[start.effect].sizes
            if values[p.name] != p.neutral and p.name not in shared]


def directions_of(fit: Fit, start: Start, share: float = 1.0
                  ) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return (theta, active) with one size of the start at a time, or with all of its shape.

    ``share`` : of the start's sizes.
    """
    sizes = own_sizes(start)
    if not sizes:
        return [entered(fit.theta, fit.active, start)]
    values, found = dict(start.values), []
    for size in sizes:
        theta, active = entered(fit.theta, fit.active, start)
        for other in sizes:
            theta[place_of(f"{start.effect}.{other.name}")] = other.neutral
        value = values[size.name]
        if share != 1.0:
            value = size.neutral + share * (value - size.neutral)
        theta[place_of(f"{start.effect}.{size.name}")] = value
        found.append((theta, active))
    return found
