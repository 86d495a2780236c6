"""A spring that is relaxed at x = 0, by least squares on the force balance."""

from dataclasses import replace

import pytest
from machine_tools import machine_of
from rig_tools import settings, simulated

from eha_monitor.balances.answer import Asked, answered
from eha_monitor.balances.candidates import Scale, candidates_of
from eha_monitor.balances.changed import against
from eha_monitor.balances.measured import course_of
from eha_monitor.balances.policy import POLICY
from eha_monitor.balances.table import tables_of

MOTION = {"kind": "multisine", "amplitude": 0.02, "frequency": 0.1, "frequency_end": 2.0,
          "duration": 20.0}


def spring(load):
    return simulated(MOTION, 20.0, effects={"spring_load": {"k": 3000.0, "x_0": 0.0},
                                            "constant_load": {"F_0": load}}).recording(seed=1)


@pytest.mark.parametrize("load", [0.0, 60.0])
def test_a_spring_brings_no_load_of_its_own(load):
    """Its column begins where the motion does, 20 mm below, and a load of -60 N was named."""
    found = answered([spring(load)], settings())
    named = {effect.name: effect for effect in found.effects}
    assert named["spring_load"].parameters["k"].value == pytest.approx(3000.0, rel=0.02)
    assert ("constant_load" in named) is bool(load)



def test_a_load_beside_a_spring_is_that_at_zero_in_a_comparison_too():
    """Healthy recordings of 809 N were said to have -4331 N, the load where the motion begins."""
    machine = machine_of([spring(60.0)] * 3, settings())
    found = against(machine, [spring(200.0)], settings(), ("a", "b", "c"))
    (load,) = [one for one in found.changes if one.what == "constant_load"]
    assert load.reference.value == pytest.approx(60.0, abs=2.0)
    assert load.now.value == pytest.approx(200.0, abs=2.0)


def test_a_load_that_differs_over_recordings_is_in_the_config_as_in_the_newest():
    """The monitor said that it adopts 801 N, and put the mean of two bags in force, 449 N."""
    found = answered([spring(load) for load in (200.0, 60.0)], settings(), Asked(newest=True))
    (load,) = [effect for effect in found.effects if effect.name == "constant_load"]
    assert "over the recordings" in load.statement
    assert found.config_effects["constant_load"]["F_0"] == pytest.approx(200.0, abs=2.0)


def test_how_large_a_spring_may_be_does_not_depend_on_where_its_column_begins():
    """It begins where the motion does: on a short stroke its load there is twice what is measured.

    A spring of 5.6 kN/m was then beyond what the rig can have, and told as a load over the stroke.
    """
    config = settings()
    course = course_of(spring(0.0), config)
    scale = Scale.of([course])

    def reach(origin):
        (table,) = tables_of([course], config.rig, "force", candidates_of(
            "force", replace(scale, origin=origin), config.rig, ()), POLICY)
        return table.reach[table.places["k"]]

    assert reach(scale.origin - 0.5) == pytest.approx(reach(scale.origin), rel=1e-6)
