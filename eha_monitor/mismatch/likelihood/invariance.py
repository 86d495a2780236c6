"""Directions of the parameters along which no recording can tell one machine from another.

Two are exact in the equations (:mod:`eha_monitor.physics.balances`):

    size       areas, masses, forces, flows and volumes times one factor: it multiplies both
               sides of each balance
    stiffness  beta_e and the volumes times one factor, free air over it: only V / beta_e stands
               in the equations
    pressure   pressures, forces, masses and beta_e times one factor, conductances over it: another
               kilogram, which the scales of both pressure sensors make up for; only under gains
               of the filter that are made anew, since its states grow with it

Only what is known beforehand (``rig.tolerance``) decides along them.  Slopes from differences do
not add up to zero there to the last digit, least of all where a valve opens; what is left looks
like information, holds a fit where it stands, and makes it surer than the tolerances are.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from eha_monitor.mismatch.likelihood.fit import Free
from eha_monitor.physics import signals as s
from eha_monitor.physics.contributions import N_EFFECTS
from eha_monitor.physics.effects import CATALOGUE, NAMES
from eha_monitor.physics.parameters import place_of

EXTENSIVE = ("N", "kg", "m^2", "m^3")  # how the units begin of what grows with the machine
SIZE = (s.AREA_1, s.AREA_2, s.VOL_1, s.VOL_2, s.M, s.B, s.C_T, s.D_P, s.G_MAKEUP)
STIFFNESS = (s.BETA_E, s.VOL_1, s.VOL_2)
PRESSURES = {s.BETA_E: 1.0, s.M: 1.0, s.B: 1.0, s.P_CHARGE: 1.0, s.C_T: -1.0, s.G_MAKEUP: -1.0}
KILOGRAMS = {"N": 1.0, "N/m": 1.0, "N*s/m": 1.0, "N*s^2/m^2": 1.0, "kg": 1.0, "Pa": 1.0,
             "Pa*s/rad": 1.0, "1/Pa": -1.0, "m^3/(s*Pa)": -1.0, "m^3/(s*Pa^0.5)": -0.5}
SCALES = NAMES.index("pressure_scale")
# Relative errors: what grows by a factor is one and the number together.
BEYOND_ONE = frozenset(place_of(f"pressure_scale.{k}") for k in ("k_1", "k_2"))
NEGLIGIBLE = 0.03  # of its largest part: a slope along such a direction that is error alone


def _exponents() -> tuple[dict[int, dict[int, float]], ...]:
    """Return, for each direction, effect (-1 of the base) -> place in theta -> exponent."""
    size = {-1: dict.fromkeys(SIZE, 1.0)}
    stiffness = {-1: dict.fromkeys(STIFFNESS, 1.0)}
    pressure = {-1: PRESSURES}
    for i, name in enumerate(NAMES):
        effect = CATALOGUE[name]
        places = {p: place_of(f"{name}.{p.name}") for p in effect.parameters}
        size[i] = {at: 1.0 for p, at in places.items() if p.unit.startswith(EXTENSIVE)}
        power = (1.0 if s.VOLUME_1 in effect.adds else
                 -1.0 if s.COMPLIANCE_1 in effect.adds else 0.0)
        stiffness[i] = {places[p]: power for p in effect.sizes if power}
        pressure[i] = {} if effect.balance == "sensor" else {
            at: KILOGRAMS[p.unit] for p, at in places.items() if p.unit in KILOGRAMS}
    pressure[SCALES] = dict.fromkeys(BEYOND_ONE, -1.0)
    return size, stiffness, pressure


*DIRECTIONS, PRESSURE = _exponents()


def directions(free: Sequence[Free], theta: np.ndarray, active: np.ndarray,
               among: Sequence[Mapping] = DIRECTIONS) -> list[Mapping[int, float]]:
    """Return the invariant directions of a fit, none to two: place in theta -> exponent.

    ``among`` : ``DIRECTIONS``, or ``PRESSURE``.  A direction needs all numbers that it moves among
    the fitted ones, unless they are nil.
    """
    if active[len(NAMES) : N_EFFECTS].any():  # a term of the rig's own has laws of its own
        return []
    fitted = {f.place for f in free}
    found = []
    for by_effect in among:
        moved = dict(by_effect[-1])
        for i in np.flatnonzero(active[: len(NAMES)]):
            moved |= by_effect[int(i)]
        moved = {place: power for place, power in moved.items()
                 if np.isfinite(theta[place]) and (theta[place] != 0.0 or place in BEYOND_ONE)}
        if moved and moved.keys() <= fitted:
            found.append(moved)
    return found


def tangents(free: Sequence[Free], theta: np.ndarray, ways: Sequence[Mapping[int, float]]
             ) -> np.ndarray:
    """Return :func:`directions` at ``theta`` in the fitted coordinates, (m, k)."""
    return np.array([[moved.get(f.place, 0.0) * (1.0 if f.log else theta[f.place] + (
        f.place in BEYOND_ONE)) for f in free] for moved in ways]).reshape(-1, len(free))


def consistent(slopes: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Return slopes that are nil along invariant directions, with the least change of each.

    ``slopes`` : (k, n) of the whitened innovations.
    ``along`` : (m, k) of :func:`tangents`.
    """
    if not len(along):
        return slopes
    scale = np.linalg.norm(slopes, axis=1) + 1e-300
    unit = slopes / scale[:, None]
    u = along * scale
    left = np.linalg.norm(u @ unit, axis=1)
    u = u[left < NEGLIGIBLE * np.abs(u).max(axis=1)]  # else the filter's gains can tell
    if not len(u):
        return slopes
    basis = np.linalg.qr(u.T)[0]
    return scale[:, None] * (unit - basis @ (basis.T @ unit))


def at_prior(free: Sequence[Free], theta: np.ndarray, active: np.ndarray,
             among: Sequence[Mapping] = DIRECTIONS) -> list[np.ndarray]:
    """Return models moved along the invariant directions to where their priors are likeliest.

    Along each and along all, where that is within the bounds; in logarithms, so that it stays the
    same machine for the recording however far that is.
    """
    found, ways = [], directions(free, theta, active, among)
    weight = np.array([f.spread for f in free]) ** -2.0
    behind = np.array([f.prior - f.inward(theta[f.place]) for f in free])
    along = tangents(free, theta, ways)
    for which in [[i] for i in range(len(ways))] + ([[*range(len(ways))]] if ways[1:] else []):
        u = along[which]
        shares = np.linalg.solve((u * weight) @ u.T, (u * weight) @ behind)
        other = theta.copy()
        for i, share in zip(which, shares, strict=True):
            for place, power in ways[i].items():
                one = 1.0 if place in BEYOND_ONE else 0.0
                other[place] = (one + other[place]) * np.exp(power * share) - one
        if all(f.lower <= other[f.place] <= f.upper for f in free):
            found.append(other)
    return found
