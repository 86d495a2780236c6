"""What a diagnosis shows where the balances are compared as they stand.

Errors, curves, places and agreement come from the very balances that were fitted
(:mod:`equation_error`); no filter takes part, since there it has nothing true to say.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from eha_monitor import ties
from eha_monitor.mismatch.data.experiment import Experiment, Stretch
from eha_monitor.mismatch.diagnosis import Agreement, Location, NamedEffect, Overlay, SignalFit
from eha_monitor.mismatch.likelihood.clean_balances import floor_of
from eha_monitor.mismatch.likelihood.equation_error import left_along, motion_of
from eha_monitor.mismatch.likelihood.fit import Fit, innovations
from eha_monitor.mismatch.locate import location
from eha_monitor.mismatch.locate.missing import without
from eha_monitor.mismatch.locate.terms import BALANCES, Missing
from eha_monitor.mismatch.show import held_out
from eha_monitor.physics import signals as s
from eha_monitor.physics.effects import CATALOGUE

SHOWN = ("force", "flow", "drive")
UNITS = ("N", "m³/s", "rad/s")
CLEAN = 1.25  # times what the sensors leave: the scatter of some hundred correlated samples
NOTHING = 0.01  # of what a balance does: below is nothing, as for the filter's unknowns


@dataclass(frozen=True)
class Balances:
    """How well the balances close.

    Attributes
    ----------
    floor : (c,) what the sensors alone leave, SI.
    driven : (c,) rms of what drives each balance: force, pumped flow, shaft speed.
    left : (c,) what the fitted model leaves on the counted samples.
    """

    floor: np.ndarray
    driven: np.ndarray
    left: np.ndarray

    @property
    def open(self) -> np.ndarray:
        """(c,) bool: more is left than the sensors make, and of a size that matters."""
        more = np.sqrt(np.maximum(self.left**2 - self.floor**2, 0.0))
        return (self.left > CLEAN * self.floor) & (more > NOTHING * self.driven)


def balances_of(experiment: Experiment, before: Fit, fit: Fit) -> Balances:
    """Return how well a model closes the balances.

    ``before`` : the nominal model.  It sets the floor: no demand brings a drive over its limit, so
    a clean record of a saturated one cannot be written down from the measured speed.
    """
    rows = [driven_along(experiment, stretch, fit) for stretch in experiment.stretches]
    driven = np.array([held_out.rms(np.concatenate([row[j] for row in rows]))
                       for j in range(len(rows[0]))])
    left = np.sqrt(np.nanmean(fit.e**2, axis=0))
    return Balances(floor_of(experiment, before), driven, left)


def driven_along(experiment: Experiment, stretch: Stretch, fit: Fit) -> list[np.ndarray]:
    """Return what drives each balance at the compared samples: N, m^3/s, rad/s."""
    motion = motion_of(experiment, stretch)
    rows = []
    for j in range(fit.e.shape[1]):
        row = _driving(motion, fit, j)
        rows.append(row[motion.compared][motion.telling[j][motion.compared]])
    return rows


def signals_of(shown: Experiment, before: Fit, after: Fit, floor: np.ndarray
               ) -> dict[str, SignalFit]:
    """Return what is left of each balance on unseen data, rms; the force while it moves.

    At rest dry friction holds whatever force there is, and none is left to compare.
    """
    there = shown.only(tuple(
        replace(stretch, counted=mask)
        for stretch, mask in zip(shown.stretches, held_out.unseen(shown), strict=True)))
    left = [innovations(there, fit.theta, fit.active, fit.gains) for fit in (before, after)]
    size = [np.concatenate(rows) for rows in zip(*(driven_along(there, stretch, after)
                                                   for stretch in there.stretches), strict=True)]
    return {name: SignalFit(unit, *(held_out.rms(e[np.isfinite(e[:, j]), j]) for e in left),
                            float(floor[j]), signal_rms=held_out.rms(size[j]))
            for j, (name, unit) in enumerate(zip(SHOWN, UNITS, strict=True)) if j < len(floor)}


def tracks_of(experiment: Experiment) -> list[np.ndarray]:
    """Return the measured signals along each stretch, (n, N_SIGNALS) each."""
    return [upsampled(experiment, stretch, motion_of(experiment, stretch).track)
            for stretch in experiment.stretches]


def upsampled(experiment: Experiment, stretch: Stretch, values: np.ndarray) -> np.ndarray:
    """Return rows of the fine grid at every sample of a stretch."""
    motion = motion_of(experiment, stretch)
    fine = np.arange(len(values)) * motion.dt
    time = np.arange(len(stretch)) * experiment.dt
    if values.ndim == 1:
        return np.interp(time, fine, values)
    return np.column_stack([np.interp(time, fine, row) for row in values.T])


def terms_of(experiment: Experiment, before: Fit, after: Fit) -> list[Missing]:
    """Return the missing term of each balance that the named effects are in, or of all.

    What the record needs once the effects of that balance are switched off in ``after``.
    """
    found = []
    for j in range(after.e.shape[1]):
        named = [name for name in after.named if CATALOGUE[name].balance == SHOWN[j]]
        if after.named and not named:
            continue
        base = without(before, after, SHOWN[j]) if named else after
        one = needed(experiment, base, after, SHOWN[j])
        found.append(one if named else replace(one, modelled=None))
    return found


def needed(experiment: Experiment, base: Fit, after: Fit, balance: str) -> Missing:
    """Return what one model leaves of a balance, and what another takes away of that."""
    j = SHOWN.index(balance)
    measured, modelled = [], []
    for stretch in experiment.stretches:
        motion = motion_of(experiment, stretch)
        rows = [motion.band(left_along(experiment, stretch, fit.theta, fit.active)[j])
                for fit in (base, after)]
        there = upsampled(experiment, stretch, motion.telling[j].astype(float)) > 0.99
        need = upsampled(experiment, stretch, rows[0])
        measured.append(np.where(there, need, np.nan))
        modelled.append(upsampled(experiment, stretch, rows[0] - rows[1]))
    return Missing(balance, UNITS[j], tuple(tracks_of(experiment)), tuple(measured),
                   tuple(modelled))


def location_of(experiment: Experiment, effects: Sequence[NamedEffect], terms: list[Missing],
                closed: Balances) -> Location:
    """Say where model and recording disagree: by evidence, or by what is left over."""
    weights = dict.fromkeys(BALANCES, 0.0)
    for effect in effects:
        weights[effect.balance] += max(float(effect.log_evidence), 0.0)
    if not effects:
        for name, left, floor in zip(SHOWN, closed.left, closed.floor, strict=False):
            weights[name] = float(np.log(max(left / floor, 1.0)))
    total = sum(weights.values())
    if total <= 0.0:
        return Location(weights, "", ())
    shares = {name: weight / total for name, weight in weights.items()}
    largest = ties.best(shares, shares.get)
    mine = [term for term in terms if term.balance == largest]
    if not mine:
        return Location(shares, "always", location.whole_of(experiment))
    return location.located(experiment, shares, mine[-1])


def overlays(shown: Experiment, before: Fit, after: Fit) -> tuple[Overlay, ...]:
    """Return what drives each balance and what both models make of the motion, unseen data.

    Of each balance the held-out second in which the model before is worst.
    """
    windows = held_out.windows_of(shown, held_out.OVERLAY)
    found = []
    for j in range(after.e.shape[1]):
        worst, chosen = -1.0, None
        for i, first, last in windows:
            stretch = shown.stretches[i]
            motion = motion_of(shown, stretch)
            here = slice(-(-first // motion.every), last // motion.every)
            left = [motion.band(left_along(shown, stretch, fit.theta, fit.active)[j])[here]
                    for fit in (before, after)]
            still = ~motion.telling[j][here]
            size = held_out.rms(left[0][~still])
            if len(left[0]) > 2 and np.isfinite(size) and size > worst:
                whole = _driving(motion, after, j)[here]
                time = stretch.start + np.arange(here.start, here.stop) * motion.dt
                worst, chosen = size, Overlay(
                    SHOWN[j], UNITS[j], time, np.where(still, np.nan, whole),
                    *(np.where(still, np.nan, whole - one) for one in left))
        if chosen is not None:
            found.append(chosen)
    return tuple(found)


def _driving(motion, fit: Fit, balance: int) -> np.ndarray:
    speed = motion.track[:, s.OMEGA]
    return motion.band((motion.force, fit.theta[s.D_P] * speed, speed)[balance])


def agreement(experiment: Experiment, before: Fit, after: Fit) -> tuple[Agreement, ...]:
    """Return B and beta_e from parts of the record, all else held."""
    return held_out.agreement(experiment, before, after, tracks_of(experiment))


def doubts(effects: Sequence[NamedEffect]) -> tuple[str, ...]:
    """Return what to do about rivals; no motion is proposed, no model here predicts one."""
    return tuple(f"{effect.name} and {' and '.join(effect.indistinguishable_from)} are "
                 f"indistinguishable in these recordings: {effect.rig_check}"
                 for effect in effects if effect.indistinguishable_from)
