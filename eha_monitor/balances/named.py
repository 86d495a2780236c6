"""The named terms of a balance as effects of the catalogue, and as wrong numbers of the config."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from eha_monitor import ties
from eha_monitor.balances.candidates import DRY, LINEAR, SIDES
from eha_monitor.balances.learned_curve import NAME as LEARNED
from eha_monitor.balances.least_squares import rms
from eha_monitor.balances.machine import OTHER
from eha_monitor.balances.model import Model, Term
from eha_monitor.balances.policy import Policy
from eha_monitor.mismatch.diagnosis import (
    NamedEffect,
    RigFinding,
    Value,
    beside_config,
    within_words,
)
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.quantity import quantity, share, side_by_side, to_digits, with_uncertainty
from eha_monitor.settings.monitor import Settings
from eha_monitor.settings.rig import Rig
from eha_monitor.words import effect_words, listed

TWINS = {"mass": ("pressure_delay",), "pump_displacement": ("pump_flow_gain",),
         "position_gain": ("drive_gain", "command_delay", "position_delay")}
DRY_SYMBOLS = {"F_c", "F_d"}
LARGEST = 0.998  # quantile of a term that is its size
TOLD = 0.01  # a spread between recordings that is a smaller share is none to speak of
TWICE = 0.5  # of a tolerance: a recording then knows a number twice as well
APART = 2.0  # standard deviations by which it then differs

Effects = Mapping[str, Mapping[str, float]]


def effects_of(model: Model, rig: Rig, policy: Policy, held: Effects) -> list[NamedEffect]:
    """Return the named terms of a balance as effects; one that contains another holds both.

    A name has a number that is surely not nil; dry friction is named as a family, of which one
    shape may stand for another.

    Parameters
    ----------
    held : effects of the config, which the terms add to.
    """
    named = [t for t in model.terms if (t.named or _leaks_more(t, policy))
             and t.candidate.name not in (*LINEAR, LEARNED)
             and not within_tolerance(t, rig, policy)
             and not (t.candidate.name == "dM" and t.value < 0.0)  # less is a wrong number
             and (t.candidate.family == DRY or policy.sure(*t.presence))]
    groups: dict[str, list[Term]] = {}
    for term in named:
        groups.setdefault(term.candidate.effect, []).append(term)
    for effect in list(groups):
        for simpler in CATALOGUE[effect].contains if effect in CATALOGUE else ():
            groups[effect] += groups.pop(simpler, [])
    return [_effect(name, terms, model, rig, held)
            for name, terms in _surest(_dry_as_one(groups, policy), policy).items()]


def _surest(groups: dict[str, list[Term]], policy: Policy) -> dict[str, list[Term]]:
    """Return the effects without those that only share what their family surely is.

    Friction that grows with pressure and friction that does not are named together; which of them
    it is, each says for itself.
    """
    def sure(name: str) -> float:
        return max(abs(value) / stddev if stddev else np.inf
                   for value, stddev in (t.presence for t in groups[name]))

    best: dict[str, float] = {}
    for name, terms in groups.items():
        kind = terms[0].candidate.kind
        best[kind] = max(best.get(kind, 0.0), sure(name))
    return {name: terms for name, terms in groups.items() if sure(name) >= min(
        best[terms[0].candidate.kind], policy.varied)}


def _dry_as_one(groups: dict[str, list[Term]], policy: Policy) -> dict[str, list[Term]]:
    """Return the terms of effects, dry friction of several shapes as the one force that it is.

    It is called by its fall with speed where that is sure of itself, else by its largest shape.
    """
    dry = {effect: terms for effect, terms in groups.items() if terms[0].candidate.family == "dry"
           and DRY_SYMBOLS.issuperset(term.candidate.symbol for term in terms)}
    terms = [term for one in dry.values() for term in one]
    falls = [t for t in terms if t.candidate.symbol == "F_d"]
    stays = [t for t in terms if t.candidate.symbol == "F_c"]
    if not stays:
        return groups
    sure = [t for t in falls if policy.sure(*t.presence)]
    name = (sure or [ties.best(stays, lambda t: abs(t.value))])[0].candidate.effect
    return {name: stays + sure, **{effect: terms for effect, terms in groups.items()
                                   if effect not in dry}}


def _effect(name: str, terms: Sequence[Term], model: Model, rig: Rig, config: Effects
            ) -> NamedEffect:
    entry, first, held = CATALOGUE.get(name), terms[0], config.get(name, {})
    values: dict[str, Value] = {}
    for term in terms:
        symbol, value = shown_as(term, model, rig)
        if symbol in values:  # dry friction of two shapes is one force
            whole, stddev = term.quantity
            value = Value(whole, float(np.hypot(
                stddev, error_of_area(rig, model.balance) * whole)), value.unit)
        values[symbol] = value
    had = [symbol for symbol in values if symbol in held]
    configured = [quantity(held[one], values[one].unit, 4) for one in had]
    if len(had) > 1:
        configured = [f"{one} = {text}" for one, text in zip(had, configured, strict=True)]
    values |= {one: replace(values[one], value=values[one].value + held[one]) for one in had}
    numbers = numbers_of(name, terms, values)
    whole = entry is not None and not any(term.each for term in terms) and all(
        p.name in values for p in entry.sizes if np.isfinite(p.neutral))
    sure = {symbol: to_digits(value.value, value.stddev)
            for symbol, value in values.items() if 0.0 < value.stddev < np.inf}
    grid = {key for term in terms if term.candidate.exclusive for key, _ in term.candidate.shape}
    said = entry.said(numbers | sure, grid - values.keys()) if whole else ""
    if not said:
        said = "; ".join(_said(term, held) for term in terms)
    beside = [effect_words(other) for other in config if other != name and entry and entry.family
              and other in CATALOGUE and CATALOGUE[other].family == entry.family]
    if beside:
        said += f", beside the config's {listed(beside)}"
    spread = [f"{symbol} ± {share(apart, 2)} from recording to recording"
              for symbol, apart in _between(terms, values).items() if apart > TOLD]
    rivals = tuple(dict.fromkeys(r for term in terms for r in (
        *term.rivals, *term.candidate.twins)))
    return NamedEffect(
        name, model.balance, "; ".join([
            said, *([f"the config has {listed(configured)}"] if had else []), *spread]), values,
        max(sum(term.gained for term in terms), 0.0), rivals,
        entry.equation if entry else "", entry.rig_check if entry else "",
        size_of(terms, model), probability=max(
            (t.probability for t in terms if np.isfinite(t.probability)), default=np.nan),
        effective_samples=model.effective, stability=max(first.stability, 0.0))


def _between(terms: Sequence[Term], values: Mapping[str, Value]) -> dict[str, float]:
    """Return the share by which each parameter differs from recording to recording."""
    found: dict[str, float] = {}
    for term in terms:
        symbol = term.candidate.symbol or term.candidate.name
        if symbol in values and values[symbol].value:
            found[symbol] = float(np.hypot(found.get(symbol, 0.0),
                                           term.between / values[symbol].value))
    return found


def error_of_area(rig: Rig, balance: str = "force") -> float:
    """Return the share by which every number of a balance may be wrong that an area makes.

    The force is the area's times the pressures, the flow the area's times the speed.
    """
    return rig.tolerance.log_spread("area_1") if rig.area_1 and balance != "drive" else 0.0


def shown_as(term: Term, model: Model, rig: Rig) -> tuple[str, Value]:
    """Return the parameter of the catalogue that a term is, and its value there.

    A force and a flow have the error of the area, as B has.
    """
    c, shape = term.candidate, dict(term.candidate.shape)
    if c.symbol == "omega_max":
        return c.symbol, Value(shape["omega_max"], model.floor, "rad/s")
    soft = model["C_h"]
    if c.name == "C_x" and soft is not None and soft.value > 0.0 and rig.volume_1:
        factor = rig.volume_1 / soft.value
        return "A_v", Value(factor * term.value, factor * term.stddev, "m²")
    area = error_of_area(rig, model.balance)
    return c.symbol or c.name, Value(
        term.value, float(np.hypot(term.stddev, area * term.value)), c.unit)


def numbers_of(name: str, terms: Sequence[Term], values: dict[str, Value]) -> dict[str, float]:
    """Return all parameters of an effect of the catalogue: found, of its shape, and defaults."""
    entry = CATALOGUE.get(name)
    if entry is None:
        return {}
    numbers = {p.name: p.neutral if p.default is None else p.default for p in entry.parameters}
    for term in reversed(terms):
        numbers |= {key: value for key, value in term.candidate.shape if key in numbers}
    numbers |= {key: one.value for key, one in values.items() if key in numbers}
    if name == "external_leakage" and not any(
            term.candidate.shape for term in terms):  # of both chambers
        numbers["L_2"] = numbers["L_1"]
    return numbers


def config_effects(models: Sequence[Model], effects: Sequence[NamedEffect], settings: Settings,
                   newest: bool) -> dict[str, dict[str, float]]:
    """Return the ``effects:`` section: what the config had, and what of the catalogue is named.

    What the catalogue does not hold, or not that way round, has no place there.  A load that
    differs over the recordings is their mean, or that of the first where it is the ``newest``.
    A number that the config has is the recordings' where they know it twice as well: 6 % of a
    weight, within its tolerance, are a mismatch of 400 times the noise for a filter.
    """
    found = {name: dict(values) for name, values in settings.effects.items()}
    for term in (term for model in models for term in model.terms):
        c, (value, stddev) = term.candidate, term.quantity
        if c.held and c.symbol in found.get(c.effect, {}) and (
                stddev < TWICE * settings.rig.tolerance.effects * abs(c.held)):
            found[c.effect][c.symbol] = c.held + value
    for effect in effects:
        entry, model = CATALOGUE.get(effect.name), next(
            one for one in models if one.balance == effect.balance)
        if entry is None:
            continue
        terms = [t for t in model.named if t.candidate.effect in (effect.name, *entry.contains)]
        first = {t.candidate.symbol: t.each[0] - t.value for t in terms if t.each and newest}
        values = {symbol: replace(value, value=value.value + first.get(symbol, 0.0))
                  for symbol, value in effect.parameters.items()}
        if effect.name in found:
            found[effect.name] |= {symbol: value.value for symbol, value in values.items()
                                   if symbol in found[effect.name]}
            continue
        numbers = numbers_of(effect.name, terms, values)
        if all(p.name not in values or numbers[p.name] >= p.lower
               for p in entry.parameters):
            found[effect.name] = {p.name: float(min(max(numbers[p.name], p.lower), p.upper))
                                  for p in entry.parameters}
    return found


def _said(term: Term, held: Mapping[str, float]) -> str:
    """Return a term with its number, or those of all recordings; with what the config has."""
    c = term.candidate
    own = held.get(c.symbol, 0.0)
    if not term.each:
        return f"{c.words}: {with_uncertainty(term.value + own, term.stddev, c.unit)}"
    low, high = side_by_side(min(term.each) + own, max(term.each) + own,
                             max(term.stddev, 1e-300), c.unit)
    return f"{c.words}: {low} to {high} over the recordings"


def size_of(terms: Sequence[Term], model: Model) -> str:
    """Return how much terms do at their largest, in words."""
    made = np.concatenate([np.abs(one[table.good] + sum(term.offset for term in terms))
                           for one, table in zip(made_by(terms, model), model.tables,
                                                 strict=True)])
    return quantity(float(np.quantile(made, LARGEST)), SIDES[model.balance], 3)


def made_by(terms: Sequence[Term], model: Model) -> list[np.ndarray]:
    """Return what terms make in each recording at the compared points, (m,) each."""
    names = [term.candidate.name for term in terms]
    found = []
    for table, weights in zip(model.tables, model.weights, strict=True):
        total = np.zeros(len(table.rows))
        for name in names:
            if name in table.places:
                total += weights.get(name, 0.0) * table.rows[:, table.places[name]]
        found.append(total)
    return found


def _configured(term: Term, rig: Rig) -> tuple[str, float, Value] | None:
    """Return the config's number that a term corrects: its key, the config's value, what it is.

    The leakage is C_T / 2 of the pressure difference; a mass or a leakage is added to.
    """
    gain = rig.position_gain or 0.0
    key, value, slope = {
        "D_p": ("pump_displacement", term.value, 1.0), "dM": ("mass", rig.mass + term.value, 1.0),
        "k_d": ("position_gain", gain * (1.0 + term.value), gain),
        "L": ("leakage", rig.leakage + 2.0 * term.value, 2.0),
    }.get(term.candidate.name, ("", 0.0, 0.0))
    configured = getattr(rig, key) if key else None
    if not configured or not value > 0.0:
        return None
    unit = type(rig).model_fields[key].json_schema_extra["unit"]
    area = error_of_area(rig, term.candidate.balance) * value
    return key, configured, Value(value, float(np.hypot(slope * term.stddev, area)), unit)


def gainless(model: Model, policy: Policy) -> bool:
    """Tell whether a model of the drive has no sure gain, which every drive has.

    Its other terms then share it: behind an integral part of the controller, which the catalogue
    does not have, a feed-forward and a lag of 108 ms for 5 had done the work of the gain.
    """
    return any(term.candidate.name == "k_d" and np.isfinite(term.stddev)
               and not policy.sure(1.0 + term.value, term.stddev) for term in model.terms)


def within_tolerance(term: Term, rig: Rig, policy: Policy) -> bool:
    """Tell whether a number of the config may be what a term says of it, by its tolerance."""
    found = _configured(term, rig)
    if found is None:
        (value, stddev), held = term.quantity, term.candidate.held
        return bool(held) and abs(value) <= policy.varied * float(
            np.hypot(rig.tolerance.effects * held, stddev))
    key, configured, now = found
    # A share of the larger one: what is surely less is so however little is left of it.
    return abs(np.log(now.value / configured)) <= policy.varied * float(np.hypot(
        rig.tolerance.log_spread(key), now.stddev / max(now.value, configured)))


def weightless(term: Term, rig: Rig, policy: Policy) -> bool:
    """Tell whether a term leaves no moving mass: a bound, and what too coarse a pressure shows."""
    return term.candidate.name == "dM" and not policy.sure(
        max(rig.mass + term.value, 0.0), term.stddev)


def _leaks_more(term: Term, policy: Policy) -> bool:
    """Tell whether the leakage that every model has is surely more than the config's."""
    return (term.candidate.name == "L" and term.candidate.always
            and term.value > 0.0 and policy.sure(term.value, term.stddev))


