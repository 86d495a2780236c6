"""Checks that cost next to nothing and that every named set has to pass before it is an answer.

bound   no parameter of a member stands at the end of its range: the fit wanted to go on
member  a member's own sizes are surely not absent, beside all that the rig's tolerances leave open
added   nor are those that it has beyond a simpler law that it contains
sign    what must run downhill does: friction takes power from the motion, a leak flows from the
        higher pressure to the lower
size    a member does more than a right model may leave unexplained (:func:`too_small`)
curve   three laws of friction, or of a leak, make one curve that none of them is

A set that fails is no answer.  The same set without the failing member is fitted in its place,
and what the evidence then still holds for the refused set, beyond the form error of the answer's
laws, counts as unexplained.  Whether a member with a threshold is there a refit says
(:func:`finalists.not_needed`).
"""

from collections.abc import Callable, Iterator

import numpy as np

from eha_monitor.balances.least_squares import from_absent
from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.diagnosis import Gate
from eha_monitor.mismatch.likelihood.along import contributed, filtered_tracks
from eha_monitor.mismatch.likelihood.fit import Fit, Free
from eha_monitor.mismatch.likelihood.gains import smallest_unknowns
from eha_monitor.physics import signals as s
from eha_monitor.physics.effect import Parameter
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.physics.parameters import place_of
from eha_monitor.quantity import quantity, with_uncertainty
from eha_monitor.words import effect_words, listed

AT_BOUND = 1e-4  # of its prior deviation: how near to the end of its range a fit has arrived
SLOW = (0.02, 0.2)  # of the top speed: below is rest, above viscous damping is the larger part
MOST_LAWS = 2  # of one kind: with a third any smooth curve is met
KINDS = {"motion": "friction over velocity", "pressure": "leakage over pressure"}
FEWEST = 20  # samples from which a mean says something


def at_bound(f: Free, value: float) -> bool:
    """Tell whether a value stands at an end of its range, in the fitted coordinate."""
    now, reach = f.inward(value), AT_BOUND * f.spread
    return now <= f.inward(f.lower) + reach or now >= f.inward(f.upper) - reach


def allowed_end(fit: Fit, f: Free, value: float) -> bool:
    """Tell whether a parameter may stand at the end of its range.

    A shape may where it only stops to matter (a presliding of no length), and a share of two laws
    where it is all of the other one (w, h = 1).  One size of several may be absent (one chamber
    leaks, the other does not), unless a simpler effect is just that.
    """
    entry = CATALOGUE.get(f.owner)
    own = next((p for p in entry.parameters if p.name == f.symbol), None) if entry else None
    if own is None:
        return False
    if f.inward(value) >= f.inward(f.upper) - AT_BOUND * f.spread:
        return own.default is not None and not own.unit and (own.lower, own.upper) == (0.0, 1.0)
    if own.default is not None:
        return own.lower == 0.0
    others = [other for other in fit.free if other.owner == f.owner and other.name != f.name
              and other.symbol in {p.name for p in entry.sizes}]
    return own.lower == own.neutral and not entry.contains and any(
        not at_bound(other, float(fit.theta[other.place])) for other in others)


def failures(experiment: Experiment, fit: Fit) -> list[Gate]:
    """Return the gates that members of a fitted set do not pass; empty for an answer.

    ``fit`` : the set's model, fitted to the end; ``named`` its members.
    """
    return [*_bounds(fit), *_members(experiment, fit), *_within(experiment, fit), *_curves(fit),
            *_signs(experiment, fit)]


def _at_ends(fit: Fit) -> Iterator[tuple[Free, Parameter | None]]:
    """Yield what stands at an end where it may not, of members; None for a number of the rig."""
    for f in fit.free:
        if f.owner in fit.named and at_bound(f, value := float(fit.theta[f.place])) and (
                not allowed_end(fit, f, value)):
            entry = CATALOGUE.get(f.owner)
            yield f, next((p for p in entry.parameters if p.name == f.symbol), None) \
                if entry else None


