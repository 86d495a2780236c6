"""What can be hidden: each effect by name, its size at full strength, its place in the plant.

Names of parameters are those of the catalogue, so that a key can be compared; the equations are
the plant's own.  An entry turns (size, options, reach) into constants of the plant or of the
sensors, and into the key's parameters.  ``size`` is the strength, negative for the opposite sign
where there is one; ``options`` may set any parameter of the key outright; ``reach`` is what the
motion needs on this rig without the thresholded effects.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

from eha_monitor.concealed.plant import ATMOSPHERE

CATALOGUE_BALANCES = {
    "force": ("coulomb_friction", "stribeck_friction", "quadratic_friction",
              "asymmetric_friction", "pressure_friction", "presliding_friction", "constant_load",
              "spring_load", "contact_spring", "added_mass", "backlash"),
    "flow": ("cross_port_leakage", "turbulent_leakage", "leakage_offset", "external_leakage",
             "relief_valve", "entrained_air", "position_dependent_volume", "pump_dead_zone",
             "pump_flow_gain", "pump_volumetric_loss", "line_dynamics", "anti_cavitation"),
    "drive": ("drive_lag", "drive_saturation", "drive_gain", "command_delay", "feedback_delay"),
    "sensor": ("position_delay", "pressure_delay", "position_scale", "pressure_offset",
               "pressure_scale", "pressure_drift", "position_quantisation"),
}
# Outside the catalogue of the diagnosis: the right answer is "unexplained", at this balance.
OUTSIDE_BALANCES = {
    "force": ("position_friction_hump", "sticking_place", "gapped_load", "lever_load",
              "end_cushion"),
    "flow": ("sticking_check_valve", "pump_ripple", "position_dependent_leak", "widening_gap"),
}


@dataclass(frozen=True)
class Reach:
    """What a motion needs: shaft speed rad/s, pressure difference Pa, lowest pressure Pa."""

    speed: float = 0.0
    pressure_difference: float = 0.0
    lowest_pressure: float = 0.0


@dataclass
class Hidden:
    """One effect made concrete: changed constants and the key's parameters, all SI."""

    plant: dict[str, float] = field(default_factory=dict)
    added: dict[str, float] = field(default_factory=dict)  # onto the rig's own constant
    sensors: dict[str, float] = field(default_factory=dict)
    parameters: dict[str, float | str] = field(default_factory=dict)


@dataclass(frozen=True)
class Context:
    """What an entry may look at."""

    size: float
    options: dict
    rig: dict[str, float]
    reach: Reach

    def take(self, name: str, default):
        """Return the option ``name`` or, without one, ``default``."""
        return self.options.get(name, default)


# Effects whose threshold is set from the reach of the same case without them.
THRESHOLDED = ("relief_valve", "anti_cavitation", "drive_saturation")
SIGNED = ("constant_load", "cross_port_leakage", "pump_flow_gain", "drive_gain",
          "position_scale", "pressure_offset", "pressure_scale", "pressure_drift",
          "asymmetric_friction")


Size = float | Callable[[Context], float]  # as it is at every strength, or by the case


def full(size: float) -> Callable[[Context], float]:
    """Return a size that goes with the strength."""
    return lambda c: size * c.size


def _sets(where: str = "plant", **symbols: tuple[str, Size]) -> Callable:
    """Return an entry of parameters that are one constant each: symbol -> (its place, size)."""
    def build(c: Context) -> Hidden:
        parameters = {name: c.take(name, size(c) if callable(size) else size)
                      for name, (_, size) in symbols.items()}
        return Hidden(parameters=parameters, **{where: {
            place: parameters[name] for name, (place, _) in symbols.items()}})
    return build


def _coulomb(c: Context) -> Hidden:
    force = c.take("F_c", 40.0 * c.size)
    return Hidden(added={"seal_forward": force, "seal_backward": force}, parameters={"F_c": force})


def _stribeck(c: Context) -> Hidden:
    kinetic = c.take("F_c", 40.0 * c.size)
    drop = c.take("F_d", 40.0 * c.size)
    speed = c.take("v_s", 8e-3)
    return Hidden(
        added={"seal_forward": kinetic, "seal_backward": kinetic, "seal_static": drop},
        plant={"stribeck_speed": speed},
        parameters={"F_c": kinetic, "F_d": drop, "F_s": kinetic + drop, "v_s": speed})


