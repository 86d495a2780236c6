"""Numbers out of serialised messages: the same as out of the messages themselves."""

import math

import numpy as np
import pytest
from bag_tools import joint
from hypothesis import given
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import Float32

from eha_monitor.ros.decoding import Stream, TopicReader, types_of_class
from eha_monitor.ros.messages import stamp
from eha_monitor.ros.topics import topics_of
from eha_monitor.settings import settings_from_tree

START = 1_700_000_000_123_456_789
JOINT = "sensor_msgs/msg/JointState"


def topic_of(channels, name):
    channels = {"x": {"topic": "joint_states", "name": "piston", "field": "position"}} | channels
    found = topics_of(settings_from_tree({"channels": channels}, "test"))
    return next(t for t in found if t.name == name)


def contract(name="joint_states"):
    return next(t for t in topics_of(settings_from_tree({}, "test")) if t.name == name)


def decoded(topic, data):
    """Return what stands in the message as ROS reads it: a tuple for each entry, or None."""
    message, found = deserialize_message(data, JointState), []
    for entry in topic.entries:
        place = list(message.name).index(entry.name)
        values = [getattr(message, channel.field) for _, channel in entry.channels]
        values = [value[place] if len(value) else math.nan for value in values]
        found.append(tuple(values) if np.isfinite(values).any() else None)
    return found


def read(topic, type_name, messages, streams=None):
    """Return the batches of some messages, and what is wrong with each stream."""
    streams = streams or [Stream(entry) for entry in topic.entries]
    n = len(messages)
    batches = TopicReader(topic, type_name, streams).read(
        messages, np.arange(float(n)), np.full(n, START))
    return batches, [stream.problem for stream in streams]


def same(found, expected):
    return np.array_equal(np.array(found, dtype=float), np.array(expected, dtype=float),
                          equal_nan=True)


names = st.permutations(["piston", "pump", "valve"])
numbers = st.floats(allow_nan=True, allow_infinity=True)
lists = st.one_of(st.just([]), st.lists(numbers, min_size=3, max_size=3))


@given(st.lists(st.tuples(names, lists, lists, lists, st.text(max_size=5)), min_size=1,
                max_size=6))
def test_whatever_comes_is_read_as_ros_reads_it(messages):
    topic = contract()
    data = [joint(START + k, order, position, velocity, effort, frame.replace("\0", ""))
            for k, (order, position, velocity, effort, frame) in enumerate(messages)]
    batches, _ = read(topic, JOINT, data)
    for entry, batch, expected in zip(topic.entries, batches, zip(
            *(decoded(topic, one) for one in data), strict=True), strict=True):
        nothing = (math.nan,) * len(entry.channels)
        rows = zip(batch.values.tolist(), expected, strict=True)
        assert same([row if values else nothing for row, values in rows],
                    [values or nothing for values in expected])
        assert batch.stamps.tolist() == [START + k for k in range(len(data))]
        lacking = batch.lacking or (None,) * len(data)
        assert [each is None for each in lacking] == [values is not None for values in expected]


def test_the_contract_is_read():
    data = [joint(START + k, ("piston", "pump"), (0.1 * k, math.nan), (0.5, 100.0))
            for k in range(3)]
    (piston, pump), problems = read(contract(), JOINT, data)
    assert piston.stamps.tolist() == [START, START + 1, START + 2]
    assert same(piston.values[:, :2], [(0.1 * k, 0.5) for k in range(3)])
    assert np.isnan(piston.values[:, 2]).all() and pump.values.tolist() == [[100.0]] * 3
    assert problems == [None, None]


@pytest.mark.parametrize(("data", "problem"), [
    (joint(START, ("valve",), (1.0,)), "no entry named 'piston', the message has valve"),
    (joint(START, ("piston", "pump"), (1.0, 2.0)), "(pump) holds no number in velocity"),
    (joint(START, ("piston", "pump"), (math.nan, 2.0), (math.nan, 3.0)), "(piston) holds no")],
    ids=["no entry", "no velocity of the pump", "no number"])
def test_what_lacks_is_named_and_the_next_message_is_read(data, problem):
    topic = contract()
    streams = [Stream(entry) for entry in topic.entries]
    _, problems = read(topic, JOINT, [data], streams)
    assert any(problem in (each or "") for each in problems)
    good = joint(START, ("piston", "pump"), (1.0, 2.0), (3.0, 4.0))
    (_, pump), problems = read(topic, JOINT, [good], streams)
    assert pump.values.tolist() == [[4.0]] and problems == [None, None]


def test_other_types_scale_and_offset():
    topic = topic_of({"p1": {"topic": "gauge", "field": "data", "scale": 1e5, "offset": 7.0}},
                     "gauge")
    (gauge,), _ = read(topic, "std_msgs/msg/Float32", [serialize_message(Float32(data=0.1))])
    assert gauge.values.tolist() == [[1e5 * float(np.float32(0.1)) + 7.0]]
    assert gauge.stamps.tolist() == [START]  # without a stamp, the time of receipt
    topic = topic_of({"v": {"topic": "imu", "field": "linear_acceleration_covariance[4]"},
                      "omega": {"topic": "imu", "field": "angular_velocity.z"}}, "imu")
    message = Imu()
    message.header.stamp, message.header.frame_id = stamp(START + 1), "base"
    message.angular_velocity.z = 3.5
    message.linear_acceleration_covariance[4] = -2.0
    (imu,), _ = read(topic, "sensor_msgs/msg/Imu", [serialize_message(message)])
    assert imu.values.tolist() == [[-2.0, 3.5]] and imu.stamps.tolist() == [START + 1]


def test_messages_of_another_byte_order_are_read():
    data = joint(START, ("piston", "pump"), (1.0, 2.0), (3.0, 4.0), little_endian=False)
    (piston, pump), _ = read(contract(), JOINT, [data])
    assert piston.values[0, :2].tolist() == [1.0, 3.0] and pump.values.tolist() == [[4.0]]


@pytest.mark.parametrize("name", ["JointState", "FluidPressure", "Imu", "NavSatFix", "JoyFeedback",
                                  "MultiDOFJointState"])
def test_fields_of_a_class_are_those_of_its_definition(name):
    """So a type that rosbags does not know is read as well."""
    kind = f"sensor_msgs/msg/{name}"
    for inner, (_, fields) in types_of_class(kind).items():
        assert fields == [tuple(one) for one in get_typestore(
            Stores.ROS2_JAZZY).fielddefs[inner][1]], inner


def test_a_topic_is_taken_once_however_it_is_spelt():
    """As ``init`` drafts it of a bag: full names, beside defaults for the same topic."""
    config = settings_from_tree({"channels": {
        "x": {"topic": "/rig1/joint_states", "name": "piston", "field": "position"}}}, "test")
    found = topics_of(config, resolve=lambda name: name if name[0] == "/" else f"/rig1/{name}")
    (one,) = (t for t in found if t.full_name == "/rig1/joint_states")
    assert {c for entry in one.entries for c, _ in entry.channels} >= {"x", "v", "omega"}
    assert len({t.full_name for t in found}) == len(found)


def test_a_type_without_the_field_is_named():
    topic = topic_of({"p1": {"topic": "p", "field": "fluid_pressure"}}, "p")
    (batch,), (problem,) = read(topic, "std_msgs/msg/Float32", [
        serialize_message(Float32(data=0.1))])
    assert "a std_msgs/msg/Float32 has no fluid_pressure, it has data" in problem
    assert batch.lacking == (False,)  # nothing that was measured is NaN