def _bounds(fit: Fit) -> Iterator[Gate]:
    for f, own in _at_ends(fit):
        unit = own.unit.replace("*", "·") if own else ""
        yield Gate("bound", f.owner, f"{f.name} stands at "
                   f"{quantity(float(fit.theta[f.place]), unit, 3)}, the end of its range: the "
                   "fit is no optimum")


def _members(experiment: Experiment, fit: Fit) -> Iterator[Gate]:
    """Yield members that may as well be absent, or a simpler law, by their sizes' covariance.

    The set without such a member loses half the square of that distance, log units; if a refit
    loses more, it has stopped short.  A size that is fitted as a logarithm has no such distance.
    """
    sure = experiment.policy.sure
    for name in fit.named if len(fit.covariance) == len(fit.free) else ():
        entry = CATALOGUE.get(name)
        sizes = {p.name: p for p in entry.sizes} if entry else {}
        own = [i for i, f in enumerate(fit.free) if f.owner == name and f.symbol in sizes]
        if not own or any(fit.free[i].log or not np.isfinite(sizes[fit.free[i].symbol].neutral)
                          for i in own):
            continue
        simpler = {p.name for other in entry.contains for p in CATALOGUE[other].sizes}
        added = [i for i in own if fit.free[i].symbol not in simpler] if simpler else []
        within = listed([*map(effect_words, entry.contains)])
        for gate, which, words in (("member", own, "{} of {}"), (
                "added", added, f"what {{}} has beyond {within}, {{}},")):
            values = [float(fit.theta[fit.free[i].place]) - sizes[fit.free[i].symbol].neutral
                      for i in which]
            if not which or sure <= from_absent(
                    values, fit.covariance[np.ix_(which, which)], [True] * len(which)):
                continue
            said = listed([with_uncertainty(
                value + sizes[fit.free[i].symbol].neutral, fit.stddev(fit.free[i].name),
                sizes[fit.free[i].symbol].unit.replace("*", "·"))
                for i, value in zip(which, values, strict=True)])
            yield Gate(gate, name, f"{words.format(effect_words(name), said)} is not "
                       f"{sure:g} deviations from absent")
            break


def too_small(experiment: Experiment, fit: Fit) -> tuple[str, ...]:
    """Return members that do less than a model may leave unexplained and still be right.

    That is ``few`` of the smallest unknowns, of the force or flow that an effect adds, at its
    largest in the record.  Laws, sensors and solvers differ by as much from machine to machine: a
    long record may tell a tenth of a newton in 300 apart, and there is nothing to find.
    """
    names = [name for name in fit.named if name in CATALOGUE and CATALOGUE[name].adds]
    if not names:
        return ()
    small, few = smallest_unknowns(experiment), experiment.policy.few
    limits = {s.FORCE: small.force, s.FLOW_1: small.flow, s.FLOW_2: small.flow,
              s.SPEED: small.speed, s.MASS: small.force / experiment.ranges.acceleration}
    tracks, found = filtered_tracks(experiment, fit), []
    for name in names:
        most = np.abs(np.concatenate([
            contributed(experiment, fit.theta, track, (name,)) for track in tracks])).max(axis=0)
        acts = np.flatnonzero(most)
        if len(acts) and all(most[place] < few * limits.get(place, 0.0) for place in acts):
            found.append(name)
    return tuple(found)


def shaped(fit: Fit, name: str) -> bool:
    """Tell whether an effect has a free number beside its sizes: a threshold, an exponent."""
    entry = CATALOGUE.get(name)
    return entry is not None and any(f.owner == name and f.symbol not in {
        p.name for p in entry.sizes} for f in fit.free)


def _within(experiment: Experiment, fit: Fit) -> Iterator[Gate]:
    for name in fit.named:
        for size, other in CATALOGUE[name].within if name in CATALOGUE else ():
            one, two = (float(fit.theta[place_of(f"{name}.{p}")]) for p in (size, other))
            sure = experiment.policy.sure * np.hypot(
                fit.stddev(f"{name}.{size}"), fit.stddev(f"{name}.{other}"))
            if abs(one) > abs(two) + sure:
                yield Gate("sign", name, f"{effect_words(name)}: {size} of {abs(one):.3g} exceeds "
                           f"{other} of {abs(two):.3g}; friction takes power in both directions")


