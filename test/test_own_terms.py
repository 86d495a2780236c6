"""Terms of a config that no entry of the catalogue has: tables of knots and expressions."""

import json
import math
import os
import re
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from diagnosis_tools import coulomb
from hypothesis import given
from hypothesis import strategies as st
from rig_tools import SINE, settings, simulated
from ruamel.yaml import YAML

from eha_monitor.api.diagnose import written_config
from eha_monitor.errors import InputError
from eha_monitor.estimation.pipeline import estimate
from eha_monitor.physics import own_term as o
from eha_monitor.physics import signals as s
from eha_monitor.physics.contributions import (
    ALL_NAMES,
    N_THETA,
    add_contributions,
    new_memory,
    slot_of,
)
from eha_monitor.physics.effects import NAMES
from eha_monitor.physics.own_term import FUNCTIONS, parsed
from eha_monitor.reports.page import config_tables
from eha_monitor.settings import settings_from_tree
from eha_monitor.settings.load import annotated
from eha_monitor.settings.own_terms import checked, slot_for

ROOT = Path(__file__).parents[1]
ROW = np.zeros(s.N_SIGNALS)
ROW[[s.X, s.V, s.P1, s.P2, s.OMEGA, s.T]] = 0.013, -0.021, 2.5e6, 1.7e6, 40.0, 0.45
SIGNALS = {"x": 0.013, "v": -0.021, "dp": 8e5, "p": 2.1e6, "omega": 40.0, "p1": 2.5e6,
           "p2": 1.7e6, "angle": 18.0}
PYTHON = {"abs": abs, "sign": lambda a: math.copysign(1.0, a) if a else 0.0, "sqrt": math.sqrt,
          "exp": math.exp, "tanh": math.tanh, "sin": math.sin, "cos": math.cos, "max": max,
          "min": min, "pi": math.pi}


def added(entry, row=ROW):
    """Return what an entry of ``effects`` adds at some signals, (N_CONTRIBUTIONS,)."""
    theta, c = np.zeros(N_THETA), np.zeros(s.N_CONTRIBUTIONS)
    which = len(NAMES)
    theta[slot_of(which)] = slot_for(checked("mine", entry))
    add_contributions(row, theta, np.array([which]), new_memory(), c)
    return c


def value_of(text, **parameters):
    return added({"adds": "force", "expression": text, **parameters})[s.FORCE]


@pytest.mark.parametrize("text", [
    "38*exp(-((x - 0.008)/0.0041)**2)*tanh(v/1e-3)", "v*abs(v)*1e4", "-x**2", "2**-3", "+x - -v",
    "sign(v)*max(abs(dp) - 2e5, 0)*1e-3", "sqrt(p1/p2) + sin(pi*x/0.01)*cos(omega)",
    "min(x, v) - (x - (v - (x*v)))", "1/(2 + x)", "1e-3*dp/p", "((((x))))"])
def test_an_expression_is_what_python_makes_of_it(text):
    expected = eval(text, {"__builtins__": {}}, SIGNALS | PYTHON)
    assert value_of(text) == pytest.approx(expected, rel=1e-13)


@pytest.mark.parametrize("text", [
    "max(v, sqrt(-x))", "max(sqrt(-x), v)", "min(v, sqrt(-x))", "min(sqrt(-x), v)",
    "sign(sqrt(-x))", "exp(sqrt(-x))", "abs(max(0, sqrt(-x)))"])
def test_what_is_no_number_stays_none_wherever_it_stands(text):
    assert math.isnan(value_of(text))


@pytest.mark.parametrize("text", ["max(angle, angle/angle)", "min(angle/angle, 1)"])
def test_what_is_no_number_at_rest_is_refused(text):
    with pytest.raises(ValueError, match="is no number at rest"):
        value_of(text)


LEAVES = st.one_of(st.sampled_from(sorted(SIGNALS)), st.floats(
    0.01, 100.0).map(lambda value: f"{value:.6g}"))
