"""The laws by which what was found becomes indicators, and the viscosity of oil; SI."""

import math
from collections.abc import Mapping

import numpy as np

from eha_monitor.physics.effects import DRY_LAWS
from eha_monitor.physics.effects.oil import P_ATM, compliance
from eha_monitor.settings.monitor import Viscosity

KELVIN = 273.15
EXPANSION = 7e-4  # 1/K, of mineral oil; MIL-H-5606 has 8.3e-4 (docs/health.md)


def walther(at_40: float, at_100: float, temperature: float) -> float:
    """Return the kinematic viscosity in mm²/s at ``temperature`` in °C.

    log log (nu + 0.7) = A - B log T, T in K (Walther 1931; ASTM D341, there for 2 mm²/s and
    more), through the two points that every data sheet prints: ``at_40`` and ``at_100`` °C, the
    first is the larger.
    """
    def height(viscosity: float) -> float:
        return math.log(math.log(viscosity + 0.7))

    def place(celsius: float) -> float:
        return math.log(KELVIN + celsius)

    slope = (height(at_40) - height(at_100)) / (place(100.0) - place(40.0))
    inner = height(at_40) - slope * (place(temperature) - place(40.0))
    return math.exp(math.exp(inner)) - 0.7


def viscosity_ratio(temperature: float, reference: float, coefficient: float,
                    at_40: float | None = None, at_100: float | None = None) -> float:
    """Return the dynamic viscosity at ``reference`` over that at ``temperature``, both in °C.

    With the two kinematic viscosities of the data sheet by Walther's law, times the density,
    which falls by ``EXPANSION``; without them by the Reynolds law exp(-k T), k = ``coefficient``
    in 1/K.  The result is finite for any sensor reading.
    """
    warmer = temperature - reference
    if at_40 is None or at_100 is None:
        return math.exp(min(max(coefficient * warmer, -50.0), 50.0))
    cold, hot = -40.0, 200.0  # where oil is a liquid; ends of ASTM's charts
    there, here = (min(max(one, cold), hot) for one in (reference, temperature))
    density = (1.0 - EXPANSION * (there - 40.0)) / (1.0 - EXPANSION * (here - 40.0))
    return density * walther(at_40, at_100, there) / walther(at_40, at_100, here)


def viscosity_factor(viscosity: Viscosity, temperature: float) -> float:
    """Return B at the reference temperature over B at ``temperature`` (°C)."""
    return viscosity_ratio(temperature, viscosity.reference_temperature, viscosity.coefficient,
                           viscosity.grade, viscosity.at_100)


# Of the power of the viscosity with which a machine's B goes: 1 where all of it is oil in shear, a
# half where half is a seal's; the rms distance from 1 of what lies anywhere between the two.
SHEARED = 0.5 / math.sqrt(3.0)


def at_reference(viscosity: Viscosity, temperature: float, value: float, stddev: float
                 ) -> tuple[float, float]:
    """Return B at the reference temperature with its deviation, from that at ``temperature`` (°C).

    The deviation holds that a part of B may not follow the viscosity (``SHEARED``), which grows
    with the logarithm of the viscosities' ratio: a season is no wear.
    """
    factor = viscosity_factor(viscosity, temperature)
    return factor * value, factor * math.hypot(stddev, SHEARED * value * math.log(factor))


_UNIT_AIR = getattr(compliance, "py_func", compliance)
LEAKS = ("cross_port_leakage", "turbulent_leakage", "leakage_offset")
LOSSES = ("pump_flow_gain", "pump_volumetric_loss")


