"""Each entry of the catalogue against its equation, written here a second time in numpy."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from rig_tools import settings

from eha_monitor.physics import signals as s
from eha_monitor.physics.contributions import (
    N_EFFECTS,
    add_contributions,
    circuit_of,
    new_memory,
    update_memory,
    with_term,
    with_update,
)
from eha_monitor.physics.effects import CATALOGUE, NAMES
from eha_monitor.physics.parameters import theta_of

P_ATM = 101325.0
CONTRACT = {  # the table of the interface contract
    "force": "coulomb_friction stribeck_friction quadratic_friction asymmetric_friction "
             "pressure_friction presliding_friction constant_load spring_load contact_spring "
             "added_mass backlash",
    "flow": "cross_port_leakage turbulent_leakage leakage_offset external_leakage relief_valve "
            "entrained_air position_dependent_volume pump_dead_zone pump_flow_gain "
            "pump_volumetric_loss line_dynamics anti_cavitation",
    "drive": "drive_lag drive_saturation drive_gain command_delay feedback_delay",
    "sensor": "position_delay pressure_delay position_scale pressure_offset pressure_scale "
              "pressure_drift position_quantisation"}


def across(q):
    return {s.FLOW_1: -q, s.FLOW_2: q}


def air(r, p):
    # -dV/dp of V = alpha (p_atm/p)^(1/n), by a complex step instead of by hand.
    def softness(pressure):
        return -np.imag(p["alpha"] * (P_ATM / (pressure + 1e-3j)) ** (1 / p["n"])) / 1e-3

    return {s.COMPLIANCE_1: softness(r.p1), s.COMPLIANCE_2: softness(r.p2)}


class Row:
    """The signals by name."""

    def __init__(self, row):
        self.x, self.v, self.p1, self.p2 = row[[s.X, s.V, s.P1, s.P2]]
        self.dp, self.omega = self.p1 - self.p2, row[s.OMEGA]


def seal(r, p, steady, z):
    """Dahl's element from rest at x = 0 that has come to x, and LuGre's micro damping in it.

    With f = steady (1 - e^(-|x|/z)) the rate is f' = |v| (steady - f) / z.
    """
    if z == 0:
        return {s.FORCE: steady}
    rest = steady * np.exp(-np.abs(r.x) / z)
    damping = p["t_1"] * np.exp(-((r.v / p["v_d"]) ** 2))
    return {s.FORCE: steady - rest + damping * np.abs(r.v) / max(z, 1e-6) * rest}


def sense(r, p):
    """Return the sign of the velocity, smoothed: a tanh, and a share w of a slower one."""
    return (1 - p["w"]) * np.tanh(r.v / p["v_e"]) + p["w"] / (p["v_e"] + np.abs(r.v)) * r.v


def stribeck(r, p):
    fall = np.exp(-np.exp(p["delta"] * np.log(max(abs(r.v), 1e-99) / p["v_s"])))
    tail = p["v_s"] ** 2 / (p["v_s"] ** 2 + r.v**2)
    g = p["F_c"] + p["F_d"] * ((1 - p["h"]) * fall + p["h"] * tail)
    return seal(r, p, g * sense(r, p), p["z_0"] * g / (p["F_c"] + p["F_d"]))


def asymmetric(r, p):
    forwards = r.v > 0 or (r.v == 0 and not np.signbit(r.v))
    level = p["F_c"] + p["dF"] if forwards else p["F_c"] - p["dF"]
    found = seal(r, p, level * sense(r, p),
                 p["z_0"] * level / max(p["F_c"] + p["dF"], p["F_c"] - p["dF"]))
    return {s.FORCE: found[s.FORCE] + p["dB"] * np.hypot(r.v, 0)}


# Terms of a motion with a new memory; z_0 = 0: the sign turns at once.
TERMS = {
    "coulomb_friction": (
        lambda r, p: seal(r, p, p["F_c"] * sense(r, p), p["z_0"]),
        {"F_c": 12.0, "v_e": 2e-3, "z_0": 1e-5, "t_1": 2e-4, "v_d": 0.1,
         "w": 0.3}),
    "presliding_friction": (
        lambda r, p: seal(r, p, p["F_c"] * sense(r, p), p["z_0"]),
        {"F_c": 12.0, "v_e": 2e-3, "z_0": 9e-4, "t_1": 0.0, "v_d": 5e-3,
         "w": 0.0}),
    "stribeck_friction": (
        stribeck, {"F_c": 7.0, "F_d": 11.0, "v_s": 4e-3, "v_e": 1e-3, "z_0": 9e-6, "t_1": 1e-4,
                   "v_d": 0.05, "delta": 0.8, "w": 0.6,
                   "h": 0.4}),
    "quadratic_friction": (
        lambda r, p: {s.FORCE: p["a_1"] * np.sign(r.v) * r.v**2}, {"a_1": 8000.0}),
    "asymmetric_friction": (
        asymmetric, {"F_c": 9.0, "dF": -5.0, "dB": -70.0, "v_e": 1e-3, "z_0": 9e-6, "t_1": 1e-4,
                     "v_d": 0.05, "w": 1.0}),
    "pressure_friction": (
        lambda r, p: seal(r, p, p["mu"] * (r.p1 + r.p2) * sense(r, p), p["z_0"]),
        {"mu": 3e-6, "v_e": 1e-3, "z_0": 0.0, "t_1": 1e-4, "v_d": 5e-3, "w": 0.5}),
    "constant_load": (lambda r, p: {s.FORCE: p["F_0"]}, {"F_0": -33.0}),
    "spring_load": (lambda r, p: {s.FORCE: p["k"] * r.x - p["k"] * p["x_0"]},
                    {"k": 900.0, "x_0": 0.004}),
    "contact_spring": (lambda r, p: {s.FORCE: p["k"] * min(r.x - p["x_c"], 0.0)},
                       {"k": 4e4, "x_c": 0.01, "side": -1.0}),
    "added_mass": (lambda r, p: {s.MASS: p["dM"]}, {"dM": 6.0}),
    "cross_port_leakage": (lambda r, p: across(p["L"] * r.dp), {"L": 3e-12}),
    "turbulent_leakage": (
        lambda r, p: across(p["c"] * np.sign(r.dp) * np.sqrt(np.abs(r.dp))
                            / (1 + (p["dp_0"] / max(abs(r.dp), 1e-60)) ** 2) ** 0.25),
        {"c": 4e-9, "dp_0": 2e4}),
    "leakage_offset": (lambda r, p: across(p["Q_0"] * np.tanh(r.dp / p["dp_e"])),
                       {"Q_0": 1e-6, "dp_e": 1e5}),
    "external_leakage": (
        lambda r, p: {s.FLOW_1: -p["L_1"] * (r.p1 - P_ATM),
                      s.FLOW_2: -p["L_2"] * (r.p2 - P_ATM)},
        {"L_1": 1e-12, "L_2": 3e-13}),
    "relief_valve": (
        lambda r, p: across(p["k"] * np.sign(r.dp) * np.where(
            np.abs(r.dp) > p["p_c"], np.abs(r.dp) - p["p_c"], 0)), {"k": 2e-11, "p_c": 5e5}),
    "entrained_air": (air, {"alpha": 0.013, "n": 1.3}),
    "position_dependent_volume": (
        lambda r, p: {s.VOLUME_1: p["A_v"] * r.x, s.VOLUME_2: -p["r"] * p["A_v"] * r.x},
        {"A_v": 5e-4, "r": 0.6}),
    "pump_dead_zone": (
        lambda r, p: {s.SPEED: np.sign(r.omega) * max(abs(r.omega) - p["omega_0"], 0) - r.omega},
        {"omega_0": 8.0}),
    "pump_flow_gain": (lambda r, p: {s.SPEED: p["k"] * r.omega}, {"k": -0.08}),
    "pump_volumetric_loss": (lambda r, p: {s.SPEED: -p["k"] * np.abs(r.omega) * r.dp},
                             {"k": 2e-8, "motoring": 1.0}),
    "line_dynamics": (lambda r, p: {}, {"T_l": 2e-3, "zeta": 0.2, "Z": 12e3}),  # at rest so far
    "anti_cavitation": (
        lambda r, p: {s.FLOW_1: p["k"] * np.clip(p["p_min"] - r.p1, 0, None),
                      s.FLOW_2: p["k"] * np.clip(p["p_min"] - r.p2, 0, None)},
        {"k": 1e-11, "p_min": 5e5}),
}
CIRCUITS = {
    "backlash": ({"b": 2e-4, "in_loop": 1.0}, {s.PLAY: 2e-4, s.IN_LOOP: 1.0}),
    "drive_lag": ({"tau": 4e-3}, {s.DRIVE_LAG: 4e-3}),
    "drive_saturation": ({"omega_max": 200.0, "slew": 3e3},
                         {s.SPEED_LIMIT: 200.0, s.SLEW_LIMIT: 3e3}),
    "drive_gain": ({"k": -0.03}, {s.DRIVE_GAIN: -0.03}),
    "command_delay": ({"T": 2e-3}, {s.COMMAND_DELAY: 2e-3}),
    "feedback_delay": ({"T": 3e-3}, {s.FEEDBACK_DELAY: 3e-3}),
    "position_delay": ({"T": 4e-3}, {s.POSITION_DELAY: 4e-3}),
    "pressure_delay": ({"T": 5e-3}, {s.PRESSURE_DELAY: 5e-3}),
    "position_scale": ({"k": 0.03, "in_loop": 1.0}, {s.POSITION_SCALE: 0.03, s.IN_LOOP: 1.0}),
    "pressure_offset": ({"b_1": 4e4, "b_2": -1e4},
                        {s.PRESSURE_OFFSET_1: 4e4, s.PRESSURE_OFFSET_2: -1e4}),
    "pressure_scale": ({"k_1": 0.08, "k_2": -0.02},
                       {s.PRESSURE_SCALE_1: 0.08, s.PRESSURE_SCALE_2: -0.02}),
    "pressure_drift": ({"d_1": 1e3, "d_2": -2e3},
                       {s.PRESSURE_DRIFT_1: 1e3, s.PRESSURE_DRIFT_2: -2e3}),
    "position_quantisation": ({"q": 1e-5}, {}),
}
VALUES = {**{name: values for name, (_, values) in TERMS.items()},
          **{name: values for name, (values, _) in CIRCUITS.items()}}
BALANCE = {s.FORCE: "force", s.MASS: "force", s.SPEED: "flow", s.FLOW_1: "flow",
           s.FLOW_2: "flow", s.COMPLIANCE_1: "flow", s.COMPLIANCE_2: "flow",
           s.VOLUME_1: "flow", s.VOLUME_2: "flow"}


def contributions(row, effects, memory=None):
    theta, active = theta_of(settings().rig, effects)
    c = np.full(s.N_CONTRIBUTIONS, 7.0)  # what was there before must not survive
    add_contributions(np.asarray(row, float), theta, with_term(active),
                      new_memory() if memory is None else memory, c)
    return c


def signal_row(v=0.01, p1=2.3e6, p2=1.7e6, x=0.01, omega=40.0):
    row = np.zeros(s.N_SIGNALS)
    row[[s.X, s.V, s.P1, s.P2, s.OMEGA]] = x, v, p1, p2, omega
    return row


def neutral_circuit():
    w = np.zeros(s.N_CIRCUIT)
    w[list(s.LIMITS)] = np.inf
    return w


def test_catalogue_is_the_contract_s_and_each_entry_has_its_equation_here():
    where = "docs/effects.md, An entry of the catalogue, says what else"
    assert set(VALUES) == set(CATALOGUE), f"a new effect needs TERMS or CIRCUITS here; {where}"
    assert {name: effect.balance for name, effect in CATALOGUE.items()} == {
        name: balance for balance, names in CONTRACT.items() for name in names.split()
    }, f"a new effect needs its balance in CONTRACT; {where}"
    for name, values in VALUES.items():
        assert list(values) == [p.name for p in CATALOGUE[name].parameters]


@pytest.mark.parametrize("name", sorted(TERMS))
@given(v=st.floats(-0.5, 0.5), p1=st.floats(2e5, 2e7), p2=st.floats(2e5, 2e7),
       x=st.one_of(st.floats(-0.1, 0.1), st.floats(-3e-5, 3e-5)), omega=st.floats(-400, 400))
@hypothesis_settings(max_examples=50)
def test_term_is_its_equation(name, v, p1, p2, x, omega):
    formula, values = TERMS[name]
    row = signal_row(v, p1, p2, x, omega)
    expected = np.zeros(s.N_CONTRIBUTIONS)
    for place, value in formula(Row(row), values).items():
        expected[place] = value
    scale = {s.FORCE: 1e-12, s.SPEED: 1e-9}
    for place, value in enumerate(contributions(row, {name: values})):
        assert value == pytest.approx(expected[place], rel=1e-9, abs=scale.get(place, 1e-22))


@pytest.mark.parametrize("name", sorted(CIRCUITS))
def test_circuit_is_its_constants(name):
    values, changed = CIRCUITS[name]
    expected = neutral_circuit()
    expected[list(changed)] = list(changed.values())
    assert np.array_equal(circuit_of(*theta_of(settings().rig, {name: values})), expected)


@pytest.mark.parametrize("name", sorted(TERMS))
def test_term_is_smooth_in_every_signal(name):
    """Halving the step of a central difference changes the slope by the square of the step."""
    values = VALUES[name]
    for row in (signal_row(), signal_row(v=2e-5), signal_row(v=-3e-3, p1=4e5, p2=9e6)):
        for place, h in ((s.X, 1e-6), (s.V, 1e-6), (s.P1, 50.0), (s.P2, 50.0),
                         (s.OMEGA, 1e-3)):
            slopes = []
            for step in (h, h / 2):
                ahead, behind = row.copy(), row.copy()
                ahead[place] += step
                behind[place] -= step
                slopes.append((contributions(ahead, {name: values})
                               - contributions(behind, {name: values})) / (2 * step))
            scale = np.abs(contributions(row, {name: values})).max() / h
            assert slopes[0] == pytest.approx(slopes[1], rel=1e-4, abs=1e-5 * scale + 1e-30)


@given(numbers=st.tuples(*[st.floats(-big, big) for big in (1e3, 1e4, 1e12, 1e12, 1e6)]),
       past=st.tuples(st.floats(-1, 1), st.floats(-1e3, 1e3)), h=st.floats(1e-9, 1.0))
@hypothesis_settings(max_examples=200)
def test_all_terms_stay_finite_whatever_the_signals(numbers, past, h):
    x, v, p1, p2, omega = numbers
    theta, active = theta_of(settings().rig, VALUES)
    memory = new_memory()
    memory[:] = past
    row, c = signal_row(v, p1, p2, x, omega), np.empty(s.N_CONTRIBUTIONS)
    for _ in range(2):
        add_contributions(row, theta, with_term(active), memory, c)
        assert np.isfinite(c).all()
        update_memory(row, theta, with_update(active, theta), h, memory)
        assert np.isfinite(memory).all()


@pytest.mark.parametrize("name", sorted(CATALOGUE))
def test_effect_is_linear_in_its_sizes_and_absent_without(name):
    sizes = {p.name: p.neutral for p in CATALOGUE[name].sizes}
    row = signal_row()
    absent = theta_of(settings().rig, {name: {**VALUES[name], **sizes}})
    assert not contributions(row, {name: {**VALUES[name], **sizes}}).any()
    w = circuit_of(*absent)
    w[s.IN_LOOP] = 0.0  # where the drive reads does not matter without an error
    assert np.array_equal(w, neutral_circuit())
    if math.isinf(max(sizes.values())):
        return  # limits
    twice = {**VALUES[name], **{key: 2 * VALUES[name][key] for key in sizes}}
    assert contributions(row, {name: twice}) == pytest.approx(
        2 * contributions(row, {name: VALUES[name]}), rel=1e-12)
    once, double = (circuit_of(*theta_of(settings().rig, {name: values}))
                    for values in (VALUES[name], twice))
    errors = [i for i in range(s.N_CIRCUIT) if i not in (*s.LIMITS, s.IN_LOOP)]
    assert double[errors] == pytest.approx(2 * once[errors])


def test_only_active_effects_contribute():
    theta, _ = theta_of(settings().rig, VALUES)
    row, c, total = signal_row(), np.empty(s.N_CONTRIBUTIONS), np.zeros(s.N_CONTRIBUTIONS)
    add_contributions(row, theta, with_term(np.zeros(N_EFFECTS, dtype=bool)), new_memory(), c)
    assert not c.any()
    for i, name in enumerate(NAMES):
        add_contributions(row, theta, with_term(np.arange(N_EFFECTS) == i), new_memory(), c)
        touched = {BALANCE[place] for place in np.flatnonzero(c)}
        assert touched <= {CATALOGUE[name].balance}
        total += c
    add_contributions(row, theta, with_term(np.ones(N_EFFECTS, dtype=bool)), new_memory(), c)
    assert c == pytest.approx(total, rel=1e-14)


def test_errors_of_several_effects_add_up_and_the_lower_limit_holds():
    effects = {**{name: CIRCUITS[name][0] for name in ("backlash", "position_scale")},
               "drive_saturation": {"omega_max": 150.0, "slew": 1e9}}
    w = circuit_of(*theta_of(settings().rig, effects))
    assert (w[s.PLAY], w[s.POSITION_SCALE]) == (2e-4, 0.03)
    assert w[s.SPEED_LIMIT] == 150.0 and w[s.SLEW_LIMIT] == np.inf  # at its bound: no limit


def test_pump_loss_takes_energy_in_all_quadrants_unless_asked_otherwise():
    for omega in (90.0, -90.0):
        for dp in (4e5, -4e5):
            row = signal_row(p1=2e6 + dp, p2=2e6, omega=omega)
            lost = -contributions(row, {"pump_volumetric_loss": VALUES["pump_volumetric_loss"]})
            assert lost[s.SPEED] * dp > 0  # from the high to the low side
            by_efficiency = {"k": 2e-8, "motoring": -1.0}
            c = contributions(row, {"pump_volumetric_loss": by_efficiency})
            assert c[s.SPEED] == pytest.approx(-omega * 2e-8 * 4e5)


def test_air_of_one_percent_agrees_with_the_design_page():
    """251, 543, 948 MPa at 5, 10, 20 bar: gauge pressures, n = 1.4 and an oil of 1.5 GPa.

    The page says "secant"; its figures are those of the tangent law, as here.
    """
    for bar, megapascal in ((5, 251), (10, 543), (20, 948)):
        row = signal_row(p1=bar * 1e5 + P_ATM)
        c = contributions(row, {"entrained_air": {"alpha": 0.01, "n": 1.4}})
        assert 1e-6 / (1 / 1.5e9 + c[s.COMPLIANCE_1]) == pytest.approx(megapascal, rel=0.005)
