"""Draws of a trial beside the mixed one: single effects over a ladder of strengths."""

import numpy as np

from eha_monitor.concealed.cases import Case, effect_names
from eha_monitor.concealed.draws import draw_cases
from eha_monitor.concealed.hidden import SIGNED

DRAWS = ("mixed", "ladder")
WEAKEST, STRONGEST = 0.01, 1.2
GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)


def cases_of(draw: str, count: int, seed: int) -> tuple[Case, ...]:
    """Return the cases of a trial; fewer of the same seed are a head of more.

    Parameters
    ----------
    draw : ``mixed`` (rigs, motions, sets of 0 to 3 effects, outside the catalogue) or ``ladder``
        (one effect on rich motion, each effect at strengths that fill the scale evenly).
    """
    if draw == "mixed":
        return tuple(draw_cases(count, seed))
    return tuple(rung(i, seed) for i in range(count))


def rung(i: int, seed: int) -> Case:
    """Return one case of the ladder; B and beta_e are not those of the nominal config."""
    rng = np.random.default_rng([seed, i, 5])
    names = np.random.default_rng([seed, 6]).permutation(effect_names())
    turn, place = divmod(i, len(names))
    name = str(names[place])
    # Multiples of the golden ratio fill the interval evenly however many there are.
    share = (GOLDEN * (turn + 1) + place / len(names)) % 1.0
    strength = float(f"{WEAKEST * (STRONGEST / WEAKEST) ** share:.4g}")
    if name in SIGNED and name != "cross_port_leakage" and rng.random() < 0.5:
        strength = -strength
    rig = {"B": round(rng.uniform(500.0, 900.0)), "beta_e": round(rng.uniform(4.5, 8.0), 2) * 1e8}
    return Case(f"c{i + 1:03d}", ((name, strength),), seed=int(rng.integers(2**31)), rig=rig)
