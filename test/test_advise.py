"""Advice: what a recording tells apart, the motion that would, and that it does in simulation."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_tools import refused
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from mismatch_tools import nominal_fit

from eha_monitor.api.advise import written_excitation
from eha_monitor.cli import main
from eha_monitor.concealed.cases import Case, triangle
from eha_monitor.concealed.generate import nominal_config, recording_of
from eha_monitor.mismatch.advise import advice as advise
from eha_monitor.mismatch.advise.identifiability import Reading, directions_for, largest_cosine
from eha_monitor.mismatch.advise.motions import candidates, excitation_tree, limits_for, planned
from eha_monitor.mismatch.advise.words import amount, motion_sentence, rounded
from eha_monitor.mismatch.data.experiment import experiment_of
from eha_monitor.mismatch.likelihood.fit import with_unknowns
from eha_monitor.mismatch.likelihood.information import Traces, free_slopes
from eha_monitor.mismatch.name.naming import Naming
from eha_monitor.mismatch.name.refit import settled
from eha_monitor.mismatch.name.starts import starts_of, with_effect
from eha_monitor.physics.simulator import Simulator, demanded_position
from eha_monitor.recordings.recording import Recording
from eha_monitor.recordings.write import write_recording
from eha_monitor.settings import load_settings
from eha_monitor.settings.load import settings_from_tree

SPEED = 0.04  # m/s of the triangle
F_C = 40.0  # N that the catalogue's clear case hides


def experiment_with(*effects, demand=None, noise=1.0):
    """A recording by the independent plant; a triangle at one speed unless told."""
    time = np.arange(6000) * 1e-3
    x_d = triangle(time, 3.0, SPEED * 0.75) if demand is None else demand
    case = Case("case", effects, demand=x_d, seed=2, noise=noise)
    channels, _ = recording_of(case)
    return experiment_of([Recording(1e-3, channels, source="case")],
                         settings_from_tree(nominal_config(case), "case"), hold_out=False)


@pytest.fixture(scope="module")
def plain():
    """A triangle on the rig as it is, and its fit."""
    experiment = experiment_with()
    return experiment, nominal_fit(experiment)


@pytest.fixture(scope="module")
def hiding():
    """A triangle that hides Coulomb friction, without and with it in the fit."""
    experiment = experiment_with(("coulomb_friction", 1.0))
    first = nominal_fit(experiment)

    theta = first.theta.copy()
    for f in first.free:
        if "." not in f.name:
            theta[f.place] = f.outward(f.prior)
    start = starts_of("coulomb_friction", experiment)[0]
    start = replace(start, values=tuple({**dict(start.values), "F_c": 30.0}.items()))
    entered = with_effect(replace(first, theta=theta), start, ())
    return experiment, first, settled(experiment, with_unknowns(
        experiment, entered, entered.unknowns))


@pytest.fixture(scope="module")
def advised(hiding):
    experiment, _, fit = hiding
    return advise.advice(experiment, fit, {})


def test_plateaus_of_one_speed_cannot_tell_b_from_coulomb_friction(advised):
    one = next(c for c in advised.confusions
               if (c.parameter, c.effect) == ("B", "coulomb_friction"))
    assert one.named
    assert abs(one.plateau_correlation) > 0.9999
    assert one.plateau_inflation > 1e3
    assert one.amount == pytest.approx(F_C, rel=0.05)
    assert one.plateau_shift == pytest.approx(one.amount / SPEED, rel=0.03)  # F_c / v0
    assert abs(one.correlation) < abs(one.plateau_correlation)


def test_second_motion_settles_it_and_the_simulation_agrees(advised):
    doubt = next(d for d in advised.doubts if d.parameter == "B")
    assert doubt.steady and doubt.now < 1.0 and doubt.then >= advise.DECISIVE
    check = next(c for c in advised.checks if c.rival == "")
    assert check.found >= advise.DECISIVE
    assert 0.5 < check.found / check.predicted < 2.0  # log units, either way
    found, _, true = check.values["B"]
    assert found == pytest.approx(true, rel=0.02)


def test_what_no_motion_separates_is_a_check_at_the_rig(hiding):
    """At constant mean pressure Coulomb and pressure friction are one thing."""
    experiment, _, fit = hiding
    found = advise.advice(experiment, fit, {"coulomb_friction": ("pressure_friction",)},
                          check=False, thorough=False)
    doubt = next(d for d in found.doubts if d.rival == "pressure_friction")
    assert doubt.now < advise.DECISIVE
    text = " ".join(advise.sentences(found))
    if not doubt.then >= advise.DECISIVE:
        assert "distinguishes Coulomb friction from pressure friction" in text
        assert "raise the charge pressure" in text


def test_words_say_what_how_much_and_what_next(advised):
    text = "\n".join(advise.sentences(advised))
    assert "B and Coulomb friction are indistinguishable at constant speed" in text
    assert "correlation 1.000" in text
    assert "N·s/m" in text
    assert "record also" in text and "by odds of" in text
    assert "checked in simulation" in text
    assert "nan" not in text and "np." not in text


def test_quick_advice_says_the_same_first(hiding, advised):
    experiment, first, fit = hiding
    naming = Naming(experiment, first, fit, evidence={"coulomb_friction": 1e3},
                    rivals={"coulomb_friction": ()})
    quick = advise.advice_for(experiment, naming)
    assert quick[0].split(":")[0] == advise.sentences(advised)[0].split(":")[0]
    assert not any("checked" in text for text in quick)


def test_motions_keep_the_limits_of_the_recording(plain):
    experiment, fit = plain
    limits = limits_for(experiment)
    motions = candidates(limits)
    assert len({motion.name for motion in motions}) == len(motions) > 15
    assert [m.duration for m in motions] == sorted(m.duration for m in motions)
    for motion in motions:
        ran = planned(experiment, fit, limits, motion).stretches[0]
        x, omega = ran.z[:, 0], ran.z[:, 4]
        assert np.abs(omega).max() <= 1.02 * limits.pump_speed, motion.name
        assert np.abs(x - limits.middle).max() <= 1.05 * limits.reach, motion.name


def test_motion_is_an_excitation_that_the_simulator_runs(plain):
    for motion in candidates(limits_for(plain[0])):
        tree = {"simulation": {"excitation": excitation_tree(motion)}}
        segments = settings_from_tree(tree, "advice").simulation.excitation
        time = np.arange(0.0, motion.duration, 0.01)
        assert np.allclose(demanded_position(segments, time),
                           demanded_position(motion.segments, time), atol=1e-6)
        assert motion_sentence(motion)


def test_information_adds_up_and_a_second_speed_brings_the_inflation_down():
    """The design's figure: 4.5 with two speeds where one has a million."""
    time = np.arange(6000) * 1e-3
    inflations = []
    for slow in (1.0, 0.25):
        x_d = np.where(time < 3.0, triangle(time, 3.0, 0.03), slow * triangle(time, 3.0, 0.03))
        experiment = experiment_with(demand=x_d)
        fit = nominal_fit(experiment)
        base = free_slopes(fit)
        directions, slopes = directions_for(experiment, fit, ["coulomb_friction"])
        traces = Traces(experiment, fit, [*base, *slopes])
        gram = traces.gram([s.label for s in [*base, *slopes]])
        assert np.allclose((gram + gram).whole, 2 * gram.whole)
        reading = Reading(fit, gram, base, directions)
        d = reading.directions[0]
        part = reading.correlation(d.label, "B", [
            label for label in reading.labels if label != "B"], steady=True)
        inflations.append(1.0 / (1.0 - min(part**2, 1 - 1e-12)))
    assert inflations[0] > 1e3
    assert 2.0 < inflations[1] < 20.0


