"""Each effect's term against its equation, written here a second time in numpy."""

import inspect

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from rig_tools import settings

from eha_monitor.physics import signals as s
from eha_monitor.physics.contributions import N_EFFECTS, N_THETA, add_contributions
from eha_monitor.physics.effects import CATALOGUE, NAMES
from eha_monitor.physics.parameters import place_of, theta_of

P_ATM = 101325.0


def coulomb(row, p):
    return {s.FORCE: p["F_c"] * np.tanh(row[s.V] / p["v_e"])}


def load(row, p):
    return {s.FORCE: p["F_0"]}


def leak(row, p):
    q = p["L"] * (row[s.P1] - row[s.P2])
    return {s.FLOW_1: -q, s.FLOW_2: q}


def air(row, p):
    # -dV/dp of V = alpha (p_atm/p)^(1/n), by a complex step instead of by hand.
    def softness(pressure):
        step = 1e-3j
        return -np.imag(p["alpha"] * (P_ATM / (pressure + step)) ** (1 / p["n"])) / 1e-3

    return {s.COMPLIANCE_1: softness(row[s.P1]), s.COMPLIANCE_2: softness(row[s.P2])}


ORACLES = {"coulomb_friction": (coulomb, {"F_c": 12.0, "v_e": 2e-3}),
           "constant_load": (load, {"F_0": -33.0}),
           "cross_port_leakage": (leak, {"L": 3e-12}),
           "entrained_air": (air, {"alpha": 0.013, "n": 1.3})}
BALANCE = {s.FORCE: "force", s.MASS: "force", s.SPEED: "flow", s.FLOW_1: "flow",
           s.FLOW_2: "flow", s.COMPLIANCE_1: "flow", s.COMPLIANCE_2: "flow",
           s.VOLUME_1: "flow", s.VOLUME_2: "flow"}


def contributions(row, effects):
    theta, active = theta_of(settings().rig, effects)
    c = np.full(s.N_CONTRIBUTIONS, 7.0)  # what was there before must not survive
    add_contributions(np.asarray(row, float), theta, active, c)
    return c


def signal_row(v=0.01, p1=2.3e6, p2=1.7e6):
    row = np.zeros(s.N_SIGNALS)
    row[[s.X, s.V, s.P1, s.P2, s.OMEGA]] = 0.01, v, p1, p2, 40.0
    return row


def test_every_entry_of_the_catalogue_has_its_own_equation_here():
    assert set(ORACLES) == set(CATALOGUE), "a new effect needs its oracle in this file"


@pytest.mark.parametrize("name", sorted(ORACLES))
@given(v=st.floats(-0.5, 0.5), p1=st.floats(2e5, 2e7), p2=st.floats(2e5, 2e7))
@hypothesis_settings(max_examples=50, deadline=None)
def test_term_is_its_equation(name, v, p1, p2):
    formula, values = ORACLES[name]
    row = signal_row(v, p1, p2)
    expected = np.zeros(s.N_CONTRIBUTIONS)
    for place, value in formula(row, values).items():
        expected[place] = value
    assert contributions(row, {name: values}) == pytest.approx(expected, rel=1e-9, abs=1e-25)


@pytest.mark.parametrize("name", sorted(ORACLES))
def test_term_is_smooth_in_every_signal(name):
    """Halving the step of a central difference changes the slope by the square of the step."""
    values = ORACLES[name][1]
    for row in (signal_row(), signal_row(v=0.0), signal_row(v=-3e-3, p1=4e5, p2=9e6)):
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


def test_slope_of_coulomb_friction_at_rest_is_finite():
    c = contributions(signal_row(v=1e-9), {"coulomb_friction": {"F_c": 10.0, "v_e": 1e-3}})
    assert c[s.FORCE] == pytest.approx(10.0 * 1e-6)


def test_only_active_effects_contribute():
    theta, _ = theta_of(settings().rig, {name: values for name, (_, values) in ORACLES.items()})
    row, c = signal_row(), np.empty(s.N_CONTRIBUTIONS)
    add_contributions(row, theta, np.zeros(N_EFFECTS, dtype=bool), c)
    assert not c.any()
    total = np.zeros(s.N_CONTRIBUTIONS)
    for i, name in enumerate(NAMES):
        one = np.arange(N_EFFECTS) == i
        add_contributions(row, theta, one, c)
        touched = {BALANCE[place] for place in np.flatnonzero(c)}
        assert touched == {CATALOGUE[name].balance}
        total += c
    add_contributions(row, theta, np.ones(N_EFFECTS, dtype=bool), c)
    assert c == pytest.approx(total, rel=1e-14)


def test_air_of_one_percent_agrees_with_the_design_page():
    """251, 543, 948 MPa at 5, 10, 20 bar: gauge pressures, n = 1.4 and an oil of 1.5 GPa.

    The page says "secant"; its figures are those of the tangent law, as here.
    """
    for bar, megapascal in ((5, 251), (10, 543), (20, 948)):
        row = signal_row(p1=bar * 1e5 + P_ATM)
        c = contributions(row, {"entrained_air": {"alpha": 0.01, "n": 1.4}})
        assert 1e-6 / (1 / 1.5e9 + c[s.COMPLIANCE_1]) == pytest.approx(megapascal, rel=0.005)


def test_air_stays_finite_where_the_pressure_is_lost():
    for pressure in (0.0, -1e6):
        c = contributions(signal_row(p1=pressure), {"entrained_air": {"alpha": 0.01, "n": 1.4}})
        assert np.isfinite(c).all() and c[s.COMPLIANCE_1] > 0


@pytest.mark.parametrize("effect", CATALOGUE.values(), ids=lambda effect: effect.name)
def test_entry_describes_itself(effect):
    assert effect.balance in ("force", "flow", "drive", "sensor")
    assert len(effect.parameters) <= s.MAX_PARAMETERS
    values = {p.name: p.scale for p in effect.parameters}
    sentence = effect.statement.format(**values)
    assert "{" not in sentence and len(sentence) > 10
    for p in effect.parameters:
        assert p.lower < p.upper and p.scale > 0
        assert p.name in effect.equation.replace("+", " ")
    assert effect.source and effect.rig_check.endswith(".")
    assert list(inspect.signature(effect.term.py_func).parameters) == ["s", "p", "c"]


def test_parameter_vector_has_one_place_for_each_value():
    places = [place_of(key) for key in ("area_1", "area_2", "volume_1", "volume_2", "mass",
                                        "viscous_damping", "bulk_modulus", "leakage",
                                        "pump_displacement", "position_gain",
                                        "charge_pressure", "makeup_conductance")]
    places += [place_of(f"{name}.{p.name}") for name, effect in CATALOGUE.items()
               for p in effect.parameters]
    assert len(set(places)) == len(places) and max(places) < N_THETA
    theta, active = theta_of(settings(rig={"mass": 33.0, "volume_1": None}).rig,
                             {"constant_load": {"F_0": 5.0}})
    assert theta[place_of("mass")] == 33.0 and np.isnan(theta[place_of("volume_1")])
    assert theta[place_of("constant_load.F_0")] == 5.0
    assert [NAMES[i] for i in np.flatnonzero(active)] == ["constant_load"]
