"""All active effects of the catalogue in one compiled call."""

import numpy as np

from eha_monitor.compiled import literal_unroll, njit
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.physics.signals import LIMITS, MAX_MEMORY, MAX_PARAMETERS, N_BASE, N_CIRCUIT

N_EFFECTS = len(CATALOGUE)
N_THETA = N_BASE + N_EFFECTS * MAX_PARAMETERS
_TERMS = tuple(effect.term for effect in CATALOGUE.values())
_UPDATES = tuple(effect.update for effect in CATALOGUE.values())
_CIRCUITS = tuple(effect.circuit for effect in CATALOGUE.values())


def new_memory() -> np.ndarray:
    """Return the memory of all effects at the start, (N_EFFECTS, MAX_MEMORY)."""
    return np.zeros((N_EFFECTS, MAX_MEMORY))


@njit(forceinline=True)
def add_contributions(s, theta, active, memory, c):
    """Fill ``c`` with the sum of the active effects.

    Parameters
    ----------
    s : (N_SIGNALS,) signals, SI.
    theta : (N_THETA,) base parameters, then MAX_PARAMETERS places for each effect.
    active : (N_EFFECTS,) bool.
    memory : (N_EFFECTS, MAX_MEMORY), read.
    c : (N_CONTRIBUTIONS,) written.
    """
    c[:] = 0.0
    i = 0
    for term in literal_unroll(_TERMS):
        if active[i]:
            start = N_BASE + i * MAX_PARAMETERS
            term(s, theta[start : start + MAX_PARAMETERS], memory[i], c)
        i += 1


@njit
def update_memory(s, theta, active, h, memory):
    """Carry the memory of the active effects over a step of ``h`` s that ends at ``s``."""
    i = 0
    for update in literal_unroll(_UPDATES):
        if active[i]:
            start = N_BASE + i * MAX_PARAMETERS
            update(s, theta[start : start + MAX_PARAMETERS], h, memory[i])
        i += 1


@njit
def circuit_of(theta, active):
    """Return the constants of drive and sensors, (N_CIRCUIT,), with the active effects."""
    w = np.zeros(N_CIRCUIT)
    for place in LIMITS:
        w[place] = np.inf
    i = 0
    for circuit in literal_unroll(_CIRCUITS):
        if active[i]:
            start = N_BASE + i * MAX_PARAMETERS
            circuit(theta[start : start + MAX_PARAMETERS], w)
        i += 1
    return w
