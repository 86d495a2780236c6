"""The Foxglove WebSocket of the dashboard, with a client of its protocol."""

import json
import struct

import pytest
from rclpy.serialization import deserialize_message
from ros_tools import PATIENCE, command, end
from std_msgs.msg import Float64

pytest.importorskip("nicegui", reason="nicegui is not installed (pip install '.[dashboard]')")
pytest.importorskip("foxglove", reason="foxglove-sdk is not installed (pip install '.[foxglove]')")
client = pytest.importorskip("websockets.sync.client", reason="websockets is not installed")

TOPIC = "/eha/monitor/viscous_damping"
MESSAGE_DATA = 1


def test_a_client_gets_the_messages_of_a_topic(graph):
    publisher = graph.node("source").create_publisher(Float64, TOPIC, 10)
    with command("dashboard", "--port", 0, "--foxglove", 0) as process:
        address = process.stdout.readline().removeprefix("foxglove: ").strip()
        assert address.startswith("ws://127.0.0.1:"), process.stderr.read()
        assert process.stdout.readline().startswith("dashboard: ")
        with client.connect(address, subprotocols=["foxglove.sdk.v1"]) as connection:
            found = None
            while found is None:  # the topic is offered once its publisher is discovered
                told = json.loads(connection.recv(timeout=PATIENCE))
                found = next((channel for channel in told.get("channels", ())
                              if channel["topic"] == TOPIC), None)
            assert (found["encoding"], found["schemaName"]) == ("cdr", "std_msgs/msg/Float64")
            assert "float64 data" in found["schema"]
            connection.send(json.dumps({"op": "subscribe", "subscriptions": [
                {"id": 7, "channelId": found["id"]}]}))
            assert received(publisher, connection) == 612.5

        with command("dashboard", "--port", 0, "--foxglove", address.rpartition(":")[2]) as other:
            _, err = other.communicate(timeout=PATIENCE)
        assert other.returncode == 2 and err.count("\n") == 1, err
        assert "expected a free port" in err
        end(process)


def received(publisher, connection):
    """Publish until a message comes; the subscription may take a moment to count."""
    while True:
        publisher.publish(Float64(data=612.5))
        try:
            frame = connection.recv(timeout=0.2)
        except TimeoutError:
            continue
        if isinstance(frame, bytes) and frame[0] == MESSAGE_DATA:
            number, _ = struct.unpack_from("<IQ", frame, 1)
            assert number == 7
            return deserialize_message(frame[13:], Float64).data