def test_just_visible_effect_is_visible(plain):
    """What is said to show from a size on gains that much in the likelihood of the fit."""
    experiment, fit = plain
    found = advise.advice(experiment, fit, {}, check=False)
    seen = {limit.effect: limit for limit in found.detection_limits}
    assert seen["constant_load"].gain > seen["quadratic_friction"].gain
    assert seen["constant_load"].visible < seen["constant_load"].matters
    assert seen["coulomb_friction"].visible < 5.0  # N, of 24 N that this motion takes


def test_without_areas_it_says_what_is_missing(plain):
    experiment, fit = plain
    rig = experiment.settings.rig.model_copy(update={"pump_displacement": None})
    bare = replace(experiment, settings=experiment.settings.model_copy(update={"rig": rig}))
    found = advise.advice(bare, fit, {})
    assert not found.plannable and found.motion is None and not found.tried
    assert "lacks the areas or the pump data" in " ".join(advise.sentences(found))


@given(st.floats(1e-9, 1e9))
@hypothesis_settings(max_examples=50)
def test_amounts_are_round_and_readable(value):
    assert 0.39 * value < rounded(value) <= value * 1.00001
    assert "e+" not in amount(rounded(value), "N") and "e-" not in amount(rounded(value), "N")


def test_cosine_of_spaces():
    a, b = np.eye(3)[:2], np.array([[0.0, 1.0, 0.0]])
    assert largest_cosine(a @ a.T, a @ b.T, b @ b.T) == pytest.approx(1.0)
    c = np.array([[0.0, 0.0, 1.0]])
    assert largest_cosine(a @ a.T, a @ c.T, c @ c.T) == pytest.approx(0.0, abs=1e-12)


