"""The bag of a diagnosis, read back by rosbags and by mcap."""

from pathlib import Path

import numpy as np
import pytest
from command_tools import refused
from mcap.reader import make_reader
from rig_tools import MULTISINE, SINE, motion, settings
from rosbags.highlevel import AnyReader

from eha_monitor.cli import main
from eha_monitor.errors import InputError
from eha_monitor.mismatch.show.series import series_of, write_diagnosis_bag
from eha_monitor.physics.simulator import Simulator
from eha_monitor.recordings.recording import Recording

SECONDS, DT, START = 3.0, 1e-3, 1_700_000_000_000_000_000
FRICTION = {"coulomb_friction": {"F_c": 40.0, "v_e": 1e-3}}


@pytest.fixture(scope="module")
def rubbing_series():
    """A recording with friction, and its signals under a config that knows it."""
    shape = {**SINE, "frequency": 1.0}
    before = settings(simulation=motion(shape, SECONDS))
    after = settings(simulation=motion(shape, SECONDS), effects=FRICTION)
    recording = Recording(DT, Simulator(after, seed=1).advance(round(SECONDS / DT)),
                          source="rubbing", start_ns=START)
    return recording, series_of([recording], before, after)


def floats(path):
    """Return topic -> (times in s since the start, values) of the bag's numbers, by rosbags."""
    found = {}
    with AnyReader([path]) as reader:
        for connection, stamp, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            kind = connection.msgtype.rsplit("/", 1)[-1]
            value = {"Float64": lambda m: m.data, "FluidPressure": lambda m: m.fluid_pressure,
                     "JointState": lambda m: m.position[0]}[kind](message)
            if kind != "Float64":
                stamped = message.header.stamp
                assert stamped.sec * 1_000_000_000 + stamped.nanosec == stamp
            found.setdefault(connection.topic, []).append((1e-9 * (stamp - START), value))
    return {topic: np.array(rows).T for topic, rows in found.items()}


def test_the_bag_holds_what_was_missing(rubbing_series, tmp_path):
    recording, series = rubbing_series
    write_diagnosis_bag(tmp_path / "out", series, [recording], "/eha")
    found = floats(tmp_path / "out")
    time, needed = found["/eha/missing/force/needed"]
    assert time[0] == pytest.approx(0.0, abs=1e-6) and len(time) == len(recording)
    # The truth, from the simulator's own velocity: 40 N against the motion.
    truth = Simulator(settings(simulation=motion({**SINE, "frequency": 1.0}, SECONDS),
                               effects=FRICTION)).advance_truth(len(recording))[:, 2]
    moving = np.abs(truth) > 0.01
    wanted = 40.0 * np.sign(truth)
    assert np.abs(needed - wanted)[moving].max() < 2.0
    assert np.abs(found["/eha/missing/force/explained"][1] - wanted)[moving].max() < 0.5
    assert np.abs(found["/eha/missing/force/remaining"][1]).max() < 2.0
    assert np.abs(found["/eha/missing/drive/needed"][1]).max() < 1.0
    x = found["/eha/measured/joint_states"][1]
    np.testing.assert_allclose(x, recording.channels["x"])
    assert np.std(x - found["/eha/modelled/joint_states"][1]) < 3e-6
    p1 = found["/eha/measured/pressure/chamber_1"][1]
    assert np.std(p1 - found["/eha/modelled/pressure/chamber_1"][1]) < 2e3


def test_foxglove_s_reader_finds_standard_types(rubbing_series, tmp_path):
    recording, series = rubbing_series
    write_diagnosis_bag(tmp_path / "one.mcap", series, [recording], "/rig_7")
    with (tmp_path / "one.mcap").open("rb") as stream:
        summary = make_reader(stream).get_summary()
    kinds = {summary.schemas[one.schema_id].name for one in summary.channels.values()}
    assert kinds == {"sensor_msgs/msg/JointState", "sensor_msgs/msg/FluidPressure",
                     "std_msgs/msg/Float64"}
    topics = {one.topic for one in summary.channels.values()}
    assert {f"/rig_7/missing/{balance}/{part}" for balance in ("force", "flow", "drive")
            for part in ("needed", "explained", "remaining")} <= topics
    assert summary.statistics.message_start_time == START


def test_recordings_that_overlap_follow_one_another(rubbing_series, tmp_path):
    recording, series = rubbing_series
    other = Recording(DT, recording.channels, source="again", start_ns=START)
    from dataclasses import replace

    both = [*series, *(replace(one, source="again") for one in series)]
    write_diagnosis_bag(tmp_path / "out", both, [recording, other], "")
    time = floats(tmp_path / "out")["/missing/force/needed"][0]
    assert (np.diff(time) > 0).all() and time[-1] > 2 * SECONDS


def test_balances_as_they_stand_make_a_bag_too(tmp_path):
    """A rig that only tells its force: no pressures, no pump."""
    tree = {"rig": {"name": "bench"}, "simulation": motion(MULTISINE, 4.0, publish=["x", "force"],
                                                           noise={"force": 0.5})}
    after = settings(**tree, effects=FRICTION)
    recording = Recording(DT, Simulator(after, seed=2).advance(4000), source="bench")
    series = series_of([recording], settings(**tree), after)
    write_diagnosis_bag(tmp_path / "out", series, [recording], "/eha")
    found = floats(tmp_path / "out")
    needed = found["/eha/missing/force/needed"][1]
    assert np.sqrt(np.mean(needed**2)) == pytest.approx(40.0, rel=0.15)


def test_without_a_model_there_is_no_bag(tmp_path, capsys):
    (tmp_path / "rest.yaml").write_text(
        "simulation: {excitation: {rest: {kind: rest, duration: 2.0}}}\n")
    bag, out = str(tmp_path / "bag"), tmp_path / "out"
    assert main(["simulate", "--config", str(tmp_path / "rest.yaml"), "--out", bag]) == 0
    assert main(["diagnose", bag, "--out-bag", str(out)]) == 0
    assert "not written, there is no model" in capsys.readouterr().out
    assert not out.exists()


@pytest.mark.slow
def test_diagnose_writes_the_bag(tmp_path, capsys):
    bundled = Path(__file__).parents[1] / "bags" / "hidden_friction"
    assert main(["diagnose", str(bundled), "--out-bag", str(tmp_path / "why")]) == 0
    assert "why: 11.0 s, topics /eha/measured/joint_states" in capsys.readouterr().out
    found = floats(tmp_path / "why")
    for part, size in (("needed", 39.3), ("explained", 39.3), ("remaining", 0.0)):
        rms = np.sqrt(np.mean(found[f"/eha/missing/force/{part}"][1] ** 2))
        assert rms == pytest.approx(size, abs=0.3)


def test_a_place_that_is_taken_is_refused_before_the_work(tmp_path, capsys):
    taken = tmp_path / "taken"
    taken.mkdir()
    bag = str(tmp_path / "bag")
    assert main(["simulate", "--duration", "1", "--out", bag]) == 0
    for place, words in ((taken, "exists already"), (bag, "is a bag that is read"),
                         (tmp_path / "no" / "where", "does not exist")):
        capsys.readouterr()
        assert words in refused(capsys, "diagnose", bag, "--out-bag", place)
    with pytest.raises(InputError, match="exists already"):
        write_diagnosis_bag(taken, [], [], "/eha")
