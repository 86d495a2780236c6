"""Where model and recording disagree: balance, regime, intervals, and the missing term's shape."""

from collections.abc import Mapping, Sequence

import numpy as np

from eha_monitor import ties
from eha_monitor.balances import places
from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.data.inputs import FORCED
from eha_monitor.mismatch.diagnosis import Curve, Location
from eha_monitor.mismatch.likelihood.along import smoothed
from eha_monitor.mismatch.likelihood.fit import Fit
from eha_monitor.mismatch.locate.latent import latent_gains, shares_of
from eha_monitor.mismatch.locate.terms import (
    BALANCES,
    STATES,
    UNITS,
    Missing,
    following,
    missing_terms,
    sensor_errors,
    tracks_of,
)
from eha_monitor.mismatch.name.candidates import candidate
from eha_monitor.mismatch.name.starts import limits_of
from eha_monitor.mismatch.name.unnamed import INTERMITTENT
from eha_monitor.physics import signals as s
from eha_monitor.physics.effects import CATALOGUE

LEFT = 30.0  # times the smallest unknowns: the named effects leave something behind
LEARNED = "learned."  # before the balance of a term that was learned


def latent_curves(experiment: Experiment, before: Fit, after: Fit | None,
                  terms: Sequence[Missing] | None = None) -> tuple[Curve, ...]:
    """Return the missing term against time, velocity, position, pressure difference and speed.

    Parameters
    ----------
    before : nominal model, fitted.
    after : with the named effects; None, or without names, where nothing explains the mismatch:
        then the unknown force, flow and speed are shown beside a modelled term of zero.
    terms : :func:`missing_terms`, where they are at hand.
    """
    terms = missing_terms(experiment, before, after) if terms is None else terms
    return tuple(curve for term in terms for curve in curves_of(experiment, term))


def curves_of(experiment: Experiment, term: Missing) -> list[Curve]:
    """Bin a missing term against everything that it may hang on."""
    return places.curves_of(term.balance, term.unit, parts_of(experiment, term))


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


def located(experiment: Experiment, shares: dict[str, float], term: Missing) -> Location:
    """Return where a missing term is worst, beside the shares of the balances."""
    parts = parts_of(experiment, term)
    regime, weight = places.regime_of(term.balance, parts)
    return Location(shares, regime, places.worst_intervals(parts, weight) if regime != "always"
                    else whole_of(experiment))


def location_of(experiment: Experiment, before: Fit, after: Fit | None,
                named: Mapping[str, float], terms: Sequence[Missing] | None = None) -> Location:
    """Say where model and recording disagree.

    Parameters
    ----------
    named : effect, ``rig.<key>`` or ``learned.<balance>`` -> log evidence; empty where nothing
        explains the mismatch.  What the named effects leave behind counts beside them.
    terms : :func:`missing_terms` of the named effects, where they are at hand.
    """
    weights = dict.fromkeys(BALANCES, 0.0)
    for name, gain in named.items():
        weights[balance_of(name)] += max(float(gain), 0.0)
    known, outputs = sum(weights.values()), []
    last = before if after is None else after
    small = limits_of(experiment)[0].as_array()
    if not known or (last.unknowns.as_array() > LEFT * small).any():
        gains = latent_gains(experiment, last)
        shares, best, outputs = shares_of(gains)
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
    if not mine and balance in UNITS:
        states = smoothed(experiment, following(experiment, last, balance))
        mine = [Missing(balance, UNITS[balance], tracks_of(experiment, states),
                        tuple(one[:, STATES[balance]] for one in states))]
    elif not mine:
        mine = sensor_errors(experiment, last, balance, outputs)
    if not mine:
        return Location(shares, "always", whole_of(experiment))
    return located(experiment, shares, mine[-1])


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