TREES = st.recursive(LEAVES, lambda inner: st.one_of(
    st.tuples(inner, st.sampled_from("+-*/"), inner).map(lambda t: f"({t[0]} {t[1]} {t[2]})"),
    st.tuples(st.sampled_from(["abs", "tanh", "sin", "cos", "-"]), inner).map(
        lambda t: f"{t[0]}({t[1]})"),
    st.tuples(st.sampled_from(["max", "min"]), inner, inner).map(
        lambda t: f"{t[0]}({t[1]}, {t[2]})")), max_leaves=8)


@given(TREES)
def test_any_expression_is_what_python_makes_of_it_or_is_refused_in_one_line(text):
    try:
        found = value_of(text)
    except ValueError as problem:
        assert "\n" not in str(problem) and str(problem).startswith("mine.expression: ")
        return
    try:
        expected = eval(text, {"__builtins__": {}}, SIGNALS | PYTHON)
    except ZeroDivisionError:
        assert not math.isfinite(found)
        return
    assert found == pytest.approx(expected, rel=1e-9, abs=1e-9)


@given(st.text(max_size=60))
def test_no_text_is_more_than_a_value_error(text):
    try:
        found = parsed(text)
    except ValueError as problem:
        assert "\n" not in str(problem)
        return
    assert len(found.codes) <= o.MOST_CODES


@pytest.mark.parametrize(("text", "told"), [
    ("__import__('os')", "at character 1: unknown function '__import__'"),
    ("x.real", "at character 1: 'x.real' is no part of an expression"),
    ("2 + F*(", "at character 7: not an expression"),
    ("x + foo(v)", "at character 5: unknown function 'foo'"),
    ("max(x)", "at character 1: max takes 2 numbers"),
    ("exp", "at character 1: exp is a function, expected exp(...)"),
    ("1e999*x", "at character 1: expected a finite number"),
    ("x if v else p", "is no part of an expression"),
    ("[x for x in v]", "is no part of an expression"),
    ("x + " * 300 + "x", "expected at most 400"),
    ("+".join(["x"] * 40), "too long: 79 operations"),
    ("x-(x-(x-(x-(x-(x-x)))))", "nested deeper than 6"),
    ("F*x", "mine.F: expected the value of this parameter"),
    ("1/x", "is no number at rest")])
def test_what_is_no_expression_is_refused_with_its_place(text, told):
    with pytest.raises(ValueError, match="mine") as problem:
        checked("mine", {"adds": "force", "expression": text})
    assert told in str(problem.value)


TABLE = {"adds": "force", "of": "x", "first": -0.02, "last": 0.02, "values": [1.0, 3.0, -2.0, 4.0]}


@pytest.mark.parametrize(("changed", "told"), [
    ({"adds": "torque"}, "mine.adds: expected one of force, flow"),
    ({"of": "y"}, "mine.of: expected one of x, v"),
    ({"times": "x"}, "mine.times: expected one of none, direction"),
    ({"last": -0.02}, "mine.last: expected more than first"),
    ({"scale": 0}, "mine.scale: expected more than 0"),
    ({"values": [1.0]}, "mine.values: expected a list of 3 to 49"),
    ({"values": [1.0, 2.0, "a"]}, "mine.values: expected a finite number"),
    ({"first": math.nan}, "mine.first: expected a finite number"),
    ({"knots": 3}, "mine.knots: unknown key")])
def test_a_table_that_is_none_is_refused_with_its_key(changed, told):
    with pytest.raises(InputError) as problem:
        settings(effects={"mine": {**TABLE, **changed}})
    assert told in str(problem.value)


def test_names_and_numbers_of_own_terms():
    with pytest.raises(InputError, match="coulomb_friction is an effect of the catalogue"):
        settings(effects={"coulomb_friction": TABLE})
    with pytest.raises(InputError, match="third: expected at most 2 terms beyond the catalogue"):
        settings(effects={"one": TABLE, "two": TABLE, "third": TABLE})
    with pytest.raises(InputError, match="expected a user-defined term with the key adds"):
        settings(effects={"mine": {"of": "x"}})