def _asymmetric(c: Context) -> Hidden:
    # Dry friction is never negative, so the difference by direction comes with its mean.
    mean, half = c.take("F_c", 25.0 * abs(c.size)), c.take("dF", 15.0 * c.size)
    more, damping = c.take("dB", 100.0 * c.size), c.rig["damping"]
    return Hidden(
        added={"seal_forward": mean + half, "seal_backward": mean - half},
        plant={"damping_asymmetry": more},
        parameters={"F_c": mean, "dF": half, "dB": more, "F_c_forward": mean + half,
                    "F_c_backward": mean - half, "B_forward": damping + more,
                    "B_backward": damping - more})


def _backlash(c: Context) -> Hidden:
    gap, in_loop = c.take("b", 2e-4 * c.size), c.take("in_loop", False)
    return Hidden(plant={"play": gap, "play_in_loop": float(in_loop)},
                  sensors={"behind_play": 1.0},
                  parameters={"b": gap, "in_loop": float(in_loop)})


def _cross_port(c: Context) -> Hidden:
    # 8 times C_T at full strength; flow L dp, so C_T/2 dp grows by 8 C_T/2 dp.
    more = c.take("L", 4.0 * c.rig["leakage"] * c.size)
    return Hidden(added={"leakage": 2.0 * more}, parameters={"L": more})


def _line(c: Context) -> Hidden:
    # Two lines of 3 m and 6 mm bore, half of one's oil at the pump; shorter at less strength.
    inertance = c.take("I", 1.8e8 * c.size)
    resistance = c.take("R", 5.6e9 * c.size)
    volume = c.take("volume", 4.2e-5 * c.size)
    stiffness = 2.0 * c.rig["bulk_modulus"] / volume  # of the oil at the pump
    natural = (stiffness / inertance) ** 0.5
    return Hidden(
        plant={"line_inertance": inertance, "line_resistance": resistance, "line_volume": volume},
        parameters={"I": inertance, "R": resistance, "volume": volume,
                    "T_l": 1.0 / natural, "zeta": 0.5 * resistance / inertance / natural,
                    "Z": c.rig["displacement"] * inertance * natural})


def _drive_gain(c: Context) -> Hidden:
    gain = c.take("k", -0.08 * c.size)
    return Hidden(plant={"position_gain": c.rig["position_gain"] * (1.0 + gain)},
                  parameters={"k": gain})


def _pressure(kind: str, symbol: str, full: float) -> Callable:
    """Return an entry of one pressure sensor or, with ``sensor`` "both", of the two."""
    def build(c: Context) -> Hidden:
        sensor = c.take("sensor", "p1")
        values = {i: c.take(f"{symbol}_{i}", full * c.size if sensor in (f"p{i}", "both") else 0.0)
                  for i in (1, 2)}
        return Hidden(sensors={f"{kind}_p{i}": value for i, value in values.items()},
                      parameters={f"{symbol}_{i}": value for i, value in values.items()})
    return build


def _external(c: Context) -> Hidden:
    chamber = c.take("chamber", "both")
    leaks = {i: c.take(f"L_{i}", 5e-14 * c.size if chamber in (i, "both") else 0.0)
             for i in (1, 2)}
    tank = c.take("p_tank", ATMOSPHERE)  # absolute
    return Hidden(
        plant={"external_leakage_1": leaks[1], "external_leakage_2": leaks[2], "tank": tank},
        parameters={"L_1": leaks[1], "L_2": leaks[2], "p_tank": tank})


