"""Whether the drive holds its command: asked of the recording, in estimate, live and diagnose.

The rig is one of its own (benchmarks/hold_parts): other areas, fine steps, a controller that
computes from the noisy sensor once in a sample.
"""

from contextlib import suppress
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from hold_parts.draws import drawn
from hold_parts.plant import PHYSICS, Motion, Noise, Rig, recorded

from eha_monitor.errors import InputError
from eha_monitor.estimation.hold_choice import gain_followed, resolved
from eha_monitor.estimation.pipeline import estimate
from eha_monitor.estimation.results import NoiseEstimate
from eha_monitor.live.estimator import LiveEstimator
from eha_monitor.mismatch.advise.separate import simulated
from eha_monitor.mismatch.data.experiment import experiment_of
from eha_monitor.mismatch.likelihood.fit import filtered
from eha_monitor.mismatch.likelihood.gains import gains_of
from eha_monitor.mismatch.name.nominal import nominal
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings import settings_from_tree

RICH = Motion((("triangle", 3.0, 0.03, 0.5), ("multisine", 3.0, 0.02, 2.0),
               ("sine", 2.0, 0.008, 3.0)))
SLOW = Motion((("triangle", 6.0, 0.002, 0.1),))
ISSUE = Rig(coulomb=60.0)  # B 900, beta_e 700 MPa


def config(rig: Rig, rate: float, **more):
    return settings_from_tree(rig.config(1.0 / rate, Noise(), **more), "test")


@lru_cache(maxsize=16)
def run(rig: Rig, rate: float, digital: bool, motion: Motion = RICH, every: int = 1):
    return recorded(rig, motion, 1.0 / rate, digital, every=every)


def off(parameter, truth: float) -> float:
    """Standard deviations between an estimate and the truth."""
    return abs(parameter.value - truth) / parameter.stddev


@pytest.mark.parametrize(("off_by", "found"), [(1.0, 1.0), (1.04, 1.0), (0.95, 1.0),
                                               (1.2, None), (0.5, None)])
def test_the_gain_is_what_the_pump_follows_within_its_tolerance(off_by, found):
    rng, gain, rows = np.random.default_rng(4), 23000.0, 4000
    t = 1e-3 * np.arange(rows)
    error, noise = 1e-3 * np.sin(7.0 * t), {"x": 2e-6, "omega": 0.1}
    channels = {"x_d": error, "x": noise["x"] * rng.standard_normal(rows)}
    channels["omega"] = gain * (error - channels["x"]) + noise["omega"] * rng.standard_normal(rows)
    channels["omega"][100:110] = np.nan
    rig = settings_from_tree({"rig": {"position_gain": off_by * gain}}, "test").rig
    levels = {name: NoiseEstimate(value, "config") for name, value in noise.items()}
    told = gain_followed(channels, levels, rig)
    if found is None:  # a gain that is wrong is a finding, and not put right in silence
        assert told is None
    elif off_by == 1.0:  # the config's, to the last bit
        assert told == gain
    else:
        assert told == pytest.approx(gain, rel=1e-3)
    without = {name: values for name, values in channels.items() if name != "omega"}
    assert gain_followed(without, levels, rig) == rig.position_gain


# ---- offline ----------------------------------------------------------------------------------


@pytest.mark.parametrize("rate", [500.0, 1000.0])
def test_a_digital_drive_is_found_and_nothing_pays_for_it(rate):
    rig = Rig()
    found = estimate(run(rig, rate, True), config(rig, rate))
    b, beta = found.parameters["B"], found.parameters["beta_e"]
    assert beta.status == b.status == "converged"
    assert off(b, rig.damping) < 3 and off(beta, rig.bulk_modulus) < 3
    assert beta.value == pytest.approx(rig.bulk_modulus, rel=0.01)
    assert found.model.status == "consistent" and found.settings.command_hold == "sampled"
    (finding,) = found.channels
    assert finding.kind == "hold" and finding.channels == ("x_d",)
    assert finding.correction == {"command_hold": "sampled"}
    assert finding.finding.startswith("the drive holds its command over each sample")
    assert "odds beyond 10 000 to 1 over a continuous one" in finding.finding


def test_dry_friction_hides_no_hold():
    """The issue's rig: beta_e was 93 ± 0.9 MPa and converged, with 700 true."""
    found = estimate(run(ISSUE, 1000.0, True), config(ISSUE, 1000.0))
    assert found.settings.command_hold == "sampled" and found.channels
    # What is left is the friction's doing, and is said so.
    assert found.model.status == "mismatch" and set(found.model.tainted) == {"B", "beta_e"}