def test_a_table_goes_through_its_knots_and_holds_its_ends():
    for x, wanted in ((-0.02, 1.0), (-0.02 + 0.04 / 3, 3.0), (0.02, 4.0), (0.5, 4.0), (-1.0, 1.0)):
        row = ROW.copy()
        row[s.X] = x
        assert added(TABLE, row)[s.FORCE] == pytest.approx(wanted, abs=1e-12)


@given(st.lists(st.floats(-1e3, 1e3), min_size=3, max_size=o.MOST_KNOTS), st.floats(-0.03, 0.03))
def test_knots_act_in_proportion(values, x):
    row = ROW.copy()
    row[s.X] = x
    shares = o.cardinal(np.array([x]), len(values), -0.02, 0.02)[0]
    assert shares.sum() == pytest.approx(1.0)
    assert added({**TABLE, "values": values}, row)[s.FORCE] == pytest.approx(
        float(shares @ values), abs=1e-9)


def test_a_table_of_a_square_is_the_square():
    """Catmull and Rom's cubic is exact for a parabola, away from the ends."""
    knots = np.linspace(-0.02, 0.02, 9)
    for x in np.linspace(-0.0149, 0.0149, 31):
        row = ROW.copy()
        row[s.X] = x
        found = added({**TABLE, "values": list(1e5 * knots**2)}, row)[s.FORCE]
        assert found == pytest.approx(1e5 * x * x, abs=1e-10)


@pytest.mark.parametrize(("times", "factor"), [
    ("none", 1.0), ("direction", math.tanh(-0.021 / 0.01)), ("v", -2.1), ("dp", 8e7)])
def test_what_a_table_is_multiplied_by(times, factor):
    plain, found = added(TABLE), added({**TABLE, "times": times, "scale": 0.01})
    assert found[s.FORCE] == pytest.approx(plain[s.FORCE] * factor)


@pytest.mark.parametrize(("adds", "wanted"), [
    ("force", {s.FORCE: 1.0}), ("flow", {s.FLOW_1: 1.0, s.FLOW_2: -1.0}),
    ("flow_1", {s.FLOW_1: 1.0}), ("flow_2", {s.FLOW_2: 1.0}), ("speed", {s.SPEED: 1.0})])
def test_to_which_balance_a_term_adds(adds, wanted):
    c = added({"adds": adds, "expression": "x/0.013"})
    assert dict(zip(np.flatnonzero(c), c[np.flatnonzero(c)], strict=True)) == pytest.approx(wanted)


def test_every_place_of_theta_belongs_to_one_term():
    slots = [slot_of(which) for which in range(len(ALL_NAMES))]
    assert all(one.stop <= other.start for one, other in pairwise(slots))
    assert slots[-1].stop == N_THETA
    assert set(FUNCTIONS) <= set(PYTHON)


def test_a_config_with_own_terms_is_written_and_read_again():
    config = settings(effects={
        "mine": {**TABLE, "times": "direction", "scale": 1e-3},
        "spot": {"adds": "force", "expression": "F*exp(-((x - x_0)/w)**2)", "F": 38.0,
                 "x_0": 8e-3, "w": 4.1e-3}, "spring_load": {"k": 900.0, "x_0": 0.0}})
    tree = YAML(typ="safe").load(annotated(config))
    assert settings_from_tree(tree, "again") == config


PAIRS = [
    ({"spring_load": {"k": 2000.0, "x_0": 0.0}}, {"adds": "force", "expression": "k*x",
                                                  "k": 2000.0}),
    ({"spring_load": {"k": 2000.0, "x_0": 0.0}},
     {"adds": "force", "of": "x", "first": -0.1, "last": 0.1, "values": [-200.0, 0.0, 200.0]}),
    ({"quadratic_friction": {"a_1": 3000.0}}, {"adds": "force", "expression": "3000*v*abs(v)"}),
    ({"cross_port_leakage": {"L": 4e-13}}, {"adds": "flow", "expression": "-4e-13*dp"}),
]


