"""The Modelica text, parsed and compiled by pymoca, against the compiled physics."""

import casadi as ca
import numpy as np
import pytest
from export_tools import CASES, FAST, demand, model_of, own_run
from pymoca import parser
from pymoca.backends.casadi import generator
from pymoca.backends.casadi.api import transfer_model
from rig_tools import T_S

from eha_monitor.exports.modelica import CONSTANTS, EFFECTS, WITHOUT, modelica_of
from eha_monitor.physics import signals as s
from eha_monitor.physics.balances import rates
from eha_monitor.physics.contributions import add_contributions, new_memory, with_term
from eha_monitor.physics.effects import CATALOGUE, NAMES
from eha_monitor.physics.parameters import theta_of

# pymoca 0.12 calls the division of CasADi by its name of Python 2.
generator.OP_MAP["/"] = "__truediv__"
# Values at which each effect of the plant does something in the range of the random states.
SIZES = {"added_mass": {"dM": 6.0}, "anti_cavitation": {"k": 1e-11, "p_min": 2.2e6},
         "asymmetric_friction": {"F_c": 20.0, "dF": 5.0, "dB": 40.0},
         "constant_load": {"F_0": 12.0}, "contact_spring": {"k": 9e3, "x_c": 0.01},
         "coulomb_friction": {"F_c": 40.0},
         "cross_port_leakage": {"L": 1e-12}, "entrained_air": {"alpha": 0.02},
         "external_leakage": {"L_1": 2e-13, "L_2": 1e-13}, "leakage_offset": {"Q_0": 1e-7},
         "line_dynamics": {"T_l": 2e-3}, "position_dependent_volume": {"A_v": 5e-4},
         "presliding_friction": {"F_c": 40.0, "z_0": 3e-5, "t_1": 1e-3},
         "pressure_friction": {"mu": 3e-6, "z_0": 4e-6},
         "pump_dead_zone": {"omega_0": 20.0}, "pump_flow_gain": {"k": 0.05},
         "pump_volumetric_loss": {"k": 1e-8}, "quadratic_friction": {"a_1": 8000.0},
         "relief_valve": {"k": 1e-11, "p_c": 2e5}, "spring_load": {"k": 900.0, "x_0": 0.01},
         "stribeck_friction": {"F_c": 30.0, "F_d": 20.0, "z_0": 4e-6},
         "turbulent_leakage": {"c": 1e-9}}


def compiled(model, folder):
    """Return pymoca's model of a config's Modelica text."""
    text = modelica_of(model, {}).content
    (folder / "my_rig.mo").write_text(text, encoding="utf-8")
    return transfer_model(str(folder), "my_rig", {})


class Equations:
    """The implicit equations 0 = f(t, x, x', z, u, parameters) of a compiled model, solved."""

    def __init__(self, model):
        self.names = [one.symbol.name() for one in model.states]
        self.others = [one.symbol.name() for one in model.alg_states]
        self.inputs = [one.symbol.name() for one in model.inputs]
        defaults = {}
        for one in model.parameters:  # each is a number here
            defaults[one.symbol.name()] = float(ca.evalf(ca.MX(one.value)))
        t, x = ca.MX.sym("t"), ca.MX.sym("x", len(self.names))
        z = ca.MX.sym("z", len(self.names) + len(self.others))
        u = ca.MX.sym("u", len(self.inputs))
        left = model.dae_residual_function(
            t, x, z[: len(self.names)], z[len(self.names):], u, ca.MX(0, 1),
            ca.DM([defaults[one.symbol.name()] for one in model.parameters]))
        self.t, self.x, self.z, self.u, self.left = t, x, z, u, left
        # The rates and the algebraic variables enter a dry friction as a product; Newton solves.
        slope = ca.Function("slope", [z, t, x, u], [ca.jacobian(left, z), left])
        self._slope, self.parameters = slope, defaults

    def sample_of(self, dt, steps):
        """Return the state after a sample, of the state and the inputs at both its ends."""
        n, h = len(self.names), dt / steps
        root = ca.rootfinder("root", "fast_newton", {
            "x": self.z, "p": ca.vertcat(self.x, self.u), "g": ca.substitute(
                self.left, self.t, ca.MX(0.0))})
        x, first, last = (ca.MX.sym(*one) for one in (
            ("x0", n), ("first", len(self.inputs)), ("last", len(self.inputs))))

        def slope(state, share):
            return root(0, ca.vertcat(state, first + share * (last - first)))[:n]

        state = x
        for i in range(steps):  # classical Runge-Kutta
            a = slope(state, i / steps)
            b = slope(state + 0.5 * h * a, (i + 0.5) / steps)
            c = slope(state + 0.5 * h * b, (i + 0.5) / steps)
            d = slope(state + h * c, (i + 1) / steps)
            state = state + h / 6.0 * (a + 2.0 * b + 2.0 * c + d)
        return ca.Function("sample", [x, first, last], [state])

    def solve(self, x, u, t=0.0):
        """Return name -> value of rates (``der(x)``) and algebraic variables at a state."""
        z = np.zeros(self.z.numel())
        for _ in range(12):
            matrix, left = (np.array(one) for one in self._slope(z, t, x, u))
            step = np.linalg.solve(matrix, left[:, 0])
            z = z - step
            if np.all(np.abs(step) <= 1e-12 * (1.0 + np.abs(z))):
                break
        return dict(zip([*(f"der({name})" for name in self.names), *self.others], z, strict=True))


