"""What effects contribute along a given motion."""

import numpy as np

from eha_monitor.compiled import njit
from eha_monitor.estimation.small_matrices import copied
from eha_monitor.physics import signals as s
from eha_monitor.physics.contributions import (
    add_contributions,
    update_memory,
    with_term,
    with_update,
)


@njit(nogil=True)
def contributions_along(trajectory, dt, steps, theta, active, memory, out):
    """Write what the active effects contribute on a trajectory.

    Parameters
    ----------
    trajectory : (n, N_SIGNALS) signals, linear between samples.
    steps : steps of the effects' memory in a sample of ``dt`` s.
    out : (n, N_CONTRIBUTIONS) written.
    """
    terms, updates = with_term(active), with_update(active, theta)
    now = np.zeros(s.N_SIGNALS)
    c = np.zeros(s.N_CONTRIBUTIONS)
    n = trajectory.shape[0]
    for k in range(n):
        copied(now, trajectory[k])
        add_contributions(now, theta, terms, memory, c)
        copied(out[k], c)
        if k + 1 < n and len(updates):
            for i in range(1, steps + 1):
                f = i / steps
                for j in range(now.shape[0]):
                    now[j] = (1.0 - f) * trajectory[k, j] + f * trajectory[k + 1, j]
                update_memory(now, theta, updates, dt / steps, memory)