ENTRIES: dict[str, Callable[[Context], Hidden]] = {
    "coulomb_friction": _coulomb,
    "stribeck_friction": _stribeck,
    "quadratic_friction": _sets(a_1=("quadratic", full(8000.0))),
    "asymmetric_friction": _asymmetric,
    "pressure_friction": _sets(mu=("seal_per_pressure", full(1e-5))),
    "presliding_friction": _sets(F_c=("soft_seal", full(40.0)), z_0=("soft_travel", 50e-6)),
    "constant_load": _sets(F_0=("constant_load", full(40.0))),
    "spring_load": _sets(k=("stiffness", full(8000.0))),
    "contact_spring": _sets(k=("contact", full(2e4)), x_c=("contact_place", 4e-3)),
    "added_mass": _sets("added", dM=("mass", full(6.0))),
    "backlash": _backlash,
    "cross_port_leakage": _cross_port,
    "turbulent_leakage": _sets(c=("turbulent", full(3e-9))),
    "leakage_offset": _sets(Q_0=("leakage_offset", full(1e-6))),
    "external_leakage": _external,
    "relief_valve": _sets(
        p_c=("relief_pressure", lambda c: c.reach.pressure_difference * (1.0 - 0.4 * c.size)),
        k=("relief_gain", 3e-11)),
    "entrained_air": _sets(alpha=("air_fraction", full(0.02)), n=("air_exponent", 1.4)),
    "position_dependent_volume": _sets(A_v=("volume_slope", lambda c: c.rig["area"] * c.size)),
    "pump_dead_zone": _sets(omega_0=("dead_zone", full(8.0))),
    "pump_flow_gain": _sets(k=("pump_gain", full(-0.08))),
    "pump_volumetric_loss": _sets(k=("pump_loss", full(3e-7))),
    "line_dynamics": _line,
    "anti_cavitation": _sets(
        p_min=("check_pressure", lambda c: c.reach.lowest_pressure + 0.5 * c.size * (
            c.rig["charge_pressure"] - c.reach.lowest_pressure)),
        k=("check_gain", 3e-11)),
    "drive_lag": _sets(tau=("drive_lag", full(4e-3))),
    "drive_saturation": _sets(
        omega_max=("speed_limit", lambda c: c.reach.speed * (1.0 - 0.15 * c.size))),
    "drive_gain": _drive_gain,
    "command_delay": _sets("sensors", T=("command_delay", full(4e-3))),
    "feedback_delay": _sets(T=("feedback_delay", full(2e-3))),
    "position_delay": _sets("sensors", T=("position_delay", full(2e-3))),
    "pressure_delay": _sets("sensors", T=("pressure_delay", full(2e-3))),
    "position_scale": _sets("sensors", k=("position_scale", full(0.03))),
    "pressure_offset": _pressure("offset", "b", 4e4),
    "pressure_scale": _pressure("scale", "k", 0.08),
    "pressure_drift": _pressure("drift", "d", 3e3),
    "position_quantisation": _sets("sensors", q=("resolution", full(20e-6))),
    "position_friction_hump": _sets(F=("hump_force", full(60.0)), x=("hump_place", 6e-3),
                                    width=("hump_width", 4e-3)),
    "sticking_place": _sets(F=("stick_force", full(150.0)), x=("stick_place", 3e-3),
                            width=("stick_width", 8e-4)),
    "gapped_load": _sets(M=("gapped_mass", full(6.0)), gap=("gapped_play", 6e-4)),
    "sticking_check_valve": _sets(
        k=("sticky_gain", full(1e-11)),
        p_open=("sticky_open", lambda c: (
            c.rig["charge_pressure"] - 0.15 * c.reach.pressure_difference)),
        p_close=("sticky_close", lambda c: (
            c.rig["charge_pressure"] + 0.15 * c.reach.pressure_difference))),
    "pump_ripple": _sets(a=("ripple", full(0.06)), order=("ripple_order", 7.0)),
    "position_dependent_leak": _sets(
        L=("place_leak", lambda c: 20.0 * c.rig["leakage"] * c.size),
        x=("place_leak_place", 4e-3), width=("place_leak_width", 4e-3)),
    # A sine of the stroke (Jelali and Kroll, Hydraulic Servo-systems).
    "lever_load": _sets(F=("lever_load", full(60.0)), length=("lever_length", 30e-3)),
    # Damping that rises toward the ends (Merritt, Hydraulic Control Systems: end cushioning).
    "end_cushion": _sets(d=("cushion", full(9e4)), x=("cushion_place", 5e-3)),
    # Gap widened by its own pressure (Ivantysyn and Ivantysynova, Hydrostatic Pumps and Motors):
    # the flow goes with the cube of its height, and that here with the pressure.
    "widening_gap": _sets(L_3=("widening_gap", lambda c: (
        30.0 * c.rig["leakage"] * c.size / 4e5**2))),
}