@pytest.mark.parametrize(("known", "own"), PAIRS)
def test_an_own_term_is_simulated_and_estimated_as_the_catalogues_is(known, own):
    one, two = (simulated(SINE, 4.0, effects=effects) for effects in (known, {"mine": own}))
    np.testing.assert_allclose(two.truth, one.truth, rtol=1e-9, atol=1e-12)
    answers = [estimate(run.recording(seed=1), run.config) for run in (one, two)]
    for name in ("B", "beta_e"):
        first, second = (answer.parameters[name] for answer in answers)
        assert second.value == pytest.approx(first.value, rel=1e-6)


# Two whole diagnoses; what each stage makes of own and learned terms is tested by itself.
@pytest.mark.slow
@pytest.mark.timeout(300)
def test_the_page_of_own_terms_says_what_happens(tmp_path):
    """Its config and its commands are run as they stand."""
    page = (ROOT / "docs/effects.md").read_text()
    config, commands = (re.search(rf"```{kind}\n(.*?)```", page, re.DOTALL)[1]
                        for kind in ("yaml", "sh"))
    (tmp_path / "worn.yaml").write_text(config)
    for line in commands.strip().splitlines():
        run = subprocess.run(
            [sys.executable, "-m", "eha_monitor", *line.split()[1:]], cwd=tmp_path,
            env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True,
            timeout=300)
        assert run.returncode == 0, (line, run.stderr)
    known, bare, estimated = (json.loads((tmp_path / f"{name}.json").read_text())
                              for name in ("with", "without", "estimate"))
    assert (known["verdict"], bare["verdict"]) == ("consistent", "unexplained")
    assert estimated["parameters"]["B"]["value"] == pytest.approx(600.0, rel=0.03)
    learned, = bare["learned"]
    assert learned["balance"] == "force" and learned["of"] == ["x", "v"]
    entry = learned["entry"]
    assert [entry[key] for key in ("F", "u_0", "w")] == pytest.approx([60.0, 4e-3, 5e-3], rel=0.03)
    assert "59.9 N · exp(" in learned["formula"] and learned["held_out_error_removed"] > 0.99
    x, curve, band = (np.array(learned[key]) for key in ("x", "curve", "band"))
    true = 60.0 * np.exp(-(((x - 4e-3) / 5e-3) ** 2))
    assert np.mean(np.abs(curve - true) < 2.0 * band + 0.5) > 0.9
    for name, true in (("B", 600.0), ("beta_e", 6e8)):
        assert bare["parameters"]["after"][name]["value"] == pytest.approx(true, rel=0.03)
    page = (tmp_path / "worn.html").read_text()
    assert learned["formula"] in page and "Learned term" in page


def test_reports_name_the_terms_that_a_config_has():
    config = settings(effects={"cam": TABLE, "spot": {
        "adds": "flow", "expression": "a*dp", "a": 2e-13}})
    rows = dict(config_tables(config))["Effects beyond the linear model"].rows
    assert [(key.text, value.text) for key, value, _ in rows] == [
        ("cam", "4 values over x, -0.02 to 0.02"), ("spot", "a*dp with a = 2e-13")]
    assert rows[1][2].text.endswith("adds to the flow in m³/s")


def test_the_readable_filter_gives_the_same_numbers():
    own = {"mine": {"adds": "force", "expression": "3000*v*abs(v)"}}
    run = simulated(SINE, 3.0, effects=own)
    tree = run.config.model_dump() | {"engine": "filterpy"}
    one, two = (estimate(run.recording(seed=1), config)
                for config in (run.config, settings_from_tree(tree, "test")))
    for name in ("B", "beta_e"):
        assert two.parameters[name].value == pytest.approx(one.parameters[name].value, rel=1e-6)


def test_a_written_config_keeps_the_terms_that_it_was_given():
    spot = {"adds": "flow", "expression": "a*dp", "a": 2e-13}
    found = coulomb()
    found = replace(found, config_effects={**found.config_effects, "cam": checked("cam", TABLE),
                                           "spot": spot})
    given = settings(effects={"cam": TABLE, "spot": spot})
    tree = YAML(typ="safe").load(written_config(found, given, None))
    kept = settings_from_tree(tree, "written").effects
    assert kept["spot"] == given.effects["spot"] and kept["cam"] == given.effects["cam"]
    assert "coulomb_friction" in kept
