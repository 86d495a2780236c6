"""What every entry of the catalogue keeps: its own description, where a fit starts, its kin."""

import inspect
import math
import re

import numpy as np
import pytest
from rig_tools import settings
from test_physics_effects import VALUES, contributions, signal_row

from eha_monitor.estimation.rig_model import added_by
from eha_monitor.physics import signals as s
from eha_monitor.physics.contributions import (
    N_EFFECTS,
    N_THETA,
    add_contributions,
    new_memory,
    shift_memory,
    update_memory,
    with_place,
    with_term,
    with_update,
)
from eha_monitor.physics.effect import Ranges, no_term
from eha_monitor.physics.effects import CATALOGUE, NAMES
from eha_monitor.physics.parameters import place_of, theta_of

RANGES = Ranges(speed=0.2, position=0.04, acceleration=5.0,
                pressure_difference=(2e5, 5e5, 8e5, 1e6), lowest_pressure=(1.5e6, 1.6e6, 1.8e6),
                mean_pressure=2e6, pump_speed=(50.0, 150.0, 250.0, 300.0),
                pump_acceleration=(1e3, 5e3, 1e4), force=500.0, flow=1e-4, sample_time=1e-3,
                duration=24.0)
AT_REST = Ranges(0.0, 0.0, 0.0, (0.0,) * 4, (0.0,) * 3, 0.0, (0.0,) * 4, (0.0,) * 3, 0.0, 0.0,
                 1e-3, 0.0)


@pytest.mark.parametrize("effect", CATALOGUE.values(), ids=lambda effect: effect.name)
def test_entry_describes_itself(effect):
    assert 1 <= len(effect.parameters) <= s.MAX_PARAMETERS and effect.sizes
    values = {p.name: p.scale for p in effect.parameters}
    sentence = effect.said(values)
    assert "{" not in sentence and len(sentence) > 10 and not sentence.endswith(".")
    for p in effect.parameters:
        assert -math.inf < p.lower < p.upper < math.inf and p.scale > 0
        assert p.default is None or (p.lower <= p.default <= p.upper)
        assert p.lower <= p.neutral <= p.upper or p.neutral == math.inf or p.default is not None
        assert p.name in effect.equation.replace("+", " ")
    assert effect.source and effect.rig_check.endswith(".")
    for function, names in ((effect.term, "s p m c"), (effect.update, "s p h m"),
                            (effect.circuit, "p w")):
        assert list(inspect.signature(function.py_func).parameters) == names.split()


@pytest.mark.parametrize("effect", CATALOGUE.values(), ids=lambda effect: effect.name)
@pytest.mark.parametrize("ranges", [RANGES, AT_REST], ids=["moving", "at_rest"])
def test_a_fit_starts_from_small_instances_within_the_bounds(effect, ranges):
    starts = effect.starts(ranges)
    assert len(starts) <= 8 and (starts or effect.name == "position_quantisation")
    known = {p.name: p for p in effect.parameters}
    for start in starts:
        assert {p.name for p in effect.sizes} <= set(start) <= set(known)
        for name, value in start.items():
            inside = min(max(value, known[name].lower), known[name].upper)
            assert value in (inside, known[name].neutral) or ranges is AT_REST
        if ranges is RANGES:
            assert any(start[p.name] != p.neutral for p in effect.sizes)


@pytest.mark.parametrize("name", [name for name, e in CATALOGUE.items() if e.contains])
def test_an_effect_is_what_it_contains_where_its_own_sizes_are_neutral(name):
    """Sizes that both have are kept; shapes that both have are the smaller effect's."""
    effect = CATALOGUE[name]
    for inner in effect.contains:
        assert inner in CATALOGUE and name not in CATALOGUE[inner].contains
        assert CATALOGUE[inner].balance == effect.balance
        shared = {p.name for p in CATALOGUE[inner].parameters}
        own = {p.name: p.neutral for p in effect.sizes if p.name not in shared}
        values = {**VALUES[inner], **own}
        if name == "presliding_friction":
            values["z_0"] = 1.2e-5  # where one ends the other begins
        at_inner = {key: values[key] for key in VALUES[inner]}
        whole = {p.name: values.get(p.name, VALUES[name][p.name]) for p in effect.parameters}
        for row in (signal_row(), signal_row(v=-2e-4, x=-4e-6), signal_row(v=3e-2, x=8e-6)):
            assert contributions(row, {name: whole}) == pytest.approx(
                contributions(row, {inner: at_inner}), rel=1e-12)


