"""What is written can be read: by us, by rosbags, by mcap."""

import os
from pathlib import Path

import numpy as np
import pytest
from bag_tools import STORE, joint
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from mcap.reader import make_reader
from rig_tools import write_channels
from rosbags.highlevel import AnyReader

from eha_monitor.errors import InputError
from eha_monitor.recordings.bag import iter_raw, topics
from eha_monitor.recordings.read import read_recording
from eha_monitor.recordings.recording import CHANNELS, LARGEST, Recording
from eha_monitor.recordings.write import (
    BagWriter,
    ChannelWriter,
    TopicType,
    messages_of,
    write_recording,
)
from eha_monitor.settings import Settings

SETTINGS = Settings()
START = 1_700_000_000_123_456_789


def full(n=300, seed=0):
    rng = np.random.default_rng(seed)
    return {name: rng.standard_normal(n) for name in CHANNELS}


def assert_same(recording, channels):
    assert set(recording.channels) == set(channels)
    for name, values in channels.items():
        np.testing.assert_array_equal(recording.channels[name], values, err_msg=name)


@pytest.mark.parametrize("name", ["bag", "bag.mcap"])
@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_round_trip(tmp_path, name, compression):
    channels = full()
    path = tmp_path / name
    with ChannelWriter(path, tuple(channels), 1e-3, "eha", compression=compression,
                       start_ns=START) as writer:
        writer.write(channels)
    recording = read_recording(path, SETTINGS)
    assert_same(recording, channels)
    assert recording.losses == () and recording.start_ns == START
    assert [entry.name for entry in tmp_path.iterdir()] == [name]
    if name == "bag":
        assert sorted(p.name for p in path.iterdir()) == ["bag_0.mcap", "metadata.yaml"]


def cells(name):
    return st.floats(-LARGEST[name], LARGEST[name], width=64)


@settings(max_examples=40)
@given(data=st.data(), chosen=st.sets(st.sampled_from(CHANNELS), min_size=1),
       n=st.integers(2, 60), step=st.sampled_from([1e-3, 2.5e-4, 1 / 3000, 0.01, 0.02]))
def test_any_channels_come_back(tmp_path_factory, data, chosen, n, step):
    channels = {name: data.draw(arrays(float, n, elements=cells(name))) for name in sorted(chosen)}
    path = tmp_path_factory.mktemp("bag") / "bag.mcap"
    write_recording(path, Recording(step, channels, start_ns=START), SETTINGS)
    recording = read_recording(path, SETTINGS)
    assert_same(recording, channels)
    assert recording.sample_time == pytest.approx(step, rel=1e-6)


def test_gaps_stay_gaps(tmp_path):
    channels = full(1000)
    channels["x"][200:300] = np.nan
    for name in CHANNELS:
        channels[name][500:700] = np.nan
    recording = read_recording(write_channels(tmp_path / "bag", channels, SETTINGS), SETTINGS)
    assert_same(recording, channels)
    assert "no data from 0.500 s for 0.200 s" in recording.losses


