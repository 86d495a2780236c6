"""Two numbers of one balance that have changed at once: fitted together, not one after another."""

import numpy as np
import pytest
from machine_tools import healthy_machine
from rig_tools import MULTISINE, settings, simulated
from sprung_rig import DRY, SETTINGS, STIFFNESS, recorded, strokes

from eha_monitor.balances.changed import against
from eha_monitor.balances.machine import healthy_machine_of
from eha_monitor.balances.measured import courses_of


def stiffer_and_drier(t, x, v):
    return 0.5 * STIFFNESS * x + 1.25 * DRY * np.tanh(v / 1e-3)


def test_a_spring_and_a_friction_have_their_own_sizes():
    healthy = [recorded(seed, motion=strokes, noise=10.0) for seed in range(5)]
    machine = healthy_machine_of(courses_of(healthy, SETTINGS)[1], SETTINGS)
    now = recorded(8, stiffer_and_drier, motion=strokes, noise=10.0)
    found = against(machine, [now], SETTINGS, ("healthy",))
    sizes = {one.what: one for one in found.changes}
    assert set(sizes) == {"spring_load", "coulomb_friction"}
    for name, size in (("spring_load", 1.5 * STIFFNESS), ("coulomb_friction", 2.25 * DRY)):
        now = sizes[name].now
        assert now.value == pytest.approx(size, rel=0.01)


def test_what_the_healthy_machine_does_not_know_is_no_change():
    # Their pressures hardly load the leak, and all are off by the same: "5.5 +- 0.5 less".
    def on(day, **effects):
        shape = {**MULTISINE, "frequency_end": 4.0, "seed": day}
        return simulated(shape, 12.0, effects=effects).recording(day)

    machine = healthy_machine([on(day) for day in (0, 1, 2, 13, 14)], settings())
    found = against(machine, [on(3, coulomb_friction={"F_c": 40.0})], settings(), ("healthy",))
    assert [one.what for one in found.changes] == ["coulomb_friction"]
    assert found.changes[0].now.value == pytest.approx(40.0, rel=0.01)
