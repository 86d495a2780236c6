"""A friction that appears: simulated rows over DDS into the real node, its health read back."""

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.qos import QoSProfile
from rig_tools import MULTISINE, simulated
from sensor_msgs.msg import FluidPressure, JointState

from eha_monitor.ros import messages
from eha_monitor.ros.managed_node import warm_up
from eha_monitor.ros.messages import findings_of
from eha_monitor.ros.monitor_node import Monitor
from eha_monitor.ros.topics import LATCHED
from eha_monitor.settings import settings_from_tree

START_NS = 1_700_000_000 * 1_000_000_000
AHEAD = 200  # rows sent beyond those that the monitor has taken: nothing is lost
FRICTION = {"coulomb_friction": {"F_c": 40.0}}


@pytest.fixture(scope="module", autouse=True)
def compiled():
    warm_up()


class Player:
    """Plays a recording into a monitor as fast as that takes it, and keeps its health."""

    def __init__(self, graph, recording, **config):
        self.graph, self.dt = graph, recording.sample_time
        self.columns = {n: v.tolist() for n, v in recording.channels.items()}
        self.sent = 0
        self.monitor = Monitor(graph.node("monitor", "/eha"),
                               settings_from_tree(config, "test"))
        node, qos = graph.node("player", "/eha"), QoSProfile(depth=4 * AHEAD)
        make = node.create_publisher
        self.outputs = [make(JointState, "joint_states", qos), make(JointState, "command", qos),
                        make(FluidPressure, "pressure/chamber_1", qos),
                        make(FluidPressure, "pressure/chamber_2", qos)]
        self.health = []
        graph.node("listener", "/eha").create_subscription(
            DiagnosticArray, "monitor/health", self.health.append, LATCHED)
        graph.until(lambda: all(p.get_subscription_count() for p in self.outputs)
                    and self.health)

    def play(self, until):
        """Send the rows up to a time, each with its stamp; wait until they are processed."""
        column = self.columns
        for k in range(self.sent, round(until / self.dt)):
            joints = JointState(name=["piston", "pump"], position=[column["x"][k], 0.0],
                                velocity=[0.0, column["omega"][k]])
            command = JointState(name=["piston"], position=[column["x_d"][k]])
            pressures = [FluidPressure(fluid_pressure=column[n][k]) for n in ("p1", "p2")]
            stamp = messages.stamp(START_NS + round(k * self.dt * 1e9))
            for output, message in zip(self.outputs, (joints, command, *pressures), strict=True):
                message.header.stamp = stamp
                output.publish(message)
            self.sent = k + 1
            if self.sent % 50 == 0:
                self.graph.until(lambda: self.monitor.aligner.rows > self.sent - AHEAD)
        self.graph.until(lambda: self.monitor.aligner.rows >= self.sent)

    def status(self, name):
        """Return the last status of one name, with its values as a mapping."""
        found = next(s for s in self.health[-1].status if s.name == f"eha: {name}")
        return found, {v.key: v.value for v in found.values}

    def levels(self, name):
        """Return the levels that a status has had, in order, without repetitions."""
        seen = [s.level for array in self.health for s in array.status if s.name == f"eha: {name}"]
        return [a for a, b in zip(seen, [None, *seen], strict=False) if a != b]

    def words(self, name):
        """Return the same as words."""
        seen = [f.word for array in self.health for f in findings_of(array) if f.name == name]
        return [a for a, b in zip(seen, [None, *seen], strict=False) if a != b]


def test_friction_that_appears_is_a_mismatch_and_no_wear(graph):
    fault = {"dry": {"parameter": "coulomb_friction.F_c", "start": 4.0, "value": 40.0}}
    player = Player(graph, simulated(MULTISINE, 9.5, faults=fault).recording(0))
    first, _ = player.status("model_mismatch")
    assert first.level == DiagnosticStatus.STALE and "no data yet" in first.message
    player.play(3.5)
    graph.until(lambda: player.status("model_mismatch")[0].level == DiagnosticStatus.OK)
    assert player.status("model_mismatch")[0].hardware_id == "eha"
    assert player.status("model_mismatch")[1]["mismatch"] == "0"

    player.play(9.0)  # within five seconds
    graph.until(lambda: player.status("model_mismatch")[0].level == DiagnosticStatus.WARN)
    player.play(9.5)
    graph.until(lambda: player.status("viscous_damping_high")[1]["tainted"] == "1")
    status, values = player.status("model_mismatch")
    assert "the model does not fit since t = " in status.message
    assert "in doubt: viscous damping" in status.message and "diagnose" in status.message
    assert "force balance" in values["balance"]
    assert 3.9 < float(values["since_s"]) < 9.0
    assert float(values["stage_one_variance_ratio"]) > 100
    assert float(values["stage_one_nis_ratio"]) > 10
    assert 3.9 < float(values["stage_one_worst_time_s"]) < 9.5
    assert values["stage_one_mismatch"] == values["viscous_damping_tainted"] == "1"
    alarm, numbers = player.status("viscous_damping_high")
    # The filter's B is beyond the limit of ERROR; least squares of what came since know better.
    assert float(numbers["viscous_damping_Ns_per_m"]) == pytest.approx(600.0, rel=0.03)
    assert "by least squares" in alarm.message
    assert "the model does not fit since t = " in alarm.message
    assert numbers["not_judged"] == "0" and alarm.level == DiagnosticStatus.OK
    words = player.words("viscous_damping_high")
    assert set(words) == {"STALE", "not judged", "OK"} and words[-1] == "OK"
    assert player.monitor.counts()["missing_samples"] == 0


def test_friction_that_the_config_models_is_no_mismatch(graph):
    recording = simulated(MULTISINE, 4.0, effects=FRICTION).recording(0)
    player = Player(graph, recording, effects=FRICTION)
    player.play(4.0)
    graph.until(lambda: player.status("model_mismatch")[0].level == DiagnosticStatus.OK)
    numbers = player.status("viscous_damping_high")[1]
    assert float(numbers["viscous_damping_Ns_per_m"]) == pytest.approx(600, rel=0.02)
    assert numbers["tainted"] == "0"
    assert DiagnosticStatus.WARN not in player.levels("model_mismatch")
