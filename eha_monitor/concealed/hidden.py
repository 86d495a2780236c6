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
              "spring_load", "added_mass", "backlash"),
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


def _plain(mapping: dict[str, tuple[str, float]], **fixed: float) -> Callable:
    """Return an entry whose parameters are sizes times the strength, each one constant."""
    def build(c: Context) -> Hidden:
        parameters = {name: c.take(name, full * c.size) for name, (_, full) in mapping.items()}
        values = {place: parameters[name] for name, (place, _) in mapping.items()}
        return Hidden(plant={**values, **fixed}, parameters=parameters)
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


def _presliding(c: Context) -> Hidden:
    force, travel = c.take("F_c", 40.0 * c.size), c.take("z_0", 50e-6)
    return Hidden(plant={"soft_seal": force, "soft_travel": travel},
                  parameters={"F_c": force, "z_0": travel})


def _mass(c: Context) -> Hidden:
    more = c.take("dM", 6.0 * c.size)
    return Hidden(added={"mass": more}, parameters={"dM": more})


def _backlash(c: Context) -> Hidden:
    gap, in_loop = c.take("b", 2e-4 * c.size), c.take("in_loop", False)
    return Hidden(plant={"play": gap, "play_in_loop": float(in_loop)},
                  sensors={"behind_play": 1.0},
                  parameters={"b": gap, "in_loop": float(in_loop)})


def _cross_port(c: Context) -> Hidden:
    # 8 times C_T at full strength; flow L dp, so C_T/2 dp grows by 8 C_T/2 dp.
    more = c.take("L", 4.0 * c.rig["leakage"] * c.size)
    return Hidden(added={"leakage": 2.0 * more}, parameters={"L": more})


def _relief(c: Context) -> Hidden:
    highest = c.reach.pressure_difference
    opens = c.take("p_c", highest * (1.0 - 0.4 * c.size))
    gain = c.take("k", 3e-11)
    return Hidden(plant={"relief_pressure": opens, "relief_gain": gain},
                  parameters={"p_c": opens, "k": gain})


def _air(c: Context) -> Hidden:
    fraction, exponent = c.take("alpha", 0.02 * c.size), c.take("n", 1.4)
    return Hidden(plant={"air_fraction": fraction, "air_exponent": exponent},
                  parameters={"alpha": fraction, "n": exponent})


def _volume(c: Context) -> Hidden:
    area = c.take("A_v", c.rig["area"] * c.size)
    return Hidden(plant={"volume_slope": area}, parameters={"A_v": area})


def _loss(c: Context) -> Hidden:
    k = c.take("k", 3e-7 * c.size)
    return Hidden(plant={"pump_loss": k}, parameters={"k": k})


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
                    "T_l": 1.0 / natural, "zeta": 0.5 * resistance / inertance / natural})


def _check(c: Context) -> Hidden:
    low, charge = c.reach.lowest_pressure, c.rig["charge_pressure"]
    opens = c.take("p_min", low + 0.5 * c.size * (charge - low))
    gain = c.take("k", 3e-11)
    return Hidden(plant={"check_pressure": opens, "check_gain": gain},
                  parameters={"p_min": opens, "k": gain})


def _saturation(c: Context) -> Hidden:
    limit = c.take("omega_max", c.reach.speed * (1.0 - 0.15 * c.size))
    return Hidden(plant={"speed_limit": limit}, parameters={"omega_max": limit})


def _drive_gain(c: Context) -> Hidden:
    gain = c.take("k", -0.08 * c.size)
    return Hidden(plant={"position_gain": c.rig["position_gain"] * (1.0 + gain)},
                  parameters={"k": gain})


def _sensor(place: str, name: str, full: float) -> Callable:
    def build(c: Context) -> Hidden:
        value = c.take(name, full * c.size)
        return Hidden(sensors={place: value}, parameters={name: value})
    return build


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


def _hump(c: Context) -> Hidden:
    force, place, width = c.take("F", 60.0 * c.size), c.take("x", 6e-3), c.take("width", 4e-3)
    return Hidden(plant={"hump_force": force, "hump_place": place, "hump_width": width},
                  parameters={"F": force, "x": place, "width": width})


def _sticking_place(c: Context) -> Hidden:
    force, place, width = c.take("F", 150.0 * c.size), c.take("x", 3e-3), c.take("width", 8e-4)
    return Hidden(plant={"stick_force": force, "stick_place": place, "stick_width": width},
                  parameters={"F": force, "x": place, "width": width})


def _gapped(c: Context) -> Hidden:
    mass, gap = c.take("M", 6.0 * c.size), c.take("gap", 6e-4)
    return Hidden(plant={"gapped_mass": mass, "gapped_play": gap},
                  parameters={"M": mass, "gap": gap})


