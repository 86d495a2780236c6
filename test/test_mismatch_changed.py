"""A parameter that changes while a recording runs is told from physics that is missing."""

from dataclasses import replace

import numpy as np
import pytest
from mismatch_tools import nominal_fit
from rig_tools import BETA, SINE, B, settings, simulated

from eha_monitor.api.diagnose import answer
from eha_monitor.mismatch.data.experiment import experiment_of
from eha_monitor.mismatch.data.inputs import cut
from eha_monitor.mismatch.diagnose import diagnose
from eha_monitor.mismatch.diagnosis import NamedEffect, Value, health_sentences
from eha_monitor.mismatch.name.naming import Naming
from eha_monitor.mismatch.policy import POLICY
from eha_monitor.mismatch.show.changed import change_words, changed_between
from eha_monitor.recordings.recording import Recording

AIR = {"fault": {"parameter": "bulk_modulus", "start": 5.0, "value": 3e8}}


def asked(*recordings):
    """Ask of the nominal model alone, as after a search that found no name."""
    experiment = experiment_of(list(recordings), settings(), True)
    fit = nominal_fit(experiment)
    return changed_between(list(recordings), Naming(experiment, fit, fit))


@pytest.mark.parametrize("parameter, value", [("viscous_damping", 900.0), ("bulk_modulus", 3e8)])
def test_a_step_parts_the_recording_and_each_piece_has_its_own_values(parameter, value):
    run = simulated(SINE, 10.0, faults={"fault": {"parameter": parameter, "start": 5.0,
                                                  "value": value}})
    found = asked(run.recording(0))
    one, other = found.pieces
    assert (one.start_s, other.stop_s) == (0.0, pytest.approx(10.0))
    assert 3.0 < one.stop_s < 5.0 < other.start_s < 6.5
    key, before = ("B", B) if parameter == "viscous_damping" else ("beta_e", BETA)
    assert one.values[key].value == pytest.approx(before, rel=0.01)
    assert other.values[key].value == pytest.approx(value, rel=0.01)
    said = change_words(found.pieces, POLICY)
    assert said.startswith("B changed" if key == "B" else "the effective bulk modulus changed")
    assert "No effect is missing" in said and said.count("changed between") == 1


def test_a_constant_rig_has_no_pieces():
    assert asked(simulated(SINE, 10.0).recording(0)) is None


def test_recordings_of_one_rig_before_and_after():
    one = replace_source(simulated(SINE, 6.0).recording(0), "monday")
    softer = simulated(SINE, 6.0, rig={"bulk_modulus": 4e8})
    other = replace_source(softer.recording(1), "friday")
    found = asked(one, other)
    assert [piece.bag for piece in found.pieces] == ["monday", "friday"]
    assert [piece.values["beta_e"].value for piece in found.pieces] == [
        pytest.approx(6e8, rel=0.01), pytest.approx(4e8, rel=0.01)]
    assert "changed from monday to friday from" in change_words(found.pieces, POLICY)


def test_friction_is_no_change():
    """B differs by speed beside dry friction; no piece fits, as each has reversals."""
    run = simulated(SINE, 10.0, effects={"coulomb_friction": {"F_c": 40.0}})
    slow = simulated({**SINE, "amplitude": 0.003}, 10.0,
                     effects={"coulomb_friction": {"F_c": 40.0}})
    assert asked(replace_source(run.recording(0), "fast"),
                 replace_source(slow.recording(1), "slow")) is None


def test_a_piece_is_the_same_data_and_is_fitted_where_the_whole_was():
    experiment = experiment_of([simulated(SINE, 6.0).recording(0)], settings(), True)
    whole = experiment.stretches[0]
    part = cut(whole, 1000, 4000, 1e-3)
    assert part.start == pytest.approx(whole.start + 1.0) and len(part) == 3000
    assert np.array_equal(part.z, whole.z[1000:4000], equal_nan=True)
    assert not part.counted[:150].any()
    assert np.array_equal(part.counted[150:], whole.counted[1150:4000])


@pytest.mark.slow
def test_the_whole_answer_on_air_that_enters():
    recording = simulated(SINE, 10.0, faults=AIR).recording(0)
    found = diagnose([recording], settings())
    assert (found.verdict, found.effects) == ("consistent", ())
    assert found.after["beta_e"].value == pytest.approx(3e8, rel=0.01)
    (begin, end), = found.location.intervals_s
    assert begin < 5.0 < end
    assert found.signals["position"].after_rms == pytest.approx(
        found.signals["position"].noise_rms, rel=0.1)
    assert found.signals["position"].before_rms > 1.5 * found.signals["position"].noise_rms
    tree = answer(found)
    assert tree["policy"] == POLICY.to_dict() and len(tree["policy"]) <= 20
    assert [piece["parameters"]["beta_e"]["value"] for piece in tree["pieces"]] == [
        pytest.approx(6e8, rel=0.01), pytest.approx(3e8, rel=0.01)]


def replace_source(recording: Recording, name: str) -> Recording:
    return replace(recording, source=name)


def test_a_term_has_one_size_in_a_sentence():
    """One page had "190 N of Coulomb friction" beside "F_c = 170 N"."""
    effect = NamedEffect("coulomb_friction", "force", "Coulomb friction of 170 N",
                         {"F_c": Value(170.0, 70.0, "N")}, 9.0, (), "", "", "190 N")
    before, after = ({"B": Value(b, 50.0, "N·s/m")} for b in (2200.0, 800.0))
    assert health_sentences(before, after, [effect]) == (
        "B read 2200 N·s/m; 1400 N·s/m of it is Coulomb friction, not wear",)
