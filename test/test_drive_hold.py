"""A drive with a lag whose command is held: told by its own speed, and in every model of it.

The rigs are of benchmarks/hold_parts, other equations in fine steps, but where the simulator is
asked.
"""

from dataclasses import replace

import numpy as np
import pytest
from hold_parts.plant import Motion, Noise, Rig, recorded

from eha_monitor.balances.measured import course_of
from eha_monitor.estimation.hold_choice import (
    evidence_of_drive,
    followed,
    lagged,
    resolved,
    weights_of,
)
from eha_monitor.estimation.pipeline import estimate
from eha_monitor.mismatch.data.experiment import experiment_of
from eha_monitor.mismatch.diagnose import diagnose
from eha_monitor.mismatch.holds import apart_under, as_it_reads
from eha_monitor.mismatch.name.nominal import nominal
from eha_monitor.physics.simulator import Simulator
from eha_monitor.settings import settings_from_tree

RICH = Motion((("triangle", 3.0, 0.03, 0.5), ("multisine", 3.0, 0.02, 2.0),
               ("sine", 2.0, 0.008, 3.0)))
SLOW = Rig(drive_lag=4e-3)
LATE = Rig(drive_lag=4e-3, command_delay=2e-3, feedback_delay=1e-3)
QUIET = Noise(1e-12, 1e-6, 1e-9)


USUAL = Noise()


def config(rig: Rig, noise: Noise = USUAL, **more):
    effects = {"drive_lag": {"tau": rig.drive_lag}} if rig.drive_lag else {}
    if rig.command_delay:
        effects |= {"command_delay": {"T": rig.command_delay},
                    "feedback_delay": {"T": rig.feedback_delay}}
    return settings_from_tree(rig.config(1e-3, noise, effects=effects, **more), "test")


@pytest.mark.parametrize("lag", [2e-4, 1e-3, 7e-3])
@pytest.mark.parametrize("held", [False, True])
def test_the_lag_is_followed_exactly(lag, held):
    """Against the integral of exp(-(t - s)/lag) u(s)/lag, by a fine sum."""
    dt, fine, n = 1e-3, 2000, 40
    u = np.random.default_rng(3).standard_normal(n)
    end = np.concatenate([u[:1], u[:-1]]) if held else u
    made = followed(u, end, lag, dt)
    omega, h = u[0], dt / fine
    for k in range(1, n):
        along = (np.arange(fine) + 0.5) / fine
        inside = u[k - 1] + along * (end[k] - u[k - 1])
        omega = omega * np.exp(-dt / lag) + np.sum(
            inside * np.exp(-(1.0 - along) * dt / lag)) * h / lag
        assert made[k] == pytest.approx(omega, abs=1e-4)


def test_without_a_lag_the_speed_is_the_input():
    assert weights_of(0.0, 1e-3) == (0.0, 0.0, 1.0)


def test_lag_and_gain_are_found():
    t = 1e-3 * np.arange(4000)
    u = 40.0 * np.sin(9.0 * t) + 20.0 * np.sin(31.0 * t)
    omega = 3.0 + 0.97 * followed(u, u, 5e-3, 1e-3)
    omega += 0.1 * np.random.default_rng(5).standard_normal(len(t))
    found = lagged(u, u, omega, np.arange(len(t)) % 7 > 0, 1e-3)
    assert found.lag == pytest.approx(5e-3, rel=2e-3)


@pytest.mark.parametrize("rig", [SLOW, LATE, replace(SLOW, coulomb=60.0)])
@pytest.mark.parametrize("digital", [False, True])
def test_behind_a_lag_the_speed_tells_whether_the_command_is_held(rig, digital):
    settings, decision = resolved([recorded(rig, RICH, 1e-3, digital)], config(rig))
    assert decision.decided and decision.channel == "x_d"
    assert settings.command_hold == ("sampled" if digital else "continuous")


def test_a_drive_that_no_lag_explains_is_not_asked():
    """A dead zone of the drive's own, and a speed that follows at each stamp."""
    rig = Rig()
    assert evidence_of_drive(recorded(rig, RICH, 1e-3, True), config(rig)) is None
    recording = recorded(SLOW, RICH, 1e-3, True)
    omega = recording.channels["omega"]
    dead = np.sign(omega) * np.maximum(np.abs(omega) - 8.0, 0.0)
    stuck = replace(recording, channels={**recording.channels, "omega": dead})
    assert evidence_of_drive(stuck, config(SLOW)) is None


@pytest.mark.parametrize("channel", ["x_d", "omega"])
def test_a_stretch_without_the_command_or_its_answer_says_nothing(channel):
    recording = recorded(SLOW, RICH, 1e-3, True)
    gone = recording.channels[channel].copy()
    gone[:-100] = np.nan
    cut = replace(recording, channels={**recording.channels, channel: gone})
    assert evidence_of_drive(cut, config(SLOW)) is None


