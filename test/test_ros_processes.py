"""The commands as processes: simulator, monitor, record, replay, and how they end."""

import py_compile
import re
import signal

import pytest
from bag_tools import JOINT, write_mcap
from command_tools import refused
from diagnostic_msgs.msg import DiagnosticArray
from rig_tools import write_channels
from ros_tools import BEST_EFFORT, PATIENCE, REPOSITORY, command, end, listen
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64
from std_srvs.srv import SetBool

from eha_monitor.recordings.bag import iter_raw, topics
from eha_monitor.ros import messages
from eha_monitor.ros.record_node import topics_to_record
from eha_monitor.ros.topics import LATCHED
from eha_monitor.settings import Settings


def bag_of_joint_states(path, count, start_ns=5_000_000_000, extra=None):
    """Write positions 1 ms apart, and on request a topic of a type that is not installed."""
    from rclpy.serialization import serialize_message

    def written():
        for k in range(count):
            time_ns = start_ns + k * 1_000_000
            state = messages.joint_state(time_ns, "piston", 1e-3 * k, 0.0)
            yield "/eha/joint_states", JOINT, time_ns, serialize_message(state)
            if extra:
                yield "/strange", extra, time_ns, b"\0\1\0\0" + bytes(8)

    write_mcap(path, written(), definitions={extra: "float64 data"})


def test_simulator_monitor_record_replay(graph, tmp_path):
    """From the simulated piston to B near 600, health for a late subscriber, and a bag of it."""
    damping = listen(graph, Float64, "/eha/monitor/viscous_damping", BEST_EFFORT)
    stddev = listen(graph, Float64, "/eha/monitor/viscous_damping_stddev", BEST_EFFORT)
    bag = tmp_path / "bag"
    node = graph.node("counter", "/eha")
    wanted = [node.resolve_topic_name(topic) for topic in topics_to_record(Settings())
              if topic != "temperature"]  # which the simulator does not publish

    def recorded(topic):
        return "record" in {end.node_name for end in node.get_subscriptions_info_by_topic(topic)}

    with command("record", "--out", bag) as record, command("monitor") as monitor, \
            command("simulator", "--seed", "1") as simulator:
        graph.until(lambda: damping and stddev and stddev[-1].data < 6.0, PATIENCE)
        assert damping[-1].data == pytest.approx(600.0, rel=0.05)
        health = listen(graph, DiagnosticArray, "/eha/monitor/health", LATCHED)
        graph.until(lambda: health)
        # The recorder may begin last of all; then it needs its rows, and a health message.
        graph.until(lambda: all(map(recorded, wanted)), PATIENCE)
        joints = listen(graph, JointState, "/eha/joint_states", BEST_EFFORT)
        diagnostics = listen(graph, DiagnosticArray, "/diagnostics", BEST_EFFORT)
        graph.until(lambda: len(diagnostics) > 1 and len(joints) > 600, PATIENCE)
        assert "published" in end(simulator)
        assert "latency from stamp" in end(monitor, signal.SIGINT)
        assert f"on {len(wanted)} topics" in end(record, signal.SIGINT)
    found = topics(bag)
    assert found["/eha/joint_states"].count > 500
    assert found["/eha/monitor/health"].count >= 1
    stamps = [log for topic, _, log, _ in iter_raw(bag) if topic == "/eha/joint_states"]
    assert stamps == sorted(stamps)


def rows_told(array, key="rows"):
    """Return how many rows the monitor says it has taken, or ``missing_samples`` it lacks."""
    return next((int(float(pair.value)) for status in array.status for pair in status.values
                 if pair.key == key), 0)


