"""A spring that is relaxed at x = 0, by least squares on the force balance."""

import pytest
from rig_tools import settings, simulated

from eha_monitor.balances.answer import answered

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

