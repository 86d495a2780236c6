"""Draws of a trial: the mixed one or a ladder of strengths, on drawn rigs or that of a config."""

from dataclasses import replace

import numpy as np

from eha_monitor.concealed.cases import CONFIG_KEYS, TOLERANCES, Case, effect_names
from eha_monitor.concealed.draws import SETS, draw_cases, misconfigured
from eha_monitor.concealed.hidden import SIGNED
from eha_monitor.errors import InputError
from eha_monitor.settings.monitor import Settings

DRAWS = ("mixed", "ladder", "outside")
WEAKEST, STRONGEST = 0.01, 1.2
GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)


def cases_of(draw: str, count: int, seed: int, rig: str = "mixed",
             settings: Settings | None = None, source: str = "") -> tuple[Case, ...]:
    """Return the cases of a trial; fewer of the same seed are a head of more.

    Parameters
    ----------
    draw : ``mixed`` (rigs, motions, sets of 0 to 3 effects, outside the catalogue), ``ladder``
        (one effect on rich motion, each effect at strengths that fill the scale evenly) or
        ``outside`` (rigs and motions; what no catalogue has, alone).
    rig : what the nominal configs say of the rig, one of :data:`KINDS`.
    settings : config on whose rig all cases are, ``source`` its name; drawn rigs without it.
    """
    cases = (tuple(rung(i, seed) for i in range(count)) if draw == "ladder" else
             tuple(draw_cases(count, seed, rig="exact", sets=(
                 SETS if draw == "mixed" else {"outside": 1.0}))))
    if settings is not None:
        cases = on_rig(cases, settings, source)
    return tuple(misconfigured(cases, seed, rig))


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


def on_rig(cases: tuple[Case, ...], settings: Settings, source: str) -> tuple[Case, ...]:
    """Return the cases on the rig of a config in place of the drawn ones, with its tolerances.

    Raises
    ------
    InputError
        If the generator cannot be that rig: it is a linear actuator with equal areas and volumes
        whose position loop is closed.
    """
    rig = settings.rig
    if rig.motion != "linear" or rig.area_1 != rig.area_2 or rig.volume_1 != rig.volume_2:
        raise InputError(f"{source}: expected a linear actuator with equal areas and volumes: no "
                         "other can be made for the trial")
    constants = {symbol: getattr(rig, keys[0]) for symbol, keys in CONFIG_KEYS.items()}
    for symbol, value in constants.items():
        if value is None:
            raise InputError(f"{source}: rig.{CONFIG_KEYS[symbol][0]}: expected a value, the "
                             "trial simulates the rig")
    spreads = {symbol: rig.tolerance.log_spread(CONFIG_KEYS[symbol][0]) for symbol in TOLERANCES}
    own = {symbol: spread for symbol, spread in spreads.items() if spread != TOLERANCES[symbol]}
    return tuple(replace(case, rig={symbol: float(value) for symbol, value in constants.items()},
                         nominal={"B": float(rig.viscous_damping),
                                  "beta_e": float(rig.bulk_modulus)},
                         tolerances=own) for case in cases)
