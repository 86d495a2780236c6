"""Any numbers whatever in a recording: an answer that means something, or one line and exit 2."""

import math
import re
import warnings

import numpy as np
import pytest
from command_tools import refused
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from rig_tools import MULTISINE, SINE, copies, one_by_one, settings, simulated

from eha_monitor.breakdown import begins_anew, computing
from eha_monitor.cli import main
from eha_monitor.errors import InputError
from eha_monitor.estimation.pipeline import estimate
from eha_monitor.live.estimator import LiveEstimator
from eha_monitor.live.faults import FaultWatch
from eha_monitor.live.rows import Rows, Source
from eha_monitor.mismatch.diagnose import diagnose
from eha_monitor.recordings.read import read_recording
from eha_monitor.recordings.recording import LARGEST, LIMITS, Recording
from eha_monitor.recordings.write import write_recording
from eha_monitor.settings import Settings

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")
CHANNELS = tuple(LIMITS)
EXTREMES = (math.inf, -math.inf, math.nan, 1e308, -1e308, 1e155, 1e30, -1e30, 1e14, 1e-308, 0.0)


@pytest.fixture(scope="module")
def recording():
    return simulated(SINE, 3.0).recording(0)


def run_away(recording):
    """Pressures that grow tenfold every other sample from 1.5 s on, up to 1e30, then NaN."""
    channels = copies(recording)
    for name in ("p1", "p2"):
        growth = 10.0 ** np.minimum(np.arange(len(recording) - 1500) / 2.0, 24.0)
        channels[name][1500:] = 1e6 * growth
        channels[name][1560:] = np.nan
    return channels


def raw_bag(path, channels):
    """Write a bag as somebody else's recorder does: it asks nobody whether a number can be."""
    clean = {name: np.zeros_like(values) for name, values in channels.items()}
    made = Recording(1e-3, clean, 1_700_000_000_000_000_000)
    made.channels.update(channels)
    return str(write_recording(path, made, Settings()))


@pytest.mark.parametrize("command", [
    ["estimate"], ["diagnose"], ["advise", "--no-check"]],
    ids=lambda words: words[0])
def test_a_simulation_that_ran_away_is_one_line(recording, tmp_path, capfd, command):
    bag = raw_bag(tmp_path / "bag", run_away(recording))
    err = refused(capfd, command[0], bag, *command[1:])
    assert bag in err and "p1 is out of range: " in err, err
    assert "at t = 1.515 s" in err and "Pa" in err, err


def test_imported_it_is_one_line(tmp_path, capfd):
    table = tmp_path / "a.csv"
    rows = [f"{k * 1e-3},{0.01 * math.sin(k / 30)},{10.0 ** (k / 10):g}" for k in range(400)]
    table.write_text("t,x,p\n" + "\n".join(rows))
    (tmp_path / "map.yaml").write_text(
        "table: {time: t, columns: {x: {column: x}, p1: {column: p}}}")
    out = tmp_path / "bag"
    assert "a.csv: p1 is out of range" in refused(
        capfd, "import", table, "--map", tmp_path / "map.yaml", "--out", out)
    assert not out.exists()


@pytest.mark.parametrize("key", ["scale", "offset"])
def test_a_channel_that_the_config_makes_huge_is_one_line(recording, tmp_path, capfd, key):
    bag = raw_bag(tmp_path / "bag", recording.channels)
    (tmp_path / "rig.yaml").write_text(f"channels: {{p1: {{{key}: 1.0e+300}}}}")
    assert "p1" in refused(capfd, "estimate", bag, "--config", tmp_path / "rig.yaml")


