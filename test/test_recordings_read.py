"""Bags of all forms come in as the same recording."""

import shutil

import numpy as np
import pytest
import zstandard
from bag_tools import (
    JOINT,
    PRESSURE,
    START,
    STORE,
    contract_messages,
    header,
    joint,
    motion,
    number,
    pressure,
    write_mcap,
)
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter

from eha_monitor.errors import InputError
from eha_monitor.recordings.bag import iter_raw, topics
from eha_monitor.recordings.read import read_recording
from eha_monitor.settings import Settings, settings_from_tree

N = 500
SETTINGS = Settings()


def with_channels(**channels):
    return settings_from_tree({"channels": channels}, "test")


def check(recording, n=N):
    _, x, p = motion(n)
    assert list(recording.channels) == ["x", "omega", "p1"]
    assert recording.sample_time == 1e-3 and recording.start_ns == START
    np.testing.assert_array_equal(recording.channels["x"], x)
    np.testing.assert_array_equal(recording.channels["omega"], 10 * x)
    np.testing.assert_array_equal(recording.channels["p1"], p)


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
@pytest.mark.parametrize("chunked", [True, False])
def test_single_file(tmp_path, compression, chunked):
    path = write_mcap(tmp_path / "a.mcap", contract_messages(N), compression=compression,
                      chunked=chunked)
    recording = read_recording(path, SETTINGS)
    check(recording)
    assert recording.losses == () and recording.source == str(path)


def test_without_summary_and_checksums(tmp_path):
    path = write_mcap(tmp_path / "a.mcap", contract_messages(N), library_options={
        "enable_crcs": False, "use_statistics": False, "repeat_channels": False,
        "repeat_schemas": False, "use_summary_offsets": False})
    check(read_recording(path, SETTINGS))


