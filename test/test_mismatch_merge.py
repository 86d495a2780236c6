"""Names that one after the other were taken give way to what explains them together."""

from types import SimpleNamespace

import pytest
from rig_tools import settings, simulated, without

from eha_monitor.mismatch.contest import contenders
from eha_monitor.mismatch.experiment import experiment_of
from eha_monitor.mismatch.merge import merged, singles_of
from eha_monitor.mismatch.diagnose import diagnose
from eha_monitor.mismatch.screen import Start, own_sizes
from eha_monitor.mismatch.search import Candidate, Round, first_fit, settle, with_effect

TWO_SPEEDS = {"kind": "multisine", "amplitude": 0.02, "frequency": 0.3, "frequency_end": 6.0,
              "components": 8, "seed": 3}


def recorded(effects, seed=0):
    return simulated(TWO_SPEEDS, 8.0, effects=effects).recording(seed)


def entered(experiment, fit, **effects):
    for name, values in effects.items():
        start = Start(name, tuple(values.items()))
        fit = settle(experiment, with_effect(fit, start, (1.0,) * len(own_sizes(start))), 1, 4)
    return fit


FRICTION = {"F_c": 20.0, "v_e": 1e-3, "z_0": 1e-6, "t_1": 1e-4, "v_d": 5e-3}


@pytest.mark.parametrize("truth, expected", [
    ({"asymmetric_friction": {"F_c": 20.0, "dF": 6.0}}, ("asymmetric_friction",)),
    ({"coulomb_friction": {"F_c": 20.0}, "spring_load": {"k": 4000.0}}, None)])
def test_one_effect_takes_the_place_of_two_where_it_explains_as_much(truth, expected):
    """Coulomb friction and a load are asymmetric friction; Coulomb and a spring are two things."""
    experiment = experiment_of([without(recorded(truth), "x_d", "omega", "v", "force")],
                               settings(), False)
    second = {"constant_load": {"F_0": 3.0}} if expected else {"spring_load": {"k": 3000.0}}
    fit = entered(experiment, first_fit(experiment), coulomb_friction=FRICTION, **second)
    assert fit.named == ("coulomb_friction", *second)
    one = merged(experiment, fit, lambda other, name: 20.0)
    assert (one and one.named) == expected


def test_what_may_stand_for_two_contains_one_of_them():
    experiment = experiment_of([recorded({})], settings(), False)
    fit = SimpleNamespace(named=("coulomb_friction", "constant_load", "cross_port_leakage"),
                          theta=experiment.theta)
    names = {start.effect for start in singles_of(
        experiment, fit, ("coulomb_friction", "constant_load"))}
    assert {"coulomb_friction", "constant_load", "asymmetric_friction",
            "stribeck_friction"} <= names
    assert not names & {"cross_port_leakage", "spring_load", "quadratic_friction"}


def test_what_still_gains_beside_the_whole_model_contends_in_its_balance():
    def candidate(effect, gain):
        return Candidate(Start(effect, ()), None, gain)

    def beside(*named):
        return SimpleNamespace(named=named)

    rounds = (Round(beside(), (), (candidate("pressure_offset", 2000.0),
                                   candidate("pressure_drift", 100.0))),
              Round(beside("pressure_offset"), (), (candidate("pressure_scale", 106.0),
                                                    candidate("spring_load", 90.0))))
    found = contenders(rounds, beside("pressure_offset"), "pressure_offset")
    assert [one.effect for one in found] == ["pressure_scale"]


def test_where_pressures_are_the_force_a_load_may_be_theirs():
    recording = recorded({"constant_load": {"F_0": 30.0}})
    blind = diagnose([without(recording, "x_d", "omega", "v", "force")], settings(),
                     calibrate=False)
    assert [(e.name, e.indistinguishable_from) for e in blind.effects] == [
        ("constant_load", ("pressure_offset", "pressure_scale"))]
    seen = diagnose([recording], settings(), calibrate=False)
    assert [(e.name, e.indistinguishable_from) for e in seen.effects] == [("constant_load", ())]