@pytest.mark.parametrize("rig", [Rig(), ISSUE, Rig(quadratic=3000.0, leak=1e-12)])
def test_an_analogue_drive_holds_nothing(rig):
    found = estimate(run(rig, 1000.0, False), config(rig, 1000.0))
    assert found.settings.command_hold == "continuous" and not found.channels
    settings, decision = resolved([run(rig, 1000.0, False)], config(rig, 1000.0))
    assert decision.decided and decision.hold == settings.command_hold == "continuous"
    forced = estimate(run(rig, 1000.0, False), config(rig, 1000.0, command_hold="continuous"))
    assert found.parameters == forced.parameters


def test_the_pump_speed_alone_tells_it_too():
    rig = Rig()
    whole = run(rig, 1000.0, True)
    recording = replace(whole, channels={name: values for name, values in whole.channels.items()
                                         if name != "x_d"})
    found = estimate(recording, config(rig, 1000.0))
    assert found.channels[0].channels == ("omega",)
    assert off(found.parameters["beta_e"], rig.bulk_modulus) < 3


def test_a_config_that_says_it_is_not_asked():
    recording, settings = run(Rig(), 1000.0, True), config(Rig(), 1000.0, command_hold="sampled")
    same, decision = resolved([recording], settings)
    assert same is settings and decision is None
    assert not estimate(recording, settings).channels


@pytest.mark.parametrize("digital", [False, True])
def test_where_nothing_tells_it_does_not_matter(digital):
    """A motion too slow: continuous or not, no converged number that the other hold denies."""
    rig = Rig()
    recording = run(rig, 2000.0, digital, SLOW)
    _, decision = resolved([recording], config(rig, 2000.0))
    assert not decision.decided and "does not show" in decision.sentence
    found = estimate(recording, config(rig, 2000.0))
    beta = found.parameters["beta_e"]
    assert not found.channels
    assert beta.status != "converged" or off(beta, rig.bulk_modulus) < 3


@pytest.mark.parametrize(("every", "motion"), [(2, RICH), (3, RICH), (2, replace(RICH, seed=5))])
def test_a_slower_controller_is_no_right_answer(every, motion):
    """A controller at half the recording's rate is neither hold, and is not told as one."""
    rig = Rig()
    found = estimate(run(rig, 1000.0, True, motion, every), config(rig, 1000.0))
    beta = found.parameters["beta_e"]
    assert (found.model.status == "mismatch" or beta.status != "converged"
            or off(beta, rig.bulk_modulus) < 3)


def test_fresh_rigs_are_decided_rightly():
    """Draws with and without other physics; without any, never wrongly."""
    wrong, undecided, clean = [], [], 0
    for draw in drawn(24, 9):
        settings = settings_from_tree(draw.rig.config(1.0 / draw.rate, draw.noise), draw.name)
        _, decision = resolved([draw.recording()], settings)
        right = (decision.hold == "sampled") == draw.digital
        if decision.decided and not right:
            wrong.append(draw)
        if not draw.extras:
            clean += 1
            undecided += [] if decision.decided else [draw]
    assert not [draw.name for draw in wrong if not draw.extras]
    assert len(wrong) <= 2 and len(undecided) <= clean // 3


def test_the_stated_sigma_behind_a_digital_drive():
    """Stage two was off by 34 of its own sigmas (rms of 33 clean draws), with the hold known."""
    offs = []
    for draw in drawn(40, 1):
        if not draw.digital or draw.kind == "slow" or draw.rate < 500.0:
            continue
        draw = replace(draw, rig=replace(draw.rig, **dict.fromkeys(PHYSICS, 0.0)),
                       channels=("x", "x_d", "p1", "p2"))
        found = estimate(draw.recording(), settings_from_tree(
            draw.rig.config(1.0 / draw.rate, draw.noise, command_hold="sampled"), draw.name))
        beta = found.parameters["beta_e"]
        if beta.status == "converged":
            offs.append(off(beta, draw.rig.bulk_modulus))
    assert len(offs) > 6 and np.sqrt(np.mean(np.square(offs))) < 2.0


# ---- live -------------------------------------------------------------------------------------


@pytest.mark.parametrize("digital", [True, False])
def test_the_monitor_asks_its_own_rows(digital):
    rig = Rig()
    recording = run(rig, 1000.0, digital)
    live = LiveEstimator(config(rig, 1000.0))
    events = []
    for start in range(0, len(recording), 10):
        part = recording.part(start, start + 10)
        live.push_rows(recording.time[start:start + 10], part.channels)
        if start % 500 == 0:
            events += live.snapshot().events
    end = live.snapshot()
    told = [event for event in events if "holds its command" in event.message
            or "command is continuous" in event.message]
    assert len(told) == 1 and told[0].time_s < 3.0
    assert told[0].message.startswith("the drive holds") == digital
    beta = end.parameters["beta_e"]
    assert beta.status == "converged" and off(beta, rig.bulk_modulus) < 3
    assert end.model.status == "consistent"


# ---- diagnosis --------------------------------------------------------------------------------


