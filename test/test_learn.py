"""A model for what has no name: shapes, formulas from curves, forms, and what is not told."""

import math
from dataclasses import replace

import numpy as np
import pytest
from diagnosis_tools import coulomb
from ruamel.yaml import YAML

from eha_monitor.api.diagnose import answer, written_config
from eha_monitor.mismatch.diagnosis import LearnedTerm, SignalFit
from eha_monitor.mismatch.learn.formula import (
    FACTORS,
    SHAPES,
    curve_of,
    in_signal,
    on_curve,
    shown_as,
    unit_of,
)
from eha_monitor.mismatch.learn.learned import (
    BALANCE,
    UNKNOWN,
    Form,
    factor_along,
    signal_along,
)
from eha_monitor.mismatch.learn.validated import removed
from eha_monitor.physics import own_term as o
from eha_monitor.physics import signals as s
from eha_monitor.physics.own_term import parsed
from eha_monitor.reports.diagnosis_report import diagnosis_page
from eha_monitor.reports.diagnosis_words import head_words
from eha_monitor.settings import Settings, settings_from_tree
from eha_monitor.settings.own_terms import checked, slot_for

# Closed forms of the shapes, independent of the grammar.
CLOSED = {
    "a constant": lambda u, p: p["F"] + 0.0 * u,
    "a line": lambda u, p: p["F"] + p["k"] * u,
    "a parabola": lambda u, p: p["F"] + p["k"] * u + p["c"] * u**2,
    "a square law": lambda u, p: p["c"] * np.sign(u) * u**2,
    "a cube": lambda u, p: p["c"] * u**3,
    "a root": lambda u, p: p["c"] * np.sign(u) * np.abs(u) ** 0.5,
    "a bump": lambda u, p: p["F"] * np.exp(-(((u - p["u_0"]) / p["w"]) ** 2)),
    "a bump on a constant": lambda u, p: p["F_0"] + p["F"] * np.exp(
        -(((u - p["u_0"]) / p["w"]) ** 2)),
    "a decay": lambda u, p: p["F_0"] + p["F"] * np.exp(-np.abs(u) / p["w"]),
    "a saturation": lambda u, p: p["F"] * np.tanh(u / p["w"]),
    "a dead band": lambda u, p: p["k"] * np.sign(u) * np.clip(np.abs(u) - p["d"], 0.0, None),
    "a rise beyond": lambda u, p: p["k"] * np.clip(np.abs(u) - p["d"], 0.0, None),
    "a threshold": lambda u, p: p["k"] * np.clip(u - p["u_0"], 0.0, None),
    "a threshold from below": lambda u, p: p["k"] * np.clip(p["u_0"] - u, 0.0, None),
    "a sine": lambda u, p: p["F_0"] + p["F"] * np.sin(2.0 * np.pi * (u - p["u_0"]) / p["w"]),
}
TRUE = {"F": 38.0, "F_0": 5.0, "k": 900.0, "c": 4e4, "u_0": 3e-3, "w": 6e-3, "d": 8e-3}


KNOWN = 0.2**2 * np.eye(33)  # covariance of a curve that is known with 0.2 at each of 33 places


def test_every_shape_has_a_closed_form_here_and_a_start():
    assert {shape.name for shape in SHAPES} == set(CLOSED)
    u = np.linspace(-0.02, 0.02, 33)
    for shape in SHAPES:
        for start in shape.starts(u, 3.0 + 40.0 * np.exp(-((u - 2e-3) / 5e-3) ** 2)):
            assert set(start) == set(shape.units)
            assert all(start[key] > 0.0 for key in shape.positive)


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: shape.name)
@pytest.mark.parametrize("of", ["x", "p", "p2"])
def test_a_shape_is_its_closed_form_in_any_signal(shape, of):
    u, values = np.linspace(-0.02, 0.02, 41), {key: TRUE[key] for key in shape.units}
    made = curve_of(in_signal(shape.text, of), values, of, u)
    assert made == pytest.approx(CLOSED[shape.name](u, values), rel=1e-12, abs=1e-12)
    assert set(parsed(in_signal(shape.text, of)).parameters) == set(shape.units)


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: shape.name)
def test_a_curve_of_a_shape_gives_its_numbers_back(shape):
    """From 33 places with 0.2 of noise; each number within five of its standard deviations."""
    u, true = np.linspace(-0.02, 0.02, 33), {key: TRUE[key] for key in shape.units}
    y = CLOSED[shape.name](u, true)
    cost, own, values = on_curve(
        shape, u, y + np.random.default_rng(5).normal(0, 0.2, 33), KNOWN, "x")
    assert own is shape and cost < 33.0
    assert CLOSED[shape.name](u, values) == pytest.approx(y, abs=1.0)


def test_the_shape_that_made_a_curve_is_the_best_for_it():
    u = np.linspace(-0.02, 0.02, 33)
    rng = np.random.default_rng(6)
    for name in ("a bump", "a sine", "a rise beyond", "a cube", "a saturation", "a threshold"):
        shape = next(one for one in SHAPES if one.name == name)
        y = CLOSED[name](u, TRUE | {"c": 8e6}) + rng.normal(0.0, 0.2, 33)
        fits = sorted((on_curve(one, u, y, KNOWN, "x") for one in SHAPES), key=lambda fit: fit[0])
        assert fits[0][1] is shape, (name, fits[0][1].name)


