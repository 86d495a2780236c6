"""Numbers out of serialised messages: the same as out of the messages themselves."""

import math

import numpy as np
import pytest
from bag_tools import joint
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import Imu, JointState, Temperature
from std_msgs.msg import Float32

from eha_monitor.ros.inputs import Decoder, topics_of
from eha_monitor.ros.messages import stamp
from eha_monitor.ros.raw import RawReader
from eha_monitor.settings import settings_from_tree

START = 1_700_000_000_123_456_789
JOINT = "sensor_msgs/msg/JointState"


def topic_of(channels, name):
    channels = {"x": {"topic": "joint_states", "name": "piston", "field": "position"}} | channels
    found = topics_of(settings_from_tree({"channels": channels}, "test"))
    return next(t for t in found if t.name == name)


def contract(name="joint_states"):
    return next(t for t in topics_of(settings_from_tree({}, "test")) if t.name == name)


def decoded(topic, data, kind=JointState):
    """Return what the decoders make of the whole message."""
    message = deserialize_message(data, kind)
    return [Decoder(entry)(message) for entry in topic.entries]


def same(found, expected):
    return all(a == b or (math.isnan(a) and math.isnan(b))
               for left, right in zip(found, expected, strict=True)
               for a, b in zip(left, right, strict=True))


names = st.permutations(["piston", "pump", "valve"])
numbers = st.floats(allow_nan=True, allow_infinity=True)
lists = st.one_of(st.just([]), st.lists(numbers, min_size=3, max_size=3))


@hypothesis_settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(names, lists, lists, lists, st.text(max_size=5)), min_size=1,
                max_size=6))
def test_whatever_comes_is_read_as_the_decoders_read_it(messages):
    topic = contract()
    reader = RawReader(topic, JOINT)
    for order, position, velocity, effort, frame in messages:
        data = joint(START, order, position, velocity, effort, frame.replace("\0", ""))
        found, expected = reader(data), decoded(topic, data)
        if found is not None:  # else the message is left to the decoders
            assert found[0] == START and same(found[1], expected)
        else:
            assert None in expected


def test_the_contract_is_read_without_the_decoders():
    reader = RawReader(contract(), JOINT)
    for k in range(3):
        data = joint(START + k, ("piston", "pump"), (0.1 * k, math.nan), (0.5, 100.0))
        time_ns, (piston, pump) = reader(data)
        assert time_ns == START + k and pump == (100.0,)
        assert piston[:2] == (0.1 * k, 0.5) and math.isnan(piston[2])


@hypothesis_settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 2**31 - 1), numbers, numbers, st.sampled_from(
    ["piston", "valve"])), min_size=1, max_size=8), st.booleans())
def test_many_at_once_are_read_as_one_by_one(messages, one_layout):
    reader = RawReader(contract(), JOINT)
    data = [joint(seconds * 1_000_000_000 + 7, (("piston" if one_layout else name), "pump"),
                  (position, math.nan), (0.5, speed))
            for seconds, position, speed, name in messages]
    singly = [reader(one) for one in data]
    found = RawReader(contract(), JOINT).read_all(data)
    if None in singly:
        assert found is None
    else:
        stamps, streams = found
        assert stamps.tolist() == [stamp for stamp, _ in singly]
        for k, (_, values) in enumerate(singly):
            assert same([tuple(stream[k]) for stream in streams], values)


@pytest.mark.parametrize("data", [
    joint(START, ("valve",), (1.0,)), joint(START, ("piston", "pump"), (1.0, 2.0)),
    joint(START, ("piston", "pump"), (1.0, 2.0), (3.0, 4.0), little_endian=False), b"",
    b"\0\1\0\0", joint(START, ("piston", "pump"), (math.nan, 2.0))],
    ids=["no entry", "no velocity of the pump", "big endian", "empty", "cut", "no number"])
def test_what_needs_the_decoders_is_left_to_them(data):
    reader = RawReader(contract(), JOINT)
    assert reader(data) is None
    assert reader(joint(START, ("piston", "pump"), (1.0, 2.0), (3.0, 4.0))) is not None
    assert reader(data) is None


def test_other_types_scale_and_offset():
    topic = topic_of({"p1": {"topic": "gauge", "field": "data", "scale": 1e5, "offset": 7.0}},
                     "gauge")
    data = serialize_message(Float32(data=0.1))
    assert RawReader(topic, "std_msgs/msg/Float32")(data) == (
        0, [(1e5 * float(np.float32(0.1)) + 7.0,)])
    topic = topic_of({"v": {"topic": "imu", "field": "linear_acceleration_covariance[4]"},
                      "omega": {"topic": "imu", "field": "angular_velocity.z"}}, "imu")
    message = Imu()
    message.header.stamp, message.header.frame_id = stamp(START), "base"
    message.angular_velocity.z = 3.5
    message.linear_acceleration_covariance[4] = -2.0
    assert RawReader(topic, "sensor_msgs/msg/Imu")(serialize_message(message)) == (
        START, [(-2.0, 3.5)])


def test_a_type_that_is_not_known_is_left_to_the_decoders():
    topic = contract("temperature")
    assert RawReader(topic, "odd_msgs/msg/Odd")(serialize_message(Temperature())) is None