@pytest.mark.slow  # a whole diagnosis that may fail guards nothing every day
@pytest.mark.xfail(strict=False, reason="pressure friction is named, and Coulomb friction is not "
                   "told as its rival at a constant mean pressure")
@pytest.mark.timeout(400)
def test_after_write_config_the_promise_holds(tmp_path):
    """The issue: beta_e 680.9 ± 0.24 MPa for 700 after the diagnosis, and a mismatch."""
    from eha_monitor.api.diagnose import written_config
    from eha_monitor.mismatch.diagnose import diagnose
    from eha_monitor.settings import load_settings

    recording, settings = run(ISSUE, 1000.0, True), config(ISSUE, 1000.0)
    found = diagnose([recording], settings)
    assert found.verdict == "mismatch" and found.command_hold == "sampled"
    assert [one.kind for one in found.channels] == ["hold"]
    assert [effect.name for effect in found.effects] == ["coulomb_friction"]
    assert found.effects[0].parameters["F_c"].value == pytest.approx(60.0, rel=0.01)
    path = tmp_path / "after.yaml"
    path.write_text(written_config(found, settings, None), encoding="utf-8")
    after = load_settings(path)
    assert after.command_hold == "sampled"
    again = estimate(recording, after)
    assert again.model.status == "consistent" and not again.model.tainted
    beta, b = again.parameters["beta_e"], again.parameters["B"]
    assert beta.status == "converged" and off(beta, ISSUE.bulk_modulus) < 3
    # Beside B the friction was fitted to the same data; its own uncertainty is B's.
    assert abs(b.value - ISSUE.damping) < 3 * np.hypot(b.stddev, found.after["B"].stddev)


# ---- simulated recordings ----------------------------------------------------------------------


def test_a_held_input_stays_held_in_a_simulated_recording():
    """Its drive holds, and reads what it shows without the noise: so it is explained, to 1 %."""
    experiment, fit = nominal(experiment_of(
        [run(Rig(), 500.0, True)], config(Rig(), 500.0, command_hold="sampled")))
    assert experiment.held and experiment.hears
    made = simulated(experiment, fit)
    assert made.held and not made.hears
    right, wrong = (np.concatenate([filtered(
        replace(made, held=held), stretch, fit.theta, fit.active,
        gains_of(replace(made, held=held), fit.theta, fit.active, fit.unknowns))[0][200:]
        for stretch in made.stretches]) for held in (True, False))
    for column in (0, 2, 3, 4):
        assert np.nanstd(right[:, column]) == pytest.approx(made.noise[column], rel=0.1)
    assert np.nanstd(wrong[:, 2]) > 2.0 * made.noise[2]


# ---- what a user sees ------------------------------------------------------------------------


def test_the_answer_says_it_once_in_words_json_and_config(tmp_path, capsys):
    import json

    from eha_monitor.cli import main
    from eha_monitor.recordings.write import write_recording
    from eha_monitor.settings import load_settings
    from eha_monitor.settings.load import annotated

    settings = config(Rig(), 1000.0)
    rig, bag = tmp_path / "rig.yaml", tmp_path / "bag"
    rig.write_text(annotated(settings, "a rig"), encoding="utf-8")
    write_recording(bag, run(Rig(), 1000.0, True), settings)
    assert main(["estimate", str(bag), "--config", str(rig), "--json", str(tmp_path / "a.json"),
                 "--report", str(tmp_path / "a.html"),
                 "--write-config", str(tmp_path / "b.yaml")]) == 0
    words = "the drive holds its command over each sample (a digital controller)"
    assert " ".join(capsys.readouterr().out.split()).count(words) == 1
    (entry,) = json.loads((tmp_path / "a.json").read_text(encoding="utf-8"))["channels"]
    assert entry["finding"].startswith(words) and entry["kind"] == "hold"
    assert entry["channels"] == ["x_d"] and entry["correction"] == {"command_hold": "sampled"}
    assert words in (tmp_path / "a.html").read_text(encoding="utf-8")
    assert load_settings(tmp_path / "b.yaml").command_hold == "sampled"


@pytest.mark.filterwarnings("error")
def test_any_numbers_have_an_answer():
    rng = np.random.default_rng(0)
    for _ in range(60):
        n, channels = int(rng.choice([300, 400, 1500])), {}
        for name in ("x", "x_d", "omega", "p1", "p2"):
            values = 10.0 ** rng.uniform(-12, 18) * rng.standard_normal(n)
            kind = rng.integers(6)
            if kind == 1:
                values[:] = values[0]
            elif kind == 2:
                values = np.cumsum(values)
            elif kind == 3:
                values[rng.random(n) < 0.5] = np.nan
            elif kind == 4:
                values[rng.integers(n)] = np.inf
            if kind != 5:
                channels[name] = values
        with suppress(InputError):  # numbers that no sensor can show are refused in one line
            resolved([Recording(1e-3, channels)], config(Rig(), 1000.0))