def test_a_speed_without_noise_is_no_trouble():
    recording = recorded(SLOW, RICH, 1e-3, True, noise=QUIET)
    evidence, channel = evidence_of_drive(recording, config(SLOW, QUIET))
    assert evidence > 1e3 and channel == "x_d"


@pytest.mark.parametrize("rig", [SLOW, LATE])
@pytest.mark.parametrize("digital", [False, True])
def test_the_balances_follow_the_config_s_drive(rig, digital):
    """Its gain was 3.6 % low where command and position come late: the position came twice so."""
    course = course_of(recorded(rig, RICH, 1e-3, digital), config(rig))
    here = course.good
    columns = np.column_stack([course.wanted[here], np.ones(here.sum())])
    (gain, _), *_ = np.linalg.lstsq(columns, course.omega[here], rcond=None)
    assert gain == pytest.approx(1.0, abs=1e-3)
    left = course.omega[here] - columns @ [gain, 0.0]
    assert left.std() < 0.01 * course.omega[here].std()


@pytest.mark.parametrize("rig", [Rig(), SLOW, LATE])
@pytest.mark.parametrize("hold", ["continuous", "sampled"])
def test_the_simulator_s_digital_drive_is_another_program_s(rig, hold):
    motion = Motion((("sine", 2.0, 0.008, 3.0),))
    other = recorded(rig, motion, 1e-3, hold == "sampled", noise=QUIET)
    n = len(other)
    settings = config(rig, command_hold=hold, simulation={
        "noise": {"position": 0.0, "pressure": 0.0, "pump_speed": 0.0},
        "excitation": {"sine": {"kind": "sine", "duration": 2.0, "frequency": 3.0,
                                "amplitude": 0.008}}})
    settings = settings.model_copy(update={"rig": settings.rig.model_copy(update={
        "viscous_damping": rig.damping, "bulk_modulus": rig.bulk_modulus})})
    own = Simulator(settings).batch(n)
    assert np.abs(own["x"] - other.channels["x"]).max() < 2e-4 * np.ptp(other.channels["x"])


@pytest.mark.parametrize("known", [True, False])
def test_behind_a_lag_the_pressures_have_no_corners(known):
    """B paid for corners that they have not, whether the config has the lag or not."""
    settings = config(SLOW) if known else config(replace(SLOW, drive_lag=0.0))
    found = estimate(recorded(SLOW, RICH, 1e-3, True), settings)
    b = found.parameters["B"]
    assert b.status == "converged" and "B" not in found.model.tainted
    assert abs(b.value - SLOW.damping) < 3.0 * b.stddev
    if known:
        oil = found.parameters["beta_e"]
        assert abs(oil.value - SLOW.bulk_modulus) < min(2.0 * oil.stddev, 0.05 * oil.value)
    assert [one.kind for one in found.channels] == ["hold"]


def test_what_a_digital_drive_reads_is_found():
    """The sensor's noise, or a position of its own: the latter is the simulator's."""
    noise = Noise(position=8e-6)
    settings = config(SLOW, noise, command_hold="sampled")
    noisy = recorded(SLOW, RICH, 1e-3, True, noise=noise)
    quiet = recorded(SLOW, RICH, 1e-3, True, noise=replace(noise, position=1e-12))
    added = noise.position * np.random.default_rng(2).standard_normal(len(quiet))
    clean = replace(quiet, channels={**quiet.channels, "x": quiet.channels["x"] + added})
    assert as_it_reads(experiment_of([noisy], settings)).hears
    assert not as_it_reads(experiment_of([clean], settings)).hears


def test_what_the_other_hold_makes_of_a_number_is_known():
    recording = recorded(Rig(), RICH, 1e-3, False)
    flowing, held = (experiment_of([recording], config(Rig(), command_hold=hold))
                     for hold in ("continuous", "sampled"))
    fit = nominal(flowing)[1]
    same, other = apart_under(flowing, fit), apart_under(held, fit)
    assert same["beta_e"] < 1e-3 * Rig().bulk_modulus and same["B"] < 1e-3 * Rig().damping
    assert other["beta_e"] > max(5.0 * same["beta_e"], 1e6)


@pytest.mark.timeout(300)
def test_a_healthy_digital_drive_behind_its_lag_is_healthy():
    """A stranger's: "command 515 us late", or unexplained; by the config's word +21 % of scale."""
    found = diagnose([recorded(SLOW, RICH, 1e-3, True)], config(SLOW))
    assert found.verdict == "consistent" and found.command_hold == "sampled"
    for name, true in (("B", SLOW.damping), ("beta_e", SLOW.bulk_modulus)):
        assert abs(found.after[name].value - true) < 3.0 * found.after[name].stddev
        assert found.after[name].value == pytest.approx(true, rel=0.03)