@pytest.mark.parametrize("times", FACTORS)
def test_a_formula_is_read_with_its_units(times):
    bump = next(one for one in SHAPES if one.name == "a bump")
    form = Form("force", "x", times)
    text = shown_as(bump, form, {"F": 38.0, "u_0": -8e-3, "w": 4.1e-3})
    unit = {"v": " N·s/m", "dp": " N/Pa", "omega": " N·s/rad"}.get(times, " N")
    assert text.startswith(f"38{unit} · exp(−((x + 8 mm)/4.1 mm)²)")
    assert text.endswith(FACTORS[times][1])
    assert unit_of(form, "y/u2").endswith("/(m)²")


def test_units_and_balances_are_known_of_every_signal_and_form():
    assert set(o.OF_UNITS) == set(o.OF) and set(FACTORS) == set(o.FACTORS)
    assert set(BALANCE) == set(UNKNOWN) == set(o.ADDED)


@pytest.mark.parametrize("of", o.OF)
@pytest.mark.parametrize("times", o.FACTORS)
def test_a_form_along_a_trajectory_is_what_the_equations_add(of, times):
    """The columns that forms are weighed by are those of the table that is fitted."""
    rng, n = np.random.default_rng(3), 20
    track = np.zeros((n, s.N_SIGNALS))
    track[:, s.X], track[:, s.V] = rng.uniform(-0.02, 0.02, (2, n))
    track[:, s.P1], track[:, s.P2] = rng.uniform(1e6, 3e6, (2, n))
    track[:, s.OMEGA] = rng.uniform(-100.0, 100.0, n)
    track[:, s.ANGLE] = rng.uniform(-40.0, 40.0, n)
    at, angles = signal_along(track, of), track[:, s.ANGLE].copy()
    entry = {"adds": "force", "of": of, "times": times, "scale": 0.5, "first": float(at.min()),
             "last": float(at.max()), "values": rng.normal(0.0, 1.0, 9).tolist()}
    q = slot_for(checked("mine", entry))
    for k in range(n):
        c = np.zeros(s.N_CONTRIBUTIONS)
        o.own_term(track[k], q, np.array([angles[k], 0.0]), c)
        row = o.cardinal(at[k : k + 1], 9, entry["first"], entry["last"], of == "angle")
        factor = factor_along(track[k : k + 1], times, 0.5)[0]
        assert c[s.FORCE] == pytest.approx(factor * (row @ entry["values"])[0], rel=1e-9)


def errors(before, after):
    return {"position": SignalFit("m", before, after, 1e-6), "force": SignalFit(
        "N", 1.0, 5.0, math.nan)}


def test_what_is_removed_is_of_the_squared_error_beyond_the_noise():
    assert removed(errors(3e-6, 1e-6)) == pytest.approx(1.0)
    assert removed(errors(3e-6, 2e-6)) == pytest.approx(1.0 - 3.0 / 8.0)
    assert removed(errors(3e-6, 5e-6)) == pytest.approx(-2.0)
    assert removed(errors(0.9e-6, 0.9e-6)) == 0.0  # nothing to remove


def term(formula="38 N · exp(−((x − 4 mm)/5 mm)²) against the motion"):
    x = np.linspace(-0.01, 0.01, 21)
    curve = 38.0 * np.exp(-(((x - 4e-3) / 5e-3) ** 2))
    entry = {"adds": "force", "expression": "F*exp(-((x - u_0)/w)**2)*tanh(v/v_e)", "F": 38.0,
             "u_0": 4e-3, "w": 5e-3, "v_e": 1e-3}
    return LearnedTerm(
        "force", "force", ("x", "v"), f"an unknown force, {formula}, 38 N at its largest", "38 N",
        "N", "m", x, curve, 0.0 * x + 1.0, x[::2], curve[::2], 0.0 * x[::2] + 2.0, formula,
        "a bump" if formula else "",
        (("2 N", 120.0), ("a <b> & c", 3.0)), curve if formula else np.full(21, math.nan), 0.97,
        812.0, entry)


@pytest.mark.parametrize("formula", ["38 N · exp(−((x − 4 mm)/5 mm)²) against the motion", ""])
def test_json_page_and_config_tell_a_learned_term(formula):
    one = term(formula)
    found = replace(coulomb(), verdict="unexplained", effects=(), learned=(one,),
                    config_effects={"learned_force": one.entry})
    tree = answer(found)["learned"][0]
    assert {key: tree[key] for key in ("balance", "of", "formula", "held_out_error_removed")} == {
        "balance": "force", "of": ["x", "v"], "formula": formula, "held_out_error_removed": 0.97}
    assert tree["alternatives"] == ["2 N", "a <b> & c"] and tree["covered"] == [-0.01, 0.01]
    assert len(tree["x"]) == len(tree["curve"]) == len(tree["band"]) == 21
    page = diagnosis_page(found, Settings())
    assert "Learned term</h2>" in page and "a &lt;b&gt; &amp; c" in page
    assert "learned_force: {adds: force, expression: " in page.replace("&#34;", '"')
    assert "Effect not in the catalogue, learned from the recording" in head_words(found)
    written = written_config(found, Settings(), None)
    kept = settings_from_tree(YAML(typ="safe").load(written), "written").effects["learned_force"]
    assert kept == one.entry
    assert "effects, learned: an unknown force" in written


def test_without_a_learned_term_the_config_stays():
    found = replace(coulomb(), verdict="unexplained", effects=(), learned=(), config_effects={})
    assert answer(found)["learned"] == []
    tree = YAML(typ="safe").load(written_config(found, Settings(), None))
    assert settings_from_tree(tree, "written") == Settings()