def rosbags_bag(path, mode):
    with RosbagsWriter(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        pass
    shutil.rmtree(path)
    writer = RosbagsWriter(path, version=9, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for topic, msgtype, stamp, data in contract_messages(N):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, msgtype, typestore=STORE)
            writer.write(connections[topic], stamp, data)
    return path


@pytest.mark.parametrize("mode", [CompressionMode.NONE, CompressionMode.FILE,
                                  CompressionMode.MESSAGE, CompressionMode.STORAGE])
def test_bags_of_rosbags(tmp_path, mode):
    path = rosbags_bag(tmp_path / "bag", mode)
    recording = read_recording(path, SETTINGS)
    check(recording)
    assert recording.losses == ()
    assert sum(1 for _ in iter_raw(path)) == 2 * N
    assert topics(path)["/eha/joint_states"].count == N


def test_split_bag_in_order_of_parts(tmp_path):
    messages = list(contract_messages(N))
    for part in range(11):  # part 10 sorts before part 2 as text
        chosen = messages[part * 100:(part + 1) * 100 if part < 10 else None]
        if chosen:
            write_mcap(tmp_path / f"bag_{part}.mcap", chosen)
    recording = read_recording(tmp_path, SETTINGS)
    check(recording)
    assert recording.losses == ()


def test_listed_part_that_is_missing_is_said(tmp_path):
    path = rosbags_bag(tmp_path / "bag", CompressionMode.NONE)
    metadata = path / "metadata.yaml"
    text = metadata.read_text().replace("  relative_file_paths:\n",
                                        "  relative_file_paths:\n  - bag_7.mcap\n")
    metadata.write_text(text.replace(f"message_count: {2 * N}", "message_count: 5000"))
    losses = read_recording(path, SETTINGS).losses
    assert "bag_7.mcap is listed in metadata.yaml and is missing" in losses
    assert f"metadata.yaml declares 5000 messages, {2 * N} were found" in losses


def test_packed_single_file(tmp_path):
    path = write_mcap(tmp_path / "a.mcap", contract_messages(N))
    packed = tmp_path / "a.mcap.zstd"
    packed.write_bytes(zstandard.compress(path.read_bytes()))
    check(read_recording(packed, SETTINGS))


def test_names_in_another_order_frames_and_endianness(tmp_path):
    messages, stamps = [], motion(N)[0].tolist()
    for i, stamp in enumerate(stamps):
        names, position = ("piston", "pump"), (float(i), -1.0)
        if i % 3 == 1:
            names, position = names[::-1], position[::-1]
        messages.append(("/eha/joint_states", JOINT, stamp, joint(
            stamp, names, position, frame="f" * (i % 5), little_endian=i % 7 != 0)))
    recording = read_recording(write_mcap(tmp_path / "a.mcap", messages), SETTINGS)
    np.testing.assert_array_equal(recording.channels["x"], np.arange(N))
    assert list(recording.channels) == ["x"]  # empty velocity and effort: not recorded


def test_missing_name_is_a_gap(tmp_path):
    messages = [("/eha/joint_states", JOINT, int(s), joint(
        int(s), ("piston",) if not 100 <= i < 150 else ("other",), (float(i),)))
        for i, s in enumerate(motion(N)[0])]
    recording = read_recording(write_mcap(tmp_path / "a.mcap", messages), SETTINGS)
    assert len(recording) == N
    assert np.isnan(recording.channels["x"][100:150]).all()
    assert np.isfinite(recording.channels["x"]).sum() == N - 50
    assert recording.losses == ("no data from 0.100 s for 0.050 s",)


def test_other_types_scale_offset_and_log_time(tmp_path):
    pose_type = "geometry_msgs/msg/PoseStamped"
    types = STORE.types
    point, turn = types["geometry_msgs/msg/Point"], types["geometry_msgs/msg/Quaternion"]
    messages = []
    for stamp, x, p in zip(*motion(N), strict=True):
        pose = types[pose_type](
            header=header(int(stamp), "base"), pose=types["geometry_msgs/msg/Pose"](
                position=point(x=1e3 * x + 5.0, y=0.0, z=0.0),
                orientation=turn(x=0.0, y=0.0, z=0.0, w=1.0)))
        messages.append(("/rig/pose", pose_type, int(stamp),
                         bytes(STORE.serialize_cdr(pose, pose_type))))
        messages.append(("/rig/pump", "std_msgs/msg/Float64", int(stamp), number(p)))
        array = types["std_msgs/msg/Float64MultiArray"](
            layout=types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0),
            data=np.array([1.0, x, 2.0]))
        messages.append(("/rig/array", "std_msgs/msg/Float64MultiArray", int(stamp),
                         bytes(STORE.serialize_cdr(array, "std_msgs/msg/Float64MultiArray"))))
    settings = with_channels(
        x={"topic": "/rig/pose", "field": "pose.position.x", "scale": 1e-3, "offset": -5e-3},
        p1={"topic": "pump", "field": "data"}, v={"topic": "array", "field": "data[1]"})
    recording = read_recording(write_mcap(tmp_path / "a.mcap", messages), settings)
    _, x, p = motion(N)
    np.testing.assert_allclose(recording.channels["x"], x, atol=1e-15)
    np.testing.assert_array_equal(recording.channels["p1"], p)
    np.testing.assert_array_equal(recording.channels["v"], x)


def test_type_that_only_the_bag_defines(tmp_path):
    definition = "uint8 flag\nstring text\nfloat32[3] samples\nint16 level\nfloat64 position"
    body = b"\x00\x01\x00\x00" + b"\x01\x00\x00\x00" + b"\x03\x00\x00\x00ab\x00\x00" + \
        np.array([1, 2, 3], "<f4").tobytes() + b"\x07\x00" + b"\x00" * 2
    body += b"\x00" * (-(len(body) - 4) % 8)
    messages = [("/eha/own", "own_msgs/msg/Own", int(s), body + np.array(x, "<f8").tobytes())
                for s, x, _ in zip(*motion(N), strict=True)]
    path = write_mcap(tmp_path / "a.mcap", messages,
                      definitions={"own_msgs/msg/Own": definition})
    recording = read_recording(path, with_channels(
        x={"topic": "own", "field": "position"}, p1={"topic": "own", "field": "level"}))
    np.testing.assert_array_equal(recording.channels["x"], motion(N)[1])
    assert (recording.channels["p1"] == 7).all()
    assert "no header stamps, log times are used" in recording.losses[0]


def test_zero_header_stamps_use_log_time(tmp_path):
    messages = [("/eha/joint_states", JOINT, int(s), joint(0, position=(x,)))
                for s, x, _ in zip(*motion(N), strict=True)]
    recording = read_recording(write_mcap(tmp_path / "a.mcap", messages), SETTINGS)
    assert recording.start_ns == START and len(recording) == N
    assert "log times are used" in recording.losses[0]


