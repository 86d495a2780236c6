"""A spring that is met in part of the stroke: found, its place first, and beside a machine."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given
from hypothesis import settings as tries
from hypothesis import strategies as st
from machine_tools import machine_of
from rig_tools import settings, simulated

from eha_monitor.balances.answer import answered
from eha_monitor.balances.changed import against
from eha_monitor.balances.contact import contacts_of, pressed
from eha_monitor.balances.measured import course_of
from eha_monitor.balances.policy import POLICY

MOTION = {"kind": "multisine", "amplitude": 0.02, "frequency": 0.1, "frequency_end": 2.0,
          "duration": 20.0}
TOOL = {"contact_spring": {"k": 2e4, "x_c": 0.008}}


def recorded(effects, seed=1):
    return simulated(MOTION, 20.0, effects=effects).recording(seed=seed)


@given(place=st.floats(-0.5, 0.6), side=st.sampled_from([1.0, -1.0]),
       k=st.floats(3e3, 1e5), load=st.floats(-500.0, 500.0))
@tries(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_the_place_is_found_whatever_is_met_and_where(place, side, k, load):
    """The force is made up by hand: damping, friction, a load and what is met."""
    course = course_of(recorded({}), settings())
    low, high = course.x[course.good].min(), course.x[course.good].max()
    at = 0.5 * (low + high) + 0.5 * place * (high - low)
    course = replace(course, effects={}, force=700.0 * course.v + 30.0 * course.direction + load
                     + 20.0 * course.a + k * pressed(course.x, at, side))
    course.known.update({"force": 20.0 * course.a})
    found = [one for one in contacts_of([course], POLICY) if one[1] == side]
    assert found[0][0] == pytest.approx(at, abs=(high - low) / 400.0)


@pytest.mark.parametrize("effects", [
    {}, {"spring_load": {"k": 3e3}}, {"coulomb_friction": {"F_c": 60.0}}])
def test_nothing_is_met_where_nothing_is(effects):
    assert contacts_of([course_of(recorded(effects), settings())], POLICY) == ()


def test_the_configs_own_is_met_where_it_says():
    config = settings(effects={"contact_spring": {"k": 1e4, "x_c": 0.004}})
    assert contacts_of([course_of(recorded(TOOL), config)], POLICY) == ((0.004, 1.0),)


def test_what_is_met_is_named_with_its_stiffness_and_the_config_then_holds_it():
    recording = recorded(TOOL)
    found = answered([recording], settings())
    (effect,) = found.effects
    k = effect.parameters["k"]
    assert effect.name == "contact_spring" and abs(k.value - 2e4) < 3.0 * k.stddev < 2e3
    assert found.config_effects["contact_spring"]["x_c"] == pytest.approx(0.008, abs=2e-4)
    again = answered([recorded(TOOL, seed=2)], settings(effects=found.config_effects))
    assert again.verdict == "consistent"


def test_a_tool_that_broke_is_told_of_a_machine_that_meets_it_in_most_recordings():
    """It was a load over the stroke in three cosines: nothing at all is a spring's least."""
    short = simulated({**MOTION, "amplitude": 0.005}, 20.0, effects=TOOL).recording(seed=7)
    machine = machine_of([*(recorded(TOOL, seed) for seed in (1, 2, 3)), short], settings())
    assert ("k_c1", "contact_spring") in {
        (p.name, p.effect) for one in machine.balances for p in one.parameters}
    (change,) = against(machine, [recorded({}, 5)], settings(), ("a", "b", "c", "d")).changes
    assert change.what == "contact_spring"
    assert change.now.value == pytest.approx(0.0, abs=200.0)
    assert np.isclose(change.reference.value, 2e4, rtol=0.02)
