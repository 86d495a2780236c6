"""Terms of the shaft's angle: followed, learned with their order, and begun anew elsewhere."""

from dataclasses import replace

import numpy as np
import pytest
from mismatch_tools import diagnosed
from rig_tools import SINE, settings, simulated

from eha_monitor.api.diagnose import answer
from eha_monitor.estimation.modelled import contributions_along
from eha_monitor.estimation.pipeline import estimate
from eha_monitor.mismatch.data.experiment import experiment_of
from eha_monitor.mismatch.learn.formula import RIPPLES, shown_as
from eha_monitor.mismatch.learn.learned import Form
from eha_monitor.mismatch.name.before import at_its_angle
from eha_monitor.physics import own_term as o
from eha_monitor.physics import signals as s
from eha_monitor.physics.contributions import N_EFFECTS, new_memory, slot_of
from eha_monitor.physics.effects import NAMES
from eha_monitor.physics.parameters import theta_of
from eha_monitor.settings.own_terms import checked, slot_for

RIPPLE = {"adds": "flow", "expression": "F*cos(7*angle)*omega", "F": 8e-9}


def test_a_periodic_table_goes_round_and_follows_its_cosine():
    """Knots of a cosine over 2 pi/7; Catmull and Rom's cubic is within 2 % of it, everywhere."""
    places = np.linspace(0.0, 2.0 * np.pi / 7.0, 9, endpoint=False)
    values = np.cos(7.0 * places)
    at = np.random.default_rng(1).uniform(-300.0, 300.0, 500)
    made = np.array([o.tabled(values, 9, 0.0, 2.0 * np.pi / 7.0, one, True) for one in at])
    assert made == pytest.approx(np.cos(7.0 * at), abs=0.02)
    basis = o.cardinal(at, 9, 0.0, 2.0 * np.pi / 7.0, periodic=True)
    assert basis @ values == pytest.approx(made, abs=1e-12)
    assert basis.sum(axis=1) == pytest.approx(1.0)


def test_the_angle_is_the_integral_of_the_shafts_speed():
    """omega = 120 cos(3 t), so the angle is 40 sin(3 t).

    The speed at the end of a step stands for the step: half a step's turn, 0.012 rad at most.
    """
    dt, n = 1e-3, 4000
    time = np.arange(n) * dt
    track = np.zeros((n, s.N_SIGNALS))
    track[:, s.T], track[:, s.OMEGA] = time, 120.0 * np.cos(3.0 * time)
    theta, active = theta_of(settings().rig, {"mine": checked("mine", RIPPLE)})
    which = len(NAMES)
    assert active[which] and o.turns(theta[slot_of(which)])
    out = np.zeros((n, s.N_CONTRIBUTIONS))
    contributions_along(track, dt, 10, theta, active, new_memory(), out)
    true = 8e-9 * np.cos(7.0 * 40.0 * np.sin(3.0 * time)) * track[:, s.OMEGA]
    assert out[:, s.FLOW_1] == pytest.approx(true, abs=7 * 0.012 * 8e-9 * 120.0)
    assert out[:, s.FLOW_2] == pytest.approx(-out[:, s.FLOW_1])


@pytest.mark.parametrize(("entry", "wanted"), [
    (RIPPLE, True), ({"adds": "force", "expression": "3*sin(angle)"}, True),
    ({"adds": "force", "expression": "3*sin(x)"}, False),
    ({"adds": "flow", "of": "angle", "first": 0.0, "last": 0.9, "values": [1.0, 0.0, -1.0]}, True),
    ({"adds": "flow", "of": "omega", "first": 0.0, "last": 0.9, "values": [1.0, 0.0, -1.0]},
     False)])
def test_which_terms_read_the_angle(entry, wanted):
    assert o.turns(slot_for(checked("mine", entry))) == wanted


def test_estimates_leave_a_ripple_out_and_are_no_worse_for_it():
    """The phase is not known in another recording, and over a revolution it is nothing."""
    run = simulated(SINE, 4.0, effects={"mine": RIPPLE})
    plain = run.config.model_copy(update={"effects": {}})
    one, two = (estimate(run.recording(seed=1), config) for config in (run.config, plain))
    for name in ("B", "beta_e"):
        assert one.parameters[name].value == pytest.approx(two.parameters[name].value, rel=1e-12)
        assert one.parameters[name].value == pytest.approx(
            {"B": run.config.rig.viscous_damping, "beta_e": run.config.rig.bulk_modulus}[name],
            rel=0.03)


def test_a_recording_that_begins_elsewhere_finds_its_own_angle():
    run = simulated(SINE, 4.0, effects={"mine": RIPPLE})
    recording, first = run.recording(seed=1), 1237
    later = replace(recording, channels={
        name: values[first:] for name, values in recording.channels.items()})
    angle = run.truth[first, s.ANGLE]
    experiment = at_its_angle(experiment_of([later], run.config))
    found = experiment.theta[slot_of(len(NAMES)).start + o.PHASE]
    assert np.cos(7.0 * (found - angle)) > np.cos(0.3)
    assert experiment.active.sum() == 1 and N_EFFECTS > 1


def test_a_formula_of_the_angle_says_how_often_in_a_revolution():
    shape = RIPPLES[0]
    text = shown_as(shape, Form("flow", "angle", "omega"), {"F": 6.6e-9, "n": 7.0, "a": 0.5})
    assert text == "0.0066 cm³/rad · cos(7 · θ − 500 mrad) · ω"
    at = np.linspace(0.0, 2.0 * np.pi / 7.0, 17, endpoint=False)
    (start,) = shape.starts(at, 3.0 * np.cos(7.0 * at - 0.5))
    assert start == pytest.approx({"F": 3.0, "n": 7.0, "a": 0.5})


@pytest.mark.slow  # a whole diagnosis that may fail guards nothing every day
@pytest.mark.xfail(reason="since the merge of 2026-11-24 the formula's phases end at another "
                   "optimum, 8 % behind the table, which then stands; right on each branch")
def test_a_pumps_ripple_is_learned_from_a_recording_with_its_order():
    """Of the independent plant: 6 % of the flow 7 times a turn, and 0.4 of that twice as often."""
    found = diagnosed("pump_ripple")
    (term,) = answer(found)["learned"]
    assert found.verdict == "unexplained" and term["of"] == ["angle", "omega"]
    assert term["held_out_error_removed"] > 0.9
    entry = term["entry"]
    assert entry["n"] == pytest.approx(7.0, rel=1e-3)
    assert entry["G"] / entry["F"] == pytest.approx(0.4, abs=0.08)
    assert answer(found)["parameters"]["after"]["B"]["value"] == pytest.approx(600.0, rel=0.03)
