"""A publisher of the simulated actuator whose messages go wrong on command.

A child of ``soak.py``.  It reads lines from its standard input: ``KIND SEED`` begins a fault,
``calm`` ends it.  It says ``begin`` once it publishes, and what it does with each line.
"""

import heapq
import json
import os
import random
import struct
import sys
import time

import numpy as np
import rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosbags.typesys import Stores, get_typestore
from std_msgs.msg import Float64

from eha_monitor.physics.simulator import Simulator
from eha_monitor.recordings.cdr import Want, locate
from eha_monitor.recordings.write import messages_of
from eha_monitor.ros.topics import message_class
from eha_monitor.settings import settings_from_tree

RELIABLE = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
OTHER_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE,
                     durability=DurabilityPolicy.TRANSIENT_LOCAL)
FAST = 10
BLOCK = 200 * FAST  # fine samples
BURST = 0.001
STEP_NS = 1_000_000
STAMP, STAMP_AT = struct.Struct("<iI"), 4
# Both parameters show within a second, whenever the estimators begin anew.
EXCITATION = {"motion": {"kind": "multisine", "duration": 3600.0, "amplitude": 0.01,
                         "frequency": 0.5, "frequency_end": 10.0}}
CHANNELS = {"joint_states": {"x": Want("position", "piston"), "omega": Want("velocity", "pump")},
            "command": {"x_d": Want("position", "piston")},
            "pressure/chamber_1": {"p1": Want("fluid_pressure")},
            "pressure/chamber_2": {"p2": Want("fluid_pressure")}}