def _sticky_valve(c: Context) -> Hidden:
    charge = c.rig["charge_pressure"]
    reach = c.reach.pressure_difference
    opens = c.take("p_open", charge - 0.15 * reach)
    closes = c.take("p_close", charge + 0.15 * reach)
    gain = c.take("k", 1e-11 * c.size)
    return Hidden(plant={"sticky_gain": gain, "sticky_open": opens, "sticky_close": closes},
                  parameters={"k": gain, "p_open": opens, "p_close": closes})


def _ripple(c: Context) -> Hidden:
    part, order = c.take("a", 0.06 * c.size), c.take("order", 7.0)
    return Hidden(plant={"ripple": part, "ripple_order": order},
                  parameters={"a": part, "order": order})


def _place_leak(c: Context) -> Hidden:
    leak = c.take("L", 20.0 * c.rig["leakage"] * c.size)
    place, width = c.take("x", 4e-3), c.take("width", 4e-3)
    return Hidden(
        plant={"place_leak": leak, "place_leak_place": place, "place_leak_width": width},
        parameters={"L": leak, "x": place, "width": width})


def _lever(c: Context) -> Hidden:
    """Load of a lever: a sine of the stroke (Jelali and Kroll, Hydraulic Servo-systems)."""
    force, length = c.take("F", 60.0 * c.size), c.take("length", 30e-3)
    return Hidden(plant={"lever_load": force, "lever_length": length},
                  parameters={"F": force, "length": length})


def _cushion(c: Context) -> Hidden:
    """Damping that rises toward the ends (Merritt, Hydraulic Control Systems: end cushioning)."""
    rise, place = c.take("d", 9e4 * c.size), c.take("x", 5e-3)
    return Hidden(plant={"cushion": rise, "cushion_place": place},
                  parameters={"d": rise, "x": place})


def _widening(c: Context) -> Hidden:
    """Gap widened by its own pressure (Ivantysyn and Ivantysynova, Hydrostatic Pumps and Motors).

    The flow through a gap goes with the cube of its height, and that here with the pressure.
    """
    gain = c.take("L_3", 30.0 * c.rig["leakage"] * c.size / 4e5**2)
    return Hidden(plant={"widening_gap": gain}, parameters={"L_3": gain})


ENTRIES: dict[str, Callable[[Context], Hidden]] = {
    "coulomb_friction": _coulomb,
    "stribeck_friction": _stribeck,
    "quadratic_friction": _plain({"a_1": ("quadratic", 8000.0)}),
    "asymmetric_friction": _asymmetric,
    "pressure_friction": _plain({"mu": ("seal_per_pressure", 1e-5)}),
    "presliding_friction": _presliding,
    "constant_load": _plain({"F_0": ("constant_load", 40.0)}),
    "spring_load": _plain({"k": ("stiffness", 8000.0)}),
    "added_mass": _mass,
    "backlash": _backlash,
    "cross_port_leakage": _cross_port,
    "turbulent_leakage": _plain({"c": ("turbulent", 3e-9)}),
    "leakage_offset": _plain({"Q_0": ("leakage_offset", 1e-6)}),
    "external_leakage": _external,
    "relief_valve": _relief,
    "entrained_air": _air,
    "position_dependent_volume": _volume,
    "pump_dead_zone": _plain({"omega_0": ("dead_zone", 8.0)}),
    "pump_flow_gain": _plain({"k": ("pump_gain", -0.08)}),
    "pump_volumetric_loss": _loss,
    "line_dynamics": _line,
    "anti_cavitation": _check,
    "drive_lag": _plain({"tau": ("drive_lag", 4e-3)}),
    "drive_saturation": _saturation,
    "drive_gain": _drive_gain,
    "command_delay": _sensor("command_delay", "T", 4e-3),
    "feedback_delay": _plain({"T": ("feedback_delay", 2e-3)}),
    "position_delay": _sensor("position_delay", "T", 2e-3),
    "pressure_delay": _sensor("pressure_delay", "T", 2e-3),
    "position_scale": _sensor("position_scale", "k", 0.03),
    "pressure_offset": _pressure("offset", "b", 4e4),
    "pressure_scale": _pressure("scale", "k", 0.08),
    "pressure_drift": _pressure("drift", "d", 3e3),
    "position_quantisation": _sensor("resolution", "q", 20e-6),
    "position_friction_hump": _hump,
    "sticking_place": _sticking_place,
    "gapped_load": _gapped,
    "sticking_check_valve": _sticky_valve,
    "pump_ripple": _ripple,
    "position_dependent_leak": _place_leak,
    "lever_load": _lever,
    "end_cushion": _cushion,
    "widening_gap": _widening,
}