def test_every_effect_is_written_or_told():
    assert {*EFFECTS, *CONSTANTS, *WITHOUT} == set(CATALOGUE), (
        "exports/modelica.py: EFFECTS, CONSTANTS or WITHOUT (docs/effects.md, An entry of the "
        "catalogue)")
    assert set(SIZES) == set(EFFECTS), "an effect that is written needs a size in SIZES"


@pytest.mark.parametrize("name", [*EFFECTS, "rigid_coulomb", "rigid_asymmetric"])
def test_each_effect_has_the_rates_of_its_compiled_term(name, tmp_path):
    """v', p1' and p2' at random states, with the effect's memory where the equation has it."""
    effect = {"rigid_coulomb": "coulomb_friction",
              "rigid_asymmetric": "asymmetric_friction"}.get(name, name)
    values = dict(SIZES[effect])
    if name == effect and "z_0" in {p.name for p in CATALOGUE[effect].parameters}:
        values.setdefault("z_0", 4e-6)
        values.setdefault("t_1", 1e-3)
    model = model_of({effect: values})
    made = Equations(compiled(model, tmp_path))
    theta, active = theta_of(model.settings.rig, model.settings.effects)
    which, terms = NAMES.index(effect), with_term(active)
    rng = np.random.default_rng(1)
    changed = 0.0
    for _ in range(12):
        state = {"x": rng.uniform(-0.02, 0.02), "v": rng.uniform(-0.02, 0.02),
                 "p1": rng.uniform(1.5e6, 2.6e6), "p2": rng.uniform(1.5e6, 2.6e6),
                 f"{effect}_bent": rng.uniform(-30.0, 30.0), f"{effect}_flow": rng.uniform(1, 50),
                 f"{effect}_pressure": rng.uniform(-1e5, 1e5)}
        x_d = state["x"] + rng.uniform(-3e-3, 3e-3)
        found = made.solve([state[one] for one in made.names],
                           [{"x_d": x_d, "load_force": 3.0}[one] for one in made.inputs])
        row, c, memory = np.zeros(s.N_SIGNALS), np.zeros(s.N_CONTRIBUTIONS), new_memory()
        row[[s.X, s.V, s.P1, s.P2, s.OMEGA]] = (state["x"], state["v"], state["p1"], state["p2"],
                                                theta[s.K_POS] * (x_d - state["x"]))
        memory[which] = ((state[f"{effect}_flow"], 1.0) if effect == "line_dynamics" else
                         (state[f"{effect}_bent"], state["x"]))
        add_contributions(row, theta, terms, memory, c)
        c[s.FORCE] += 3.0
        changed += np.abs(c - np.eye(s.N_CONTRIBUTIONS)[s.FORCE] * 3.0).sum()
        wanted = rates(state["v"], state["p1"], state["p2"], row[s.OMEGA], 0.0, theta, c)
        got = [found[f"der({one})"] for one in ("v", "p1", "p2")]
        np.testing.assert_allclose(got, wanted, rtol=1e-8, atol=1e-9 * np.abs(wanted).max())
    assert changed > 0.0


