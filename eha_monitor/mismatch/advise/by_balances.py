"""The advice of recordings that their balances judge."""

from collections.abc import Sequence

import numpy as np

from eha_monitor.balances.answer import Asked, answered
from eha_monitor.balances.candidates import Scale, balances_in, candidates_of
from eha_monitor.balances.course import course_of
from eha_monitor.balances.least_squares import inverse_of
from eha_monitor.balances.policy import POLICY
from eha_monitor.balances.table import pooled_table, tables_of
from eha_monitor.mismatch.advise.identifiability import Known
from eha_monitor.mismatch.advise.separate import Advice
from eha_monitor.mismatch.diagnosis import Diagnosis
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.monitor import Settings


def advised_by_balances(recordings: Sequence[Recording], settings: Settings
                        ) -> tuple[tuple[str, ...], Advice]:
    """Return the named effects, and what the balances leave open; no motion is simulated.

    Raises
    ------
    InputError
        If one of the recordings has no force balance.
    """
    found = answered(recordings, settings, Asked())
    names = tuple(one.name for one in found.effects if one.name in CATALOGUE)
    unit = "N·s/m" if settings.rig.motion == "linear" else "N·m·s/rad"
    return names, Advice(_known(found, recordings, settings), np.nan, (), (), (), (), None, (), (),
                         False, unit, found.advice)


def _known(found: Diagnosis, recordings: Sequence[Recording], settings: Settings
           ) -> tuple[Known, ...]:
    """Return B, beta_e and the effects' parameters, each with what it is confused with most."""
    courses = [course_of(one, settings) for one in recordings]
    scale, known = Scale.of(courses), []
    for balance in balances_in(courses, settings.rig):
        table = pooled_table(tables_of(courses, settings.rig, balance, candidates_of(
            balance, scale, settings.rig), POLICY))
        named = {e.name for e in found.effects if e.balance == balance}
        first = {one.effect: one for one in reversed(table.candidates)}
        terms = [one for one in table.candidates if one.always or one.name == "C_h" or (
            one.effect in named and one is first[one.effect])]
        places = [table.places[one.name] for one in terms]
        gram = table.gram[np.ix_(places, places)]
        inverse = inverse_of(gram)
        sigma = np.sqrt(np.diag(inverse))
        for i, one in enumerate(terms):
            values = {"B": ("B", found.after.get("B", found.before.get("B"))), "C_h": (
                "beta_e", found.after.get("beta_e", found.before.get("beta_e")))}
            name, value = values.get(one.name, (f"{one.effect}.{one.symbol}", next((
                e.parameters.get(one.symbol) for e in found.effects if e.name == one.effect),
                None)))
            if value is None or not len(terms) > 1:
                continue
            others = np.delete(np.arange(len(terms)), i)
            correlation = np.nan_to_num(inverse[i, others] / (sigma[i] * sigma[others]))
            most = int(np.argmax(np.abs(correlation)))
            other = terms[others[most]]
            known.append(Known(
                name, value.value, value.stddev, value.unit, float(inverse[i, i] * gram[i, i]),
                float(correlation[most]), {"B": "B", "C_h": "beta_e"}.get(
                    other.name, f"{other.effect}.{other.symbol or other.name}")))
    return tuple(known)