@pytest.mark.parametrize("name", [n for n, e in CATALOGUE.items() if e.remembers_place])
@pytest.mark.parametrize("by", [1e-6, -0.02])
def test_a_corrected_position_bends_no_seal(name, by):
    """Reversal and a start of sliding, the same a little further along."""
    theta, active = theta_of(settings().rig, {name: VALUES[name]})
    terms, updates, places = with_term(active), with_update(active, theta), with_place(active)
    memory, c = new_memory(), np.zeros((2, s.N_CONTRIBUTIONS))
    for k in range(20):
        update_memory(signal_row(v=-0.01, x=-1e-6 * k), theta, updates, 1e-4, memory)
    row = signal_row(v=0.01, x=-1.5e-5)
    add_contributions(row, theta, terms, memory, c[0])
    shift_memory(places, by, memory)
    row[s.X] += by
    add_contributions(row, theta, terms, memory, c[1])
    assert c[1] == pytest.approx(c[0], rel=1e-6) and c[0, s.FORCE] != 0.0


def test_only_friction_remembers_a_place_and_families_are_of_one_balance():
    for name, effect in CATALOGUE.items():
        if effect.remembers_place:
            assert effect.family == "dry" and effect.balance == "force"
        assert effect.rarity >= 0
        for inner in effect.contains:
            assert effect.rarity >= CATALOGUE[inner].rarity, name
            assert effect.family == CATALOGUE[inner].family


@pytest.mark.parametrize("name", [name for name, effect in CATALOGUE.items()
                                  if effect.term is not no_term])
def test_an_entry_declares_what_it_reads_and_what_it_adds_to(name):
    """Held on draws of signals and memory: what is declared matters, and nothing else."""
    draw, place = np.random.default_rng(0), NAMES.index(name)
    size = {s.X: 0.05, s.V: 0.2, s.P1: 8e6, s.P2: 8e6, s.OMEGA: 300.0}
    added, read = set(), set()
    for k in range(400):
        row = np.zeros(s.N_SIGNALS)
        for which, most in size.items():
            row[which] = draw.uniform(0.0 if which in (s.P1, s.P2) else -most, most)
        row[s.V] *= 10.0 ** draw.uniform(-6.0, 0.0)
        if k % 2:  # cavitation
            row[[s.P1, s.P2]] *= draw.uniform(0.0, 0.02, 2)
        memory = np.array([draw.uniform(-20.0, 20.0), row[s.X] + draw.uniform(-1e-5, 1e-5)])

        def terms(row, memory=memory):
            whole = new_memory()
            whole[place] = memory
            return contributions(row, {name: VALUES[name]}, whole)

        here = terms(row)
        added |= set(np.flatnonzero(here).tolist())
        for which, most in size.items():
            other = row.copy()
            other[which] = row[which] * 1.01 + 1e-6 * most
            if (terms(other) != here).any():
                read.add(which)
    assert added == set(CATALOGUE[name].adds)
    declared = set(CATALOGUE[name].reads)
    # A seal that turns over at once does not read the place that it remembers.
    assert read <= declared <= read | {s.X}


def test_what_changes_the_pump_and_remembers_is_a_resonance():
    """Stage two follows the pump without memory; a line's is a state of its own."""
    remembering = with_update(np.ones(N_EFFECTS, dtype=np.bool_), np.zeros(N_THETA))
    assert {NAMES[i] for i in remembering if s.SPEED in added_by(i, np.zeros(N_THETA))} == {
        name for name, effect in CATALOGUE.items() if any(p.log for p in effect.parameters)}


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


@pytest.mark.parametrize(("name", "values", "sentence"), [
    ("position_delay", {"T": 3e-3}, "the recorded position is 3 ms late"),
    ("relief_valve", {"p_c": 5e6, "k": 1e-11}, "a relief valve opens at 5 MPa between the "
     "chambers and passes 600 ml/(min·MPa) of pressure beyond that"),
    ("pressure_offset", {"b_1": 2e4, "b_2": -1.5e3}, "the pressure sensors have zero errors of "
     "+20 kPa (chamber 1) and −1.5 kPa (chamber 2)"),
    ("pump_flow_gain", {"k": -0.05}, "the pump gives −5 % flow at every speed, against the "
     "configured displacement"),
    ("drive_saturation", {"omega_max": 250.0, "slew": math.inf},
     "the drive is limited to 250 rad/s"),
    ("drive_saturation", {"omega_max": math.inf, "slew": 9e3},
     "the drive is limited to 9000 rad/s²"),
])
def test_a_statement_has_the_units_that_people_write(name, values, sentence):
    assert CATALOGUE[name].said(values) == sentence


@pytest.mark.parametrize("effect", CATALOGUE.values(), ids=lambda effect: effect.name)
def test_no_statement_writes_raw_si(effect):
    said = effect.said({p.name: p.scale for p in effect.parameters})
    assert not re.search(r"\de[+-]?\d|\d Pa|m³/|10⁻", said), said