def test_a_few_wild_values_are_left_out_and_told(recording, tmp_path):
    channels = copies(recording)
    channels["p1"][[500, 501, 900]] = 1e40, -1e25, 1e19
    channels["x"][1200] = np.inf
    read = read_recording(raw_bag(tmp_path / "bag", channels), Settings())
    for found in (read, Recording(1e-3, channels)):
        assert np.isnan(found.channels["p1"][[500, 501, 900]]).all()
        assert any("p1: 3 of 3000 values are not valid measurements (1e+40 Pa at t = 0.500 "
                   "s" in loss
                   for loss in found.losses)
        assert any("x: 1 of 3000 values are infinite" in loss for loss in found.losses)
    assert estimate(read, settings()).parameters["B"].value == pytest.approx(600.0, rel=0.02)


def test_mistakes_of_unit_are_far_inside():
    """What a mistake of unit makes of a recording is to be told as such, not refused here."""
    for name, usual, wrong in (("x", 0.5, 1e6), ("x_d", 0.5, 1e6), ("p1", 4e7, 1e5),
                               ("omega", 500.0, 60.0), ("force", 1e6, 1e3)):
        assert usual * wrong <= LARGEST[name] / 2, name


values_anywhere = st.one_of(
    st.sampled_from(EXTREMES), st.floats(),
    st.floats(-300, 300).map(lambda power: 10.0 ** power))


KINDS = ("lone", "tail", "all", "gain", "offset", "scattered")
spoilt = st.lists(st.tuples(st.sampled_from(CHANNELS), st.sampled_from(KINDS), values_anywhere,
                            st.floats(0.0, 1.0, exclude_max=True)), min_size=1, max_size=3)
lengths = st.sampled_from([3, 400, 1200])
kept_channels = st.none() | st.sets(st.sampled_from(CHANNELS), min_size=1)


def hostile(recording, spoils, n, kept):
    """Return a good recording's first samples with extremes: lone, a stretch, or throughout."""
    channels = {name: values[:n].copy() for name, values in recording.channels.items()}
    for name, kind, extreme, place in spoils:
        values, at = channels.setdefault(name, np.zeros(n)), int(place * n)
        with np.errstate(all="ignore"):
            if kind == "gain":
                values *= extreme
            elif kind == "offset":
                values += extreme
            else:
                values[{"lone": slice(at, at + 1), "tail": slice(at, None), "all": slice(None),
                        "scattered": slice(None, None, 2 + at % 50)}[kind]] = extreme
    return {name: values for name, values in channels.items() if kept is None or name in kept}


@given(spoilt, lengths, kept_channels)
@hypothesis_settings(max_examples=100, deadline=20_000)
def test_any_values_give_an_estimate_or_one_line(recording, spoils, n, kept):
    channels = hostile(recording, spoils, n, kept)
    try:
        found = estimate(Recording(1e-3, channels), settings())
    except InputError as problem:
        assert "\n" not in str(problem)
        return
    for parameter in found.parameters.values():
        number = math.isfinite(parameter.value) and math.isfinite(parameter.stddev)
        assert number == (parameter.status in ("converged", "not_excited"))
    assert found.model.status in ("consistent", "mismatch", "not_judged")


def test_pressures_that_are_never_both_there_are_no_warning(recording):
    channels = {name: values[:3].copy() for name, values in recording.channels.items()}
    channels["p1"][1:], channels["p2"][:1] = math.inf, math.inf
    assert estimate(Recording(1e-3, channels), settings()).parameters


def test_one_pressure_beside_a_measured_force_is_no_flow_balance(recording):
    channels = {name: values[:1200].copy() for name, values in recording.channels.items()
                if name in ("x", "omega", "p1")}
    force = 0.01 * np.gradient(channels["x"])
    assert estimate(Recording(1e-3, channels | {"force": force}), settings()).parameters


@given(spoilt, lengths, kept_channels)
@hypothesis_settings(max_examples=30, deadline=20_000)
def test_any_values_leave_the_live_estimator_standing(recording, spoils, n, kept):
    channels = hostile(recording, spoils, n, kept)
    estimator = LiveEstimator(settings())
    for k in range(0, n, 10):
        rows = {name: values[k:k + 10] for name, values in channels.items()}
        if rows:
            estimator.push_rows(1e-3 * np.arange(k, k + len(next(iter(rows.values())))), rows)
    for parameter in estimator.snapshot().parameters.values():
        assert math.isfinite(parameter.value) == (parameter.status in ("converged", "not_excited"))


