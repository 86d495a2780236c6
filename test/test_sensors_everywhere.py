"""A sensor's error in every place that has to know it, for each that the catalogue holds.

What is shown is the simulator's; the filters undo it, the diagnosis says by how much it errs and
where, and the Modelica text writes it.  An effect that one of them does not know fails here.
"""

from types import SimpleNamespace

import numpy as np
import pytest
from rig_tools import MULTISINE, SENSORS, SILENT, T_S, motion, settings

from eha_monitor.estimation.results import NoiseEstimate
from eha_monitor.estimation.sensors import undo_sensors
from eha_monitor.exports import modelica
from eha_monitor.mismatch.locate.terms import erring_outputs, modelled_error
from eha_monitor.mismatch.show.model import _CIRCUIT_WORDS
from eha_monitor.physics import signals as s
from eha_monitor.physics.contributions import circuit_of
from eha_monitor.physics.effect import no_circuit
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.physics.parameters import theta_of
from eha_monitor.physics.simulator import Simulator

N = 1500
AFTER = slice(300, N - 100)  # past what a delay takes at either end
SHOWN = {"x": (0, s.X), "p1": (2, s.P1), "p2": (3, s.P2)}
CIRCUIT = [name for name, one in CATALOGUE.items() if one.circuit is not no_circuit]
SENSOR = [name for name in CIRCUIT if CATALOGUE[name].balance == "sensor"]


def values_of(name):
    """Return a size that shows of each parameter, the drive reading the true position."""
    return {p.name: 0.0 if p.name == "in_loop" else p.scale for p in CATALOGUE[name].parameters}


def recorded(name):
    """Return what the sensors show, channel -> (N,), and the truth, (N, N_SIGNALS)."""
    def rig():
        return Simulator(settings(effects={name: values_of(name)}, simulation=motion(
            MULTISINE, N * T_S, noise=SILENT, publish=SENSORS)))

    return rig().advance(N), rig().advance_truth(N)


def model(name=None):
    theta, active = theta_of(settings().rig, {name: values_of(name)} if name else {})
    return SimpleNamespace(theta=theta, active=active)


def by_trajectory(truth):
    """Return the truth as the diagnosis has it, (N, N_SIGNALS)."""
    found = np.zeros((N, s.N_SIGNALS))
    found[:, s.T] = np.arange(N) * T_S
    for place in (s.X, s.P1, s.P2):
        found[:, place] = truth[:, place]
    return found


@pytest.mark.parametrize("name", SENSOR)
def test_filters_undo_it(name):
    shown, truth = recorded(name)
    noise = {one: NoiseEstimate(1e-12, True) for one in shown}
    w = circuit_of(model(name).theta, model(name).active)
    undone, _ = undo_sensors(shown, noise, w, np.arange(N) * T_S)
    for channel, (_, place) in SHOWN.items():
        error = np.abs(shown[channel] - truth[:, place])[AFTER].max()
        left = np.abs(undone[channel] - truth[:, place])[AFTER]
        assert np.nanmax(left) <= max(0.05 * error, 1e-9 * np.ptp(truth[:, place]))


@pytest.mark.parametrize("name", SENSOR)
def test_the_diagnosis_knows_which_sensor_errs_and_by_how_much(name):
    shown, truth = recorded(name)
    erring = erring_outputs(model(), model(name))
    for channel, (output, place) in SHOWN.items():
        error = shown[channel] - truth[:, place]
        assert (output in erring) == (np.abs(error).max() > 1e-9 * np.abs(truth[:, place]).max())
        if output in erring:
            said = modelled_error(model(name), by_trajectory(truth), output)
            assert said[AFTER] == pytest.approx(error[AFTER], abs=0.05 * np.abs(error).max())


@pytest.mark.parametrize("name", CIRCUIT)
def test_its_size_has_a_unit_and_words(name):
    changed = circuit_of(model(name).theta, model(name).active) != circuit_of(
        model().theta, model().active)
    assert changed.any()
    assert set(np.flatnonzero(changed)) <= {*_CIRCUIT_WORDS, s.IN_LOOP}


@pytest.mark.parametrize("name", SENSOR)
def test_modelica_writes_what_the_sensors_show(name):
    shown, truth = recorded(name)
    time = np.arange(N) * T_S
    w = circuit_of(model(name).theta, model(name).active)
    known = {"x": truth[:, s.X], "p1": truth[:, s.P1], "p2": truth[:, s.P2], "time": time,
             "delay": lambda values, late: np.interp(time - late, time, values)}
    if name == "backlash":  # a state of the model, which follows the play
        known["x"] = shown["x"]
    for line in modelica._sensors(w):
        channel, _, text = line.partition("_measured = ")
        error = np.abs(shown[channel] - truth[:, SHOWN[channel][1]]).max()
        assert eval(text, {"__builtins__": {}}, known)[AFTER] == pytest.approx(
            shown[channel][AFTER], abs=max(0.05 * error, 1e-9 * np.abs(shown[channel]).max()))