def wrong_numbers(model: Model, rig: Rig, policy: Policy) -> list[RigFinding]:
    """Return the numbers of the config that are far from the recordings'."""
    found = []
    for term in model.terms:
        one = _configured(term, rig)
        if one is None or not np.isfinite(term.stddev) or within_tolerance(term, rig, policy):
            continue
        key, configured, now = one
        if weightless(term, rig, policy):
            continue
        if key == "leakage" or (key == "mass" and (term.value > 0.0 or not (
                term.named or configured > OTHER * (now.value + policy.varied * now.stddev)))):
            continue  # more of either is an effect of the catalogue
        found.append(RigFinding(key, configured, now, policy.certain,
                                beside_config(key, configured, now), TWINS.get(key, ())))
    return found


def numbers_within(model: Model, rig: Rig, policy: Policy) -> list[RigFinding]:
    """Return the numbers that a recording knows better than the config, within their tolerance.

    Twice as well, and apart by two deviations, and by more than half a tolerance or by what the
    balance shows: what it then takes away is said.
    """
    found = []
    for term in model.terms:
        one = _configured(term, rig)
        if one is None or not np.isfinite(term.stddev) or not within_tolerance(term, rig, policy):
            continue
        key, configured, now = one
        # With the config's areas: they are off in all of its numbers alike.
        spread = rig.tolerance.log_spread(key)
        sigma = np.sqrt(max((now.stddev / now.value) ** 2 - error_of_area(
            rig, model.balance) ** 2, 0.0))
        moved = float(np.log(now.value / configured))
        shows = abs(moved) > TWICE * spread or _share(term, model, configured) > policy.worse
        if not sigma < TWICE * spread or abs(moved) <= APART * sigma or not shows:
            continue
        found.append(RigFinding(
            key, configured, now, np.nan, f"{beside_config(key, configured, now)}, "
            f"{within_words(moved, spread)}", TWINS.get(key, ())))
    return found


def _share(term: Term, model: Model, configured: float) -> float:
    """Return how much of a balance a number makes by which a term differs from the config's."""
    name = term.candidate.name
    off = term.value - (configured if name == "D_p" else 0.0)
    made = np.concatenate([table.rows[table.good, table.places[name]] for table in model.tables])
    return abs(off) * rms(made) / model.size