SEVERAL = {
    "presliding_friction": {"F_c": 30.0, "z_0": 4e-5, "t_1": 1e-4},
    "entrained_air": {"alpha": 0.01}, "drive_lag": {"tau": 4e-3},
    "spot": {"adds": "force", "expression": "F*exp(-((x - x_0)/w)**2)*tanh(v/1e-3)",
             "F": 38.0, "x_0": 2e-3, "w": 2e-3},
    "learned": {"adds": "flow", "of": "dp", "first": -1e6, "last": 1e6,
                "values": [-1e-7, -2e-8, 0.0, 3e-8, 1e-7]}}


@pytest.mark.parametrize("effects", [SEVERAL, CASES["pump ripple"]], ids=["several", "ripple"])
def test_a_free_run_is_the_simulator_s(effects, tmp_path):
    """Of friction, air, a slow drive, tables and expressions, integrated here."""
    model = model_of(effects, FAST, 1.0)
    made = Equations(compiled(model, tmp_path))
    samples, n = 250, len(made.names)
    x_d = demand(model, np.arange(samples + 1) * T_S)
    sample = made.sample_of(T_S, 10)
    start = {"p1": 2e6, "p2": 2e6, "x": float(x_d[0])}
    x, rows = np.array([start.get(one, 0.0) for one in made.names]), []
    for k in range(samples):
        rows.append(x)
        given = [{"x_d": x_d[k : k + 2], "load_force": np.zeros(2)}[one] for one in made.inputs]
        x = np.array(sample(x, *np.transpose(given)))[:, 0]
    assert n == 6 if effects is SEVERAL else "shaft_angle" in made.names
    rows, wanted = np.array(rows), own_run(model, samples)
    for name in ({"x", "v", "p1", "p2", "omega"} & set(made.names)):
        found = rows[:, made.names.index(name)]
        apart = np.abs(found - wanted[name]).max() / np.ptp(wanted[name])
        assert apart < 1e-3, (name, apart)


def test_delays_are_delays_and_what_is_left_out_is_told(tmp_path):
    model = model_of({"command_delay": {"T": 3e-3}, "feedback_delay": {"T": 2e-3},
                      "position_delay": {"T": 1e-3}, "backlash": {"b": 1e-4}})
    exported = modelica_of(model, {})
    assert "delay(x_d, 0.003)" in exported.content and "delay(x, 0.002)" in exported.content
    assert [line for line in exported.lost if line.startswith("backlash: ")]
    assert "// not in this model: backlash" in exported.content
    assert "my_rig" in parser.parse(exported.content).classes
    durations = [float(ca.evalf(ca.MX(one.duration)))
                 for one in compiled(model, tmp_path).delay_arguments]
    assert sorted(durations) == [1e-3, 2e-3, 3e-3]


def test_sensors_err_as_in_the_config(tmp_path):
    made = Equations(compiled(model_of({
        "position_scale": {"k": 0.01}, "pressure_scale": {"k_1": 0.02, "k_2": 0.0},
        "pressure_offset": {"b_1": 0.0, "b_2": 5e4}, "drive_gain": {"k": -0.1},
        "drive_saturation": {"omega_max": 10.0}}), tmp_path))
    state = {"x": 0.01, "v": 0.0, "p1": 2e6, "p2": 1e6, "omega": 0.0}
    given = {"x_d": 0.01 + 1e-4, "load_force": 0.0}
    found = made.solve([state[one] for one in made.names], [given[one] for one in made.inputs])
    assert found["x_measured"] == pytest.approx(0.0101)
    assert found["p1_measured"] == pytest.approx(2.04e6)
    assert found["p2_measured"] == pytest.approx(1.05e6)
    assert found["omega"] == pytest.approx(0.9 * 2.3)
    given["x_d"] = 0.02
    found = made.solve([state[one] for one in made.names], [given[one] for one in made.inputs])
    assert found["omega"] == pytest.approx(10.0)
