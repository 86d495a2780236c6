"""From settings to the parameter vector theta that the compiled equations read."""

import numpy as np

from eha_monitor.errors import InputError
from eha_monitor.physics import signals
from eha_monitor.physics.contributions import N_EFFECTS, N_THETA, slot_of
from eha_monitor.physics.effects import CATALOGUE, NAMES
from eha_monitor.settings.own_terms import is_own, slot_for
from eha_monitor.settings.rig import Rig

# Place in theta <- key of the rig section.
BASE_KEYS = {
    signals.AREA_1: "area_1", signals.AREA_2: "area_2",
    signals.VOL_1: "volume_1", signals.VOL_2: "volume_2",
    signals.M: "mass", signals.B: "viscous_damping", signals.BETA_E: "bulk_modulus",
    signals.C_T: "leakage", signals.D_P: "pump_displacement", signals.K_POS: "position_gain",
    signals.P_CHARGE: "charge_pressure", signals.G_MAKEUP: "makeup_conductance",
    signals.P_AMBIENT: "ambient_pressure",
}
_PLACES = {key: place for place, key in BASE_KEYS.items()} | {
    f"{name}.{p.name}": slot_of(which).start + i for which, name in enumerate(NAMES)
    for i, p in enumerate(CATALOGUE[name].parameters)}


def theta_of(rig: Rig, effects: dict[str, dict]) -> tuple[np.ndarray, np.ndarray]:
    """Return ``theta`` (N_THETA,) and ``active`` (N_EFFECTS,) bool; null constants become NaN.

    Terms of the rig's own take the places after the catalogue's, in their order.
    """
    theta = np.zeros(N_THETA)
    active = np.zeros(N_EFFECTS, dtype=np.bool_)
    for place, key in BASE_KEYS.items():
        value = getattr(rig, key)
        theta[place] = np.nan if value is None else value
    own = iter(range(len(NAMES), N_EFFECTS))
    for name, values in effects.items():
        if is_own(values):
            which = next(own)
            active[which], theta[slot_of(which)] = True, slot_for(values)
            continue
        active[NAMES.index(name)] = True
        for p in CATALOGUE[name].parameters:
            # A limit that is not there stands at its bound: finite, a fault can start from it.
            theta[place_of(f"{name}.{p.name}")] = min(values[p.name], p.upper)
    return theta, active


def place_of(parameter: str) -> int:
    """Return the place in theta of a rig key (``bulk_modulus``) or ``<effect>.<parameter>``."""
    return _PLACES[parameter]


def effect_values(theta: np.ndarray, effect: str) -> dict[str, float]:
    """Return an effect's parameters as they stand in theta, by name, SI."""
    return {p.name: float(theta[place_of(f"{effect}.{p.name}")])
            for p in CATALOGUE[effect].parameters}


def require_plant(rig: Rig, source: str) -> None:
    """Raise InputError if a constant that the whole plant needs is null."""
    for key in BASE_KEYS.values():
        if getattr(rig, key) is None:
            raise InputError(f"{source}: rig.{key}: the simulator needs a value, got null")