def test_command_prints_advice_and_writes_it(tmp_path, capsys):
    case = Case("case", demand=triangle(np.arange(3000) * 1e-3, 3.0, 0.03), seed=1)
    channels, _ = recording_of(case)
    bag = write_recording(tmp_path / "bag", Recording(1e-3, channels), load_settings(None))
    answer, motion = tmp_path / "a.json", tmp_path / "m.yaml"
    assert main(["advise", str(bag), "--no-check", "--json", str(answer),
                 "--write-excitation", str(motion)]) == 0
    out = capsys.readouterr().out
    assert "βe" in out and "variance inflation" in out
    tree = json.loads(answer.read_text())
    assert tree["schema"] == "eha_monitor/advice/1" and tree["advice"]
    assert motion.exists() == (tree["motion"] is not None)


def test_written_excitation_is_a_config_that_runs(plain, tmp_path):
    motion = candidates(limits_for(plain[0]))[-1]
    path = tmp_path / "motion.yaml"
    path.write_text(written_excitation(motion, load_settings(None), (Path("bag"),)))
    settings = load_settings(path)
    assert list(settings.simulation.excitation) == list(motion.segments)
    assert len(Simulator(settings).advance(100)["x"]) == 100


@pytest.mark.parametrize(("arguments", "words"), [
    ([], "Missing argument 'BAG [BAG ...]'"),
    (["missing_bag"], "missing_bag: no such bag"),
    (["a", "a"], "is given twice"),
    (["a", "--json", "missing/x.json"], "the folder missing does not exist"),
    (["a", "--json", "x.out", "--write-excitation", "x.out"], "name the same file"),
    (["a", "--config", "missing.yaml"], "missing.yaml: cannot read config"),
])
def test_bad_usage_is_one_line(capsys, arguments, words):
    assert words in refused(capsys, "advise", *arguments)


def test_rig_with_a_measured_force_gets_a_motion_too():
    """No pump is known: the motion keeps the recording's speed, travel and force."""
    time = np.arange(6000) * 1e-3
    case = Case("case", demand=triangle(time, 12.0, SPEED * 0.75), seed=2)  # it turns round once
    channels, _ = recording_of(case)
    force = 5.05e-4 * (channels["p1"] - channels["p2"])
    rig = {"area_1": None, "area_2": None, "volume_1": None, "volume_2": None,
           "pump_displacement": None, "position_gain": None}
    experiment = experiment_of([Recording(1e-3, {"x": channels["x"], "force": force})],
                               settings_from_tree({"rig": rig}, "case"), hold_out=False)
    found = advise.advice(experiment, advise.yielding(experiment, nominal_fit(experiment)), {})
    doubt = next(d for d in found.doubts if d.effect == "coulomb_friction")
    assert doubt.now < advise.DECISIVE
    assert found.motion is not None and doubt.then > advise.DECISIVE
    assert found.checks[0].found > advise.DECISIVE