def test_other_readers_agree(tmp_path):
    channels = full()
    path = write_channels(tmp_path / "bag", channels, SETTINGS, start_ns=START)
    with AnyReader([path]) as reader:
        counts = {c.topic: c.msgcount for c in reader.connections}
        found = {}
        for connection, stamp, raw in reader.messages():
            found.setdefault(connection.topic, []).append(
                (stamp, reader.deserialize(raw, connection.msgtype)))
    assert counts == dict.fromkeys(
        ["/eha/joint_states", "/eha/command", "/eha/pressure/chamber_1",
         "/eha/pressure/chamber_2", "/eha/temperature"], 300)
    assert {topic: len(rows) for topic, rows in found.items()} == counts
    for i, (stamp, message) in enumerate(found["/eha/joint_states"]):
        assert stamp == START + i * 1_000_000
        assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == stamp
        assert message.name == ["piston", "pump"]
        assert message.position[0] == channels["x"][i] and np.isnan(message.position[1])
        assert message.velocity.tolist() == [channels["v"][i], channels["omega"][i]]
        assert message.effort[0] == channels["force"][i] and np.isnan(message.effort[1])
    for i, (_, message) in enumerate(found["/eha/pressure/chamber_2"]):
        assert message.fluid_pressure == channels["p2"][i]
    with (path / "bag_0.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert summary.statistics.message_count == 1500
        assert reader.get_header().profile == "ros2"
        assert {s.encoding for s in summary.schemas.values()} == {"ros2msg"}
        assert sum(1 for _ in reader.iter_messages()) == 1500
    found = topics(path)
    assert "reliability: reliable" in found["/eha/command"].qos


def test_patched_bytes_equal_those_of_rosbags():
    x, omega = np.array([0.25, -1.5]), np.array([3.0, np.nan])
    stamps = np.array([START, START + 1_000_000])
    stream = messages_of({"x": x, "omega": omega}, stamps, "/eha")[0]
    assert stream.data.tobytes() == b"".join(
        joint(int(s), ("piston", "pump"), (a, np.nan), (np.nan, b))
        for s, a, b in zip(stamps, x, omega, strict=True))


def test_only_measured_joints_are_named(tmp_path):
    write_channels(tmp_path / "bag", {"x": np.arange(5.0)}, SETTINGS)
    for topic, msgtype, _, raw in iter_raw(tmp_path / "bag"):
        message = STORE.deserialize_cdr(raw, msgtype)
        assert topic == "/eha/joint_states" and message.name == ["piston"]
        assert len(message.position) == 1 and len(message.velocity) == 0


def test_existing_target_is_kept(tmp_path):
    path = write_channels(tmp_path / "bag", {"x": np.arange(5.0)}, SETTINGS)
    with pytest.raises(InputError, match="exists already"):
        write_channels(path, {"x": np.arange(9.0)}, SETTINGS)
    assert len(read_recording(path, SETTINGS)) == 5
    write_channels(path, {"x": np.arange(9.0)}, SETTINGS, overwrite=True)
    assert len(read_recording(path, SETTINGS)) == 9
    assert [entry.name for entry in tmp_path.iterdir()] == ["bag"]


@pytest.mark.parametrize("channels", [{}, {"x": np.empty(0)}, {"x": np.full(4, np.nan)}])
def test_nothing_to_write(tmp_path, channels):
    with pytest.raises(InputError, match="bag"):
        write_channels(tmp_path / "bag", channels, SETTINGS)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(os.geteuid() == 0, reason="root writes everywhere")
def test_unwritable_folder(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(InputError, match="cannot write bag"):
        write_channels(tmp_path / "bag", {"x": np.zeros(3)}, SETTINGS)


def test_parent_is_a_file(tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match="cannot write bag"):
        write_channels(tmp_path / "file" / "bag", {"x": np.zeros(3)}, SETTINGS)


def test_raw_writer_keeps_any_type_and_latching(tmp_path):
    path = tmp_path / "bag"
    text = STORE.types["std_msgs/msg/String"](data="hello")
    raw = bytes(STORE.serialize_cdr(text, "std_msgs/msg/String"))
    with BagWriter(path, {"/a": "std_msgs/msg/String"}) as writer:
        writer.write_raw("/a", 5, raw)
        writer.add_topic("/b", TopicType("std_msgs/msg/Int32", latched=True))
        writer.write_raw("/b", 7, b"\x00\x01\x00\x00\x07\x00\x00\x00")
    assert [row[:3] for row in iter_raw(path)] == [("/a", "std_msgs/msg/String", 5),
                                                   ("/b", "std_msgs/msg/Int32", 7)]
    assert "transient_local" in topics(path)["/b"].qos
    with AnyReader([path]) as reader:
        assert sum(1 for _ in reader.messages()) == 2
    with pytest.raises(InputError, match="is not known"):
        BagWriter(tmp_path / "c", {"/a": "no_msgs/msg/Such"})
    assert [entry.name for entry in tmp_path.iterdir()] == ["bag"]


def test_after_a_crash_the_temporary_file_is_readable(tmp_path):
    path = tmp_path / "bag"

    class Crash(RuntimeError):
        pass

    with pytest.raises(Crash), BagWriter(path, {"/eha/joint_states":
                                                "sensor_msgs/msg/JointState"}) as writer:
        for i in range(100):
            writer.write_raw("/eha/joint_states", START + i * 10**6,
                             joint(START + i * 10**6, position=(float(i),)))
        raise Crash
    assert not path.exists()
    left = Path(writer.temporary)
    recording = read_recording(left, SETTINGS)
    assert len(recording) == 100 and "truncated at byte" in recording.losses[0]


def test_after_ctrl_c_nothing_is_left_of_what_can_be_made_again(tmp_path):
    with pytest.raises(KeyboardInterrupt), ChannelWriter(
            tmp_path / "bag", ("x",), 1e-3, "/eha") as writer:
        writer.write({"x": np.linspace(0.0, 0.01, 100)})
        assert list(tmp_path.iterdir())
        raise KeyboardInterrupt
    assert not list(tmp_path.iterdir())


def test_killed_between_chunks(tmp_path):
    writer = BagWriter(tmp_path / "bag", {"/eha/joint_states": "sensor_msgs/msg/JointState"})
    for i in range(100):
        writer.write_raw("/eha/joint_states", START + i * 10**6,
                         joint(START + i * 10**6, position=(float(i),)))
        if i == 60:
            writer.flush()
    assert len(read_recording(writer.temporary, SETTINGS)) == 61  # nobody closed it
    writer.abort()


def contents(folder):
    return sorted((str(p.relative_to(folder)), p.is_dir() or p.read_bytes())
                  for p in folder.rglob("*"))


@pytest.mark.parametrize("held", [["thesis.tex"], ["a.mcap", "notes.txt"], ["metadata.yaml"],
                                  ["metadata.yaml", "a_0.db3"], ["deep/a.mcap"], []])
@pytest.mark.parametrize("name", ["folder", "folder.mcap"])
def test_overwrite_replaces_no_folder_but_a_bag(tmp_path, held, name):
    path = tmp_path / name
    path.mkdir()
    for entry in held:
        (path / entry).parent.mkdir(exist_ok=True)
        (path / entry).write_text("mine")
    before = contents(tmp_path)
    with pytest.raises(InputError, match="is no bag; refusing to overwrite it") as problem:
        write_channels(path, {"x": np.zeros(3)}, SETTINGS, overwrite=True)
    assert "\n" not in str(problem.value) and str(path) in str(problem.value)
    assert contents(tmp_path) == before


def test_overwrite_replaces_no_file_but_mcap(tmp_path):
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(InputError, match="is no bag"):
        write_channels(tmp_path / "thesis.tex", {"x": np.zeros(3)}, SETTINGS, overwrite=True)
    assert (tmp_path / "thesis.tex").read_text() == "mine"
    for name in ("bag", "bag.mcap"):
        for n in (3, 4):
            write_channels(tmp_path / name, {"x": np.zeros(n)}, SETTINGS, overwrite=True)
        assert len(read_recording(tmp_path / name, SETTINGS)) == 4
    assert sorted(p.name for p in tmp_path.iterdir()) == ["bag", "bag.mcap", "thesis.tex"]


def test_no_bag_onto_a_device_a_pipe_or_a_broken_link(tmp_path):
    os.mkfifo(tmp_path / "pipe.mcap")
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    (tmp_path / "zero.mcap").symlink_to("/dev/zero")
    for path in (Path("/dev/null"), *sorted(tmp_path.iterdir())):
        with pytest.raises(InputError, match="neither a regular file nor a folder"):
            write_channels(path, {"x": np.zeros(3)}, SETTINGS, overwrite=True)
    assert len(list(tmp_path.iterdir())) == 3 and not Path("/dev/null").is_file()


def test_a_linked_bag_loses_its_link_only(tmp_path, monkeypatch):
    write_channels(tmp_path / "bag", {"x": np.zeros(3)}, SETTINGS)
    (tmp_path / "link").symlink_to("bag")
    write_channels(tmp_path / "link", {"x": np.zeros(5)}, SETTINGS, overwrite=True)
    assert len(read_recording(tmp_path / "bag", SETTINGS)) == 3
    assert len(read_recording(tmp_path / "link", SETTINGS)) == 5
    monkeypatch.chdir(tmp_path)
    for path in (".", "..", "/"):
        with pytest.raises(InputError, match=r"exists already|is no bag"):
            write_channels(path, {"x": np.zeros(3)}, SETTINGS, overwrite=True)


def test_what_came_meanwhile_is_kept(tmp_path):
    path = tmp_path / "bag"
    with (pytest.raises(InputError, match=r"is no bag; .*; the bag is left as"),
          BagWriter(path, {"/a": "std_msgs/msg/String"}, overwrite=True)):
        path.mkdir()
        (path / "thesis.tex").write_text("mine")
    assert (path / "thesis.tex").read_text() == "mine"