def leakage_flow(found: Mapping[str, float], pressure: float, thinner: float = 1.0) -> float:
    """Return the flow that holds a pressure difference with the rod blocked, m³/s.

    Q = (C_T/2 + L) dp mu/mu_ref + c dp/(dp² + dp_0²)^¼ + Q_0 tanh(dp/dp_e): the laminar part
    (Merritt 1967, Eq. 6-38) goes as one over the viscosity, the orifice's and the constant one
    do not.

    Parameters
    ----------
    found : ``leakage`` and parameters of :data:`LEAKS`; what is absent is none.
    pressure : dp, Pa.
    thinner : dynamic viscosity at the recording's temperature over that at the reference.
    """
    laminar = 0.5 * found.get("leakage", 0.0) + found.get("cross_port_leakage.L", 0.0)
    flow = thinner * laminar * pressure
    if "turbulent_leakage.c" in found:
        small = found.get("turbulent_leakage.dp_0", 0.0)
        flow += found["turbulent_leakage.c"] * pressure / (pressure**2 + small**2) ** 0.25
    if "leakage_offset.Q_0" in found:
        edge = max(found.get("leakage_offset.dp_e", 0.0), 1.0)
        flow += found["leakage_offset.Q_0"] * math.tanh(pressure / edge)
    return flow


def volumetric_efficiency(found: Mapping[str, float], displacement: float, speed: float,
                          pressure: float, thinner: float = 1.0) -> float:
    """Return the flow into a load at a pressure difference over D_p omega of the config.

    eta = (D/D_p)(1 + k_gain)(1 - k_loss dp) - Q_leak/(D_p omega)  (Merritt 1967, Sec. 4-3), with
    every leak counted as the pump's: between the same two ports nothing distinguishes them.

    Parameters
    ----------
    found : as for :func:`leakage_flow`, and ``pump_displacement`` D as the recording has it.
    displacement : D_p of the config, m³/rad; ``speed`` in rad/s.
    """
    given = found.get("pump_displacement", displacement) / displacement
    given *= 1.0 + found.get("pump_flow_gain.k", 0.0)
    given *= 1.0 - found.get("pump_volumetric_loss.k", 0.0) * pressure
    return given - leakage_flow(found, pressure, thinner) / (displacement * speed)


def dry_friction(found: Mapping[str, float], pressures: float) -> float:
    """Return the dry friction at speed, in the worse direction, N.

    What every name of it has: of a seal whose rise near standstill is named in one recording and
    not in the next, a sum with that rise would jump by it.  ``found`` are parameters of
    the laws of dry friction, ``pressures`` is p1 + p2, Pa.
    """
    force = sum(found.get(f"{effect}.F_c", 0.0) for effect in DRY_LAWS)
    force += abs(found.get("asymmetric_friction.dF", 0.0))
    return force + found.get("pressure_friction.mu", 0.0) * pressures


def air_compliance(pressures: np.ndarray, exponent: float) -> float:
    """Return what a volume share of one of free air at ``P_ATM`` adds to 1/beta_e, 1/Pa.

    Mean of (1/(n p)) (p_atm/p)^(1/n) over the pressures, (m,) absolute, Pa.
    """
    return float(np.mean([_UNIT_AIR(float(p), 1.0, exponent) for p in pressures]))


def free_air(modulus: float, air_free: float, exponent: float, pressures: np.ndarray,
             at: float = P_ATM) -> float:
    """Return the volume share of free air at the absolute pressure ``at``.

    1/beta_e = 1/beta_oil + (alpha/(n p)) (p_atm/p)^(1/n): oil and air in parallel (Wood 1930 for
    the isothermal mixture; polytropic: Yu, Chen, Lu 1994; Gholizadeh, Burton, Schoenau 2011),
    for alpha well below one.  ``modulus`` and ``air_free`` are beta_e as found and as it is
    without free air, Pa; ``exponent`` is n.
    """
    share = (1.0 / modulus - 1.0 / air_free) / air_compliance(pressures, exponent)
    return moved(share, at, exponent)


def moved(share: float, at: float, exponent: float) -> float:
    """Return a share of air at ``P_ATM`` as that at the absolute pressure ``at``."""
    return share * (P_ATM / at) ** (1.0 / exponent)