def test_any_values_through_the_command_line(recording, tmp_path, capfd):
    """Bags of extremes, one kind in each channel: no traceback and no warning on the terminal."""
    for i, name in enumerate(("x", "x_d", "omega", "p1", "p2")):
        for j, extreme in enumerate((math.inf, 1e308, 1e12, 1e-308)):
            channels = copies(recording.part(0, 1500))
            channels[name][700:] = extreme
            bag = raw_bag(tmp_path / f"bag{i}{j}", channels)
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                assert main(["estimate", bag]) in (0, 2)
            assert capfd.readouterr().err.count("\n") <= 1


def test_a_breakdown_of_the_numbers_is_one_line_that_names_the_recording(recording):
    """Within the limits, and hardly anything that a filter's gains can be computed from.

    Whether they can be is decided by rounding (it differs between kernels of the linear algebra);
    then nothing is named.
    """
    channels = {name: values[:1000] for name, values in copies(recording).items()}
    channels["x"] *= 1e7
    try:
        found = diagnose([Recording(1e-3, channels, source="wild_bag")], settings())
    except InputError as problem:
        assert re.match(r"wild_bag: the calculation broke down \(", str(problem))
    else:
        assert not found.effects and not found.rig_data


def test_a_defect_is_no_breakdown():
    with pytest.raises(ValueError, match="too many values"), computing("bag"):
        _, _ = 1, 2, 3
    with pytest.raises(InputError, match=r"bag: .* broke down \(float div"), computing("bag"):
        _ = 1.0 / float("0")


def test_what_breaks_a_calculation_is_told_and_begun_anew():
    said = []

    class Estimator:
        reset = staticmethod(said.append)

        @begins_anew
        def push(self, problem):
            raise problem

    Estimator().push(FloatingPointError("the covariance is no longer positive"))
    assert said == ["the numbers of the channels broke the calculation "
                    "(the covariance is no longer positive)"]
    with pytest.raises(KeyError):
        Estimator().push(KeyError("a defect"))


def test_where_stage_two_alone_broke_down_stage_one_goes_on():
    recording, estimator = simulated(MULTISINE, 8.0).recording(), LiveEstimator(
        settings(implausible="warn"))
    for k in range(0, len(recording), 10):
        wild = {"x_d": np.full(10, 1e9)} if 1000 <= k < 1300 else {}
        estimator.push_rows(1e-3 * np.arange(k, k + 10), recording.part(k, k + 10).channels | wild)
        if k == 1290:
            during = estimator.snapshot()
    assert any(event.stage == "two" and "begins anew later" in event.message
               for event in during.events), during.events
    assert during.parameters["B"].status == "converged"
    assert "broke down" in during.parameters["beta_e"].message
    for name, true in (("B", 600.0), ("beta_e", 600e6)):
        found = estimator.snapshot().parameters[name]
        assert found.status == "converged" and found.value == pytest.approx(true, rel=0.02)


def test_live_a_value_that_no_sensor_shows_is_left_out_and_named():
    source = Source("joint_states (piston)", ("x",))
    watch = FaultWatch([source], 1e-3, 0.05)
    rows = Rows(np.arange(3), {"x": np.array([1e-3, 1e30, np.inf]), "p1": np.full(3, 2e6)},
                np.zeros(3))
    assert [row for _, row in one_by_one(watch.take(rows))] == [
        {"x": 1e-3, "p1": 2e6}, {"p1": 2e6}, {"p1": 2e6}]
    watch.look(1.0)
    assert watch.sentences(1.0) == ["x: inf m is not a valid measurement (beyond ±1e+09 m), left "
                                    "out"]