def test_replay_feeds_a_monitor_on_simulated_time(graph, tmp_path):
    from eha_monitor.physics.simulator import Simulator

    bag = tmp_path / "bag"
    write_channels(bag, Simulator(Settings(), 1).advance(4000), Settings(),
                   start_ns=1_000_000_000)
    damping = listen(graph, Float64, "/eha/monitor/viscous_damping", BEST_EFFORT)
    clock = listen(graph, Clock, "/clock", BEST_EFFORT)
    health = listen(graph, DiagnosticArray, "/eha/monitor/health", LATCHED)
    with command("monitor", "--ros-args", "-p", "use_sim_time:=true") as monitor:
        graph.until(lambda: health, PATIENCE)  # the monitor is there before the bag begins
        with command("replay", bag, "--clock", "--rate", "2", "--start-paused") as replay:
            node = graph.node("client")
            client = node.create_client(SetBool, "/replay/pause")
            graph.until(client.service_is_ready, PATIENCE)
            graph.until(lambda: node.count_publishers("/clock"), PATIENCE)
            client.call_async(SetBool.Request(data=False))
            graph.until(lambda: replay.poll() is not None, PATIENCE)
            assert replay.returncode == 0
            assert "published 16000 messages" in replay.communicate()[0]
        graph.until(lambda: damping and abs(damping[-1].data - 600.0) < 30.0)
        # At twice the rate a busy machine is behind; what waits in the queue is not lost, and of
        # what DDS dropped all the same the monitor knows.
        graph.until(lambda: rows_told(health[-1]) + rows_told(
            health[-1], "missing_samples") >= 3990, PATIENCE)
        missing = rows_told(health[-1], "missing_samples")
        times = [c.clock.sec + c.clock.nanosec * 1e-9 for c in clock]
        assert times == sorted(times) and len(times) > 100  # 100 Hz of wall time at least
        rows = int(re.search(r"rows (\d+);", end(monitor))[1])
        assert 3990 <= rows + missing <= 4000  # the last may still have waited for a channel
        assert missing <= 400


def answered(graph, client, request, each=5.0):
    """Return what a service answers, asked again where it is silent.

    A server that knows a client's requests may not yet know the reader of its answers: the first
    answer then goes to nobody (once in some hundred runs).
    """
    asked = []
    for _ in range(int(PATIENCE / each)):
        asked.append(client.call_async(request))
        try:
            graph.until(lambda: any(one.done() for one in asked), each)
        except AssertionError:
            continue
        return next(one.result() for one in asked if one.done())
    raise AssertionError(f"no answer within {PATIENCE:g} s")


def test_replay_pauses_and_resumes_by_service(graph, tmp_path):
    bag_of_joint_states(tmp_path / "bag", 1000)
    # Reliable, so that nothing is lost once both sides know one another.  The publisher may learn
    # of the subscription later than the other way round: the first messages may go to nobody.
    heard = []
    subscription = graph.node("counter").create_subscription(
        JointState, "/eha/joint_states", heard.append, 1000)
    client = graph.node("client").create_client(SetBool, "/replay/pause")
    with command("replay", tmp_path / "bag", "--start-paused") as replay:
        graph.until(client.service_is_ready, PATIENCE)
        answer = answered(graph, client, SetBool.Request(data=True))
        graph.until(lambda: subscription.get_publisher_count() == 1, PATIENCE)
        assert answer.message == "paused" and not heard
        client.call_async(SetBool.Request(data=False))
        graph.until(lambda: heard and heard[-1].position[0] == pytest.approx(0.999), PATIENCE)
        graph.until(lambda: replay.poll() == 0, PATIENCE)
        assert "published 1000 messages" in replay.communicate()[0]
        places = [round(1e3 * state.position[0]) for state in heard]
        assert places == list(range(places[0], 1000)) and len(places) > 100


def test_replay_loops_and_leaves_out_what_it_does_not_know(graph, tmp_path):
    bag_of_joint_states(tmp_path / "bag", 100, extra="strange_msgs/msg/Strange")
    heard = listen(graph, JointState, "/eha/joint_states", BEST_EFFORT)
    with command("replay", tmp_path / "bag", "--loop") as replay:
        graph.until(lambda: len(heard) > 250, PATIENCE)
        replay.send_signal(signal.SIGINT)
        _, err = replay.communicate(timeout=30)
    assert replay.returncode == 0 and "Traceback" not in err
    assert err.count("/strange is left out: message type strange_msgs/msg/Strange is not "
                     "installed") == 1


@pytest.mark.parametrize(("arguments", "words"), [
    (("monitor", "--ros-args", "-p", "rig.mas:=3"), "did you mean 'mass'"),
    (("simulator", "--ros-args", "--params-file", "nowhere.yaml"), "nowhere.yaml"),
])
def test_bad_input_is_one_line_and_status_2(capfd, arguments, words):
    assert words in refused(capfd, *arguments)


def test_launch_files_compile(tmp_path):
    """launch_ros comes with a full ROS installation only; here the files are compiled."""
    files = sorted((REPOSITORY / "launch").glob("*.launch.py"))
    assert [f.name for f in files] == ["demo.launch.py", "live.launch.py", "replay.launch.py"]
    for file in files:
        py_compile.compile(str(file), cfile=str(tmp_path / "compiled"), doraise=True)