def _curves(fit: Fit) -> Iterator[Gate]:
    for kind, words in KINDS.items():
        laws = [effect_words(name) for name in fit.named
                if name in CATALOGUE and CATALOGUE[name].passive == kind]
        if len(laws) > MOST_LAWS:
            yield Gate("curve", words, f"{listed(laws)} together make one curve of {words} that "
                       "none of them is")


def shapes_at_bound(fit: Fit) -> list[tuple[Free, float]]:
    """Return the shapes of members that stand at an end of their range, with their defaults."""
    return [(f, own.default) for f, own in _at_ends(fit) if own and own.default is not None]


def ends_of_tolerance(fit: Fit) -> list[Free]:
    """Return the numbers of the rig that a fit has moved to the end of what their tolerance is."""
    return [f for f in fit.free if f.of_rig and f.name not in fit.named
            and at_bound(f, float(fit.theta[f.place]))]


def _signs(experiment: Experiment, fit: Fit) -> Iterator[Gate]:
    """Check that friction and leaks take power, by what they do along the recording itself."""
    laws = {kind: tuple(name for name in fit.named
                        if name in CATALOGUE and CATALOGUE[name].passive == kind)
            for kind in ("motion", "pressure")}
    if not any(laws.values()):
        return
    tracks = filtered_tracks(experiment, fit)
    whole = np.concatenate(tracks)
    fastest = np.abs(whole[:, s.V]).max()
    for name in laws["motion"]:
        for words, way in (("positive", 1.0), ("negative", -1.0)):
            slow = [(way * track[:, s.V] > SLOW[0] * fastest)
                    & (way * track[:, s.V] < SLOW[1] * fastest) for track in tracks]

            def friction(theta, slow=slow, name=name, way=way):
                return way * np.concatenate([
                    contributed(experiment, theta, track, (name,))[here, s.FORCE]
                    for track, here in zip(tracks, slow, strict=True)])

            least = _surely_negative(fit, friction, (name,), experiment.policy.sure)
            if least is not None:
                yield Gate("sign", name, f"{effect_words(name)} would drive the piston in {words} "
                           f"motion with {quantity(abs(least), 'N', 2)}: friction takes power")
                break
    if laws["pressure"]:
        def leak(theta):
            found = []
            for track in tracks:
                dp = track[:, s.P1] - track[:, s.P2]
                c = contributed(experiment, theta, track, laws["pressure"])
                flow = 0.5 * (c[:, s.FLOW_2] - c[:, s.FLOW_1]
                              + (theta[s.C_T] - theta[s.G_MAKEUP]) * dp)
                found.append((flow * np.sign(dp))[np.abs(dp) > np.median(np.abs(dp))])
            return np.concatenate(found)

        if _surely_negative(fit, leak, laws["pressure"], experiment.policy.sure) is not None:
            yield Gate("sign", laws["pressure"][-1], "the leak across the piston would flow from "
                       "the lower pressure to the higher")


def _surely_negative(fit: Fit, rows: Callable[[np.ndarray], np.ndarray],
                     names: tuple[str, ...], sure: float) -> float | None:
    """Return the mean of what theta makes if it is negative beyond its own uncertainty.

    Parameters
    ----------
    rows : theta -> (n,) what must not be negative in the mean.
    names : effects whose sizes make it.
    sure : deviations.
    """
    sizes = {f"{name}.{p.name}" for name in names for p in CATALOGUE[name].sizes}
    own = [i for i, f in enumerate(fit.free) if f.name in sizes or f.name == "rig.leakage"]
    here = rows(fit.theta)
    if len(here) < FEWEST or not here.mean() < 0.0:
        return None
    slopes = []
    for i in own:
        f, theta = fit.free[i], fit.theta.copy()
        step = np.sqrt(max(fit.covariance[i, i], 0.0)) or AT_BOUND * f.spread
        theta[f.place] = f.outward(f.inward(theta[f.place]) + step)
        slopes.append((rows(theta).mean() - here.mean()) / step)
    variance = float(np.array(slopes) @ fit.covariance[np.ix_(own, own)] @ np.array(slopes))
    return float(here.mean()) if here.mean() < -sure * np.sqrt(max(variance, 0.0)) else None