class Publisher:
    """Publishes sample after sample; ``fault`` says what happens to them.

    Parameters
    ----------
    node : node in the namespace of the topics.
    seed : of the sensor noise.
    """

    def __init__(self, node, seed: int):
        # The plant runs at ten times the rate, so that both rates show the same motion.
        settings = settings_from_tree({"rig": {"sample_time": 1e-3 / FAST}, "simulation": {
            "excitation": EXCITATION, "substeps": 1}}, "soak")
        self.node = node
        self.simulator = Simulator(settings, seed)
        self.types = get_typestore(Stores.ROS2_JAZZY).fielddefs
        self.streams, self.sample = [], 0
        self.kinds, self.places = {}, {}
        self._more()
        self.outputs = {topic: node.create_publisher(kind, topic, RELIABLE)
                        for topic, kind in self.kinds.items()}
        self.start, self.origin_ns = time.monotonic(), time.time_ns()
        self.waiting: list[tuple[float, int, str, bytes]] = []
        self.count = 0
        self.listener = None
        self.calm()

    def _more(self) -> None:
        shown = self.simulator.advance(BLOCK)
        found = messages_of(shown, np.arange(BLOCK), "")
        messages = {}
        for stream in found:
            topic = stream.topic.strip("/")
            messages[topic] = [row.tobytes() for row in stream.data]
            if topic not in self.kinds:
                self.kinds[topic] = message_class(stream.msgtype)
                places = locate(messages[topic][0], self.types, stream.msgtype,
                                tuple(CHANNELS[topic].values())).places
                self.places |= {channel: (topic, places[want][0])
                                for channel, want in CHANNELS[topic].items()}
        self.block = messages

    def calm(self) -> str:
        """End the fault that is on."""
        if self.listener is not None:
            self.node.destroy_subscription(self.listener)
            self.listener = None
            self._replace("joint_states", RELIABLE)
        self.kind, self.detail, self.frozen = "calm", {}, None
        return "calm"

    def begin(self, kind: str, seed: int) -> str:
        """Begin a fault; what is random of it comes from the seed.  Returns it in words."""
        draw = self.draw = random.Random(seed)
        topics = list(self.kinds)
        detail = {
            "dropped": lambda: {"share": draw.uniform(0.05, 0.5)},
            "duplicated": lambda: {"share": draw.uniform(0.1, 0.5)},
            "late": lambda: {"topics": draw.choice([topics, *([t] for t in topics)]),
                             "by": draw.uniform(0.15, 0.4)},
            "out_of_order": lambda: {"share": draw.uniform(0.05, 0.3)},
            "clock_back": lambda: {"by": draw.uniform(1.0, 60.0)},
            "nan": lambda: {"channel": draw.choice(list(self.places)),
                            "burst": draw.uniform(0.02, 0.3)},
            "frozen": lambda: {"channel": draw.choice(list(self.places))},
            "joint_names": lambda: {"topic": draw.choice(["joint_states", "command"])},
        }.get(kind, dict)()
        self.kind, self.detail = kind, detail
        if kind == "clock_back":
            self.origin_ns -= round(detail["by"] * 1e9)
        elif kind == "qos":
            self._replace("joint_states", OTHER_QOS)
            self.listener = self.node.create_subscription(
                Float64, "monitor/viscous_damping", lambda message: None, LATCHED)
        elif kind == "frozen":
            topic, at = self.places[detail["channel"]]
            self.frozen = topic, at, self.block[topic][FAST * self.sample % BLOCK][at:at + 8]
        return json.dumps({"kind": kind, **detail})

    def _replace(self, topic: str, qos: QoSProfile) -> None:
        self.node.destroy_publisher(self.outputs[topic])
        self.outputs[topic] = self.node.create_publisher(self.kinds[topic], topic, qos)

    def burst(self) -> None:
        """Publish what is due."""
        now = time.monotonic()
        due = int((now - self.start) * 1e3) + 1
        while self.sample < due:
            place = FAST * self.sample % BLOCK
            if self.sample and not place:
                self._more()
            stamp_ns = self.origin_ns + self.sample * STEP_NS
            for topic, messages in self.block.items():
                if self.kind == "rate_10":
                    for part in range(FAST):
                        self._send(topic, bytearray(messages[place + part]),
                                   stamp_ns + part * STEP_NS // FAST)
                else:
                    self._spoil(topic, bytearray(messages[place]), stamp_ns, now)
            self.sample += 1
        while self.waiting and self.waiting[0][0] <= now:
            _, _, topic, data = heapq.heappop(self.waiting)
            self.outputs[topic].publish(data)

    def _send(self, topic: str, data: bytearray, stamp_ns: int, delay: float = 0.0,
              now: float = 0.0) -> None:
        STAMP.pack_into(data, STAMP_AT, *divmod(stamp_ns, 1_000_000_000))
        if delay:
            self.count += 1
            heapq.heappush(self.waiting, (now + delay, self.count, topic, bytes(data)))
        else:
            self.outputs[topic].publish(bytes(data))

    def _spoil(self, topic: str, data: bytearray, stamp_ns: int, now: float) -> None:
        kind, detail, chance = self.kind, self.detail, 0.0
        if "share" in detail:
            chance = self.draw.random()
        if kind == "dropped" and chance < detail["share"]:
            return
        delay = 0.0
        if kind == "late" and topic in detail["topics"]:
            delay = detail["by"]
        elif kind == "out_of_order" and chance < detail["share"]:
            delay = self.draw.uniform(0.002, 0.010)
        elif kind == "nan" and now % 0.5 < detail["burst"]:
            where, at = self.places[detail["channel"]]
            if where == topic:
                struct.pack_into("<d", data, at, float("nan"))
        elif kind == "frozen" and self.frozen[0] == topic:
            _, at, value = self.frozen
            data[at:at + 8] = value
        elif kind == "joint_names" and detail["topic"] == topic:
            data = data.replace(b"piston", b"kolben")
        self._send(topic, data, stamp_ns, delay, now)
        if kind == "duplicated" and chance < detail["share"]:
            self._send(topic, data, stamp_ns)


def main() -> None:
    """Publish until the standard input ends."""
    rclpy.init()
    node = rclpy.create_node("faulty_publisher", namespace="/eha")
    publisher = Publisher(node, int(sys.argv[1]))
    os.set_blocking(sys.stdin.fileno(), False)
    while not all(p.get_subscription_count() for p in publisher.outputs.values()):
        time.sleep(0.02)
    publisher.start, publisher.origin_ns = time.monotonic(), time.time_ns()
    print("begin", flush=True)
    while rclpy.ok():
        publisher.burst()
        line = sys.stdin.readline()
        if line:
            kind, _, seed = line.strip().partition(" ")
            said = publisher.calm() if kind == "calm" else publisher.begin(kind, int(seed))
            print(said, flush=True)
        time.sleep(BURST)


if __name__ == "__main__":
    main()
