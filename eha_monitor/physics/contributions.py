"""All active effects of the catalogue in one compiled call."""

from eha_monitor.compiled import literal_unroll, njit
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.physics.signals import MAX_PARAMETERS, N_BASE

N_EFFECTS = len(CATALOGUE)
N_THETA = N_BASE + N_EFFECTS * MAX_PARAMETERS
_TERMS = tuple(effect.term for effect in CATALOGUE.values())


@njit
def add_contributions(s, theta, active, c):
    """Fill ``c`` with the sum of the active effects.

    Parameters
    ----------
    s : (N_SIGNALS,) signals, SI.
    theta : (N_THETA,) base parameters, then MAX_PARAMETERS places for each effect.
    active : (N_EFFECTS,) bool.
    c : (N_CONTRIBUTIONS,) written.
    """
    c[:] = 0.0
    i = 0
    for term in literal_unroll(_TERMS):
        if active[i]:
            start = N_BASE + i * MAX_PARAMETERS
            term(s, theta[start : start + MAX_PARAMETERS], c)
        i += 1