def test_topic_in_another_namespace_and_the_exact_one_first(tmp_path):
    def messages(spaces):
        for i, stamp in enumerate(motion(50)[0].tolist()):
            for space in spaces:
                yield f"{space}/joint_states", JOINT, stamp, joint(
                    stamp, position=(float(i + len(space)),))

    path = write_mcap(tmp_path / "a.mcap", messages(["/left"]))
    assert read_recording(path, SETTINGS).channels["x"][0] == 5
    path = write_mcap(tmp_path / "b.mcap", messages(["/left", "/eha"]))
    assert read_recording(path, SETTINGS).channels["x"][0] == 4
    path = write_mcap(tmp_path / "c.mcap", messages(["/left", "/right"]))
    with pytest.raises(InputError, match="/left/joint_states or /right/joint_states"):
        read_recording(path, SETTINGS)


def test_wrong_type_is_said_or_refused(tmp_path):
    def messages(alone):
        for stamp, x, p in zip(*motion(50), strict=True):
            yield "/eha/pressure/chamber_1", "std_msgs/msg/Float64", int(stamp), number(p)
            if not alone:
                yield "/eha/joint_states", JOINT, int(stamp), joint(int(stamp), position=(x,))

    recording = read_recording(write_mcap(tmp_path / "a.mcap", messages(False)), SETTINGS)
    assert list(recording.channels) == ["x"]
    assert recording.losses == ("/eha/pressure/chamber_1: type is std_msgs/msg/Float64: expected "
                                "field 'fluid_pressure', the type has data",)
    with pytest.raises(InputError, match="expected field 'fluid_pressure'"):
        read_recording(write_mcap(tmp_path / "b.mcap", messages(True)), SETTINGS)


def test_a_topic_that_the_config_names_and_the_bag_lacks(tmp_path):
    """It was "no_data" with exit status 0; a default topic may be absent."""
    bag = write_mcap(tmp_path / "a.mcap", contract_messages(N))
    assert "temperature" not in read_recording(bag, SETTINGS).channels
    with pytest.raises(InputError, match=r"channels\.p1: the bag has no topic /nowhere, it has "
                                         r"/eha/joint_states, /eha/pressure/chamber_1$"):
        read_recording(bag, with_channels(p1={"topic": "/nowhere", "field": "data"}))


def test_foreign_topics_only(tmp_path):
    messages = [("/lidar", PRESSURE, START, pressure(START, 1.0))]
    with pytest.raises(InputError, match=r"expected one of the topics .*the bag has /lidar$"):
        read_recording(write_mcap(tmp_path / "a.mcap", messages), SETTINGS)


def test_raw_messages_come_in_order_of_time(tmp_path):
    messages = list(contract_messages(200))
    shuffled = [messages[i] for i in np.random.default_rng(0).permutation(len(messages))]
    path = write_mcap(tmp_path / "a.mcap", shuffled, chunk_size=10**7)
    found = list(iter_raw(path))
    assert [time for _, _, time, _ in found] == sorted(time for _, _, time, _ in messages)
    assert sorted(found) == sorted(messages)
    assert topics(path)["/eha/pressure/chamber_1"].msgtype == PRESSURE


def test_header_stamps_that_jitter_by_half_a_sample(tmp_path):
    rng = np.random.default_rng(0)
    stamps, x, p = motion(3000)
    messages = []
    for stamp, position, value in zip(stamps.tolist(), x, p, strict=True):
        own = [stamp + round(5e5 * rng.standard_normal()) for _ in range(2)]
        messages.append(("/eha/joint_states", JOINT, stamp, joint(own[0], position=(position,))))
        messages.append(("/eha/pressure/chamber_1", PRESSURE, stamp, pressure(own[1], value)))
    recording = read_recording(write_mcap(tmp_path / "a.mcap", messages), Settings())
    np.testing.assert_array_equal(recording.channels["x"], x)
    off = recording.channels["p1"] - p
    assert len(off) == 3000 and np.isfinite(off[1:-1]).all()
    # The two grids are known to within the mean of the jitter, far below a sample.
    assert np.abs(off[1:-1]).max() < 1e5 * 2 * np.pi * 5e-5
    told = [loss for loss in recording.losses if "reversed by jitter" in loss]
    assert len(told) == 2 and "jumps" not in " ".join(recording.losses)
