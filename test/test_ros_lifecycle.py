"""The monitor as a managed node, and several of them in one process."""

import signal

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.parameter import Parameter
from ros_tools import PATIENCE, Caller, Feeder, Recorder, command, end, levels, listen
from std_msgs.msg import Float64

from eha_monitor.errors import InputError
from eha_monitor.ros.managed_node import ManagedMonitor
from eha_monitor.ros.running import actuators
from eha_monitor.ros.topics import LATCHED
from eha_monitor.settings import Settings, settings_from_tree

NODE = "/eha/monitor"


def managed(graph, settings=None, **options):
    node = ManagedMonitor(settings or Settings(), estimator_factory=Recorder, **options)
    graph.executor.add_node(node)
    graph.nodes.append(node)
    return node


def rows_of(node):
    return node.monitor._estimator.rows


@pytest.fixture(autouse=True)
def own_folder(tmp_path, monkeypatch):
    """Bags are saved below the working directory."""
    monkeypatch.chdir(tmp_path)


def test_inactive_takes_and_publishes_nothing(graph):
    node = managed(graph)
    node.start(active=False)
    sender, caller = Feeder(graph), Caller(graph)
    health = listen(graph, DiagnosticArray, "/eha/monitor/health", LATCHED)
    numbers = listen(graph, Float64, "/eha/monitor/viscous_damping")
    assert caller.state(NODE) == "inactive"
    # The end of a process of an earlier test may still be under way to this one.
    graph.until(lambda: not sender.joints.get_subscription_count())
    assert not health
    assert caller.change(NODE, "activate") and caller.state(NODE) == "active"
    graph.until(sender.matched)
    sender.send(0, 100)
    graph.until(lambda: len(rows_of(node)) == 100 and numbers)
    assert caller.change(NODE, "deactivate") and caller.state(NODE) == "inactive"
    graph.until(lambda: not sender.joints.get_subscription_count())
    # The latched health must not look well for ever.
    graph.until(lambda: levels(health[-1])["eha: data"] == DiagnosticStatus.STALE)
    assert "not active" in health[-1].status[0].message
    heard = (len(health), len(numbers))
    sender.send(100, 100)
    assert caller.trigger(f"{NODE}/save").success  # what was kept can still be saved
    assert (len(health), len(numbers)) == heard and len(rows_of(node)) == 100


def test_each_activation_begins_anew_and_keeps_the_thresholds(graph):
    node = managed(graph)
    node.start()
    sender, caller = Feeder(graph), Caller(graph)
    graph.until(sender.matched)
    sender.send(0, 100)
    graph.until(lambda: len(rows_of(node)) == 100)
    limit = "thresholds.viscous_damping.high_warn"
    assert node.set_parameters([Parameter(limit, value=1100.0)])[0].successful
    for transition in ("deactivate", "activate"):
        assert caller.change(NODE, transition)
    graph.until(sender.matched)
    sender.send(5000, 100)
    graph.until(lambda: len(rows_of(node)) == 200)
    assert rows_of(node)[100][0] == 0.0 and node.monitor._estimator.resets == ["deactivated"]
    assert node.monitor.counts()["missing_samples"] == 0
    for transition in ("deactivate", "cleanup", "configure", "activate"):
        assert caller.change(NODE, transition), transition
    assert rows_of(node) == []  # cleaned up: another estimator
    assert node.monitor.settings.thresholds.viscous_damping.high_warn == 1100.0
    assert "rows 100;" in node.summary() or "rows 0;" in node.summary()


def test_cleanup_leaves_only_the_parameters_and_shutdown_ends(graph):
    node = managed(graph)
    node.start(active=False)
    caller = Caller(graph)
    assert caller.change(NODE, "cleanup") and caller.state(NODE) == "unconfigured"
    graph.until(lambda: not caller.node.count_publishers("/eha/monitor/health"))
    assert node.monitor is None and node.has_parameter("rig.mass")
    limit = "thresholds.viscous_damping.high_warn"
    assert node.set_parameters([Parameter(limit, value=1100.0)])[0].successful
    assert not caller.change(NODE, "activate")  # and the node lives on
    assert caller.state(NODE) == "unconfigured"
    assert caller.change(NODE, "configure") and caller.change(NODE, "shutdown")
    assert caller.state(NODE) == "finalized" and node.ended


def test_what_cannot_be_configured_says_why_and_stays_unconfigured(graph):
    settings = settings_from_tree({"channels": {"x": {"topic": "a", "field": "a..b"}}}, "test")
    node = managed(graph, settings, source="my.yaml")
    with pytest.raises(InputError, match=r"my.yaml: channels.x.field"):
        node.start()
    assert Caller(graph).state(NODE) == "unconfigured"


def test_several_actuators_have_topics_and_alarms_of_their_own(graph, tmp_path):
    config = tmp_path / "rig.yaml"
    config.write_text("thresholds: {viscous_damping: {high_warn: 700, high_error: 800}}")
    nodes = [managed(graph, settings, source=source)
             for settings, source in actuators(
                 None, (f"left={config}", "right="), [], "monitor")]
    for node in nodes:
        node.start()
    senders = [Feeder(graph, namespace=f"/{name}") for name in ("left", "right")]
    health = [listen(graph, DiagnosticArray, f"/{n}/monitor/health", LATCHED)
              for n in ("left", "right")]
    diagnostics = listen(graph, DiagnosticArray, "/diagnostics", 100)
    graph.until(lambda: all(sender.matched() for sender in senders))
    for node in nodes:
        node.monitor._estimator.damping = 900.0
    for first in range(0, 900, 100):
        for sender in senders:
            sender.send(first, 100)
    graph.until(lambda: all(len(rows_of(node)) == 900 for node in nodes))
    name = "{}: viscous_damping_high"
    graph.until(lambda: levels(health[0][-1])[name.format("left")] == DiagnosticStatus.ERROR)
    assert levels(health[1][-1])[name.format("right")] == DiagnosticStatus.OK
    for heard, which in zip(health, ("left", "right"), strict=True):
        assert {s.hardware_id for array in heard for s in array.status} == {which}
    graph.until(lambda: {s.hardware_id for array in diagnostics for s in array.status}
                == {"left", "right"})


@pytest.mark.parametrize(("given", "words"), [
    (("left",), "expected NAME=CONFIG"), (("1=",), "expected NAME=CONFIG"),
    (("a b=",), "expected NAME=CONFIG"), (("a=", "a="), "another name"),
    (("a=nowhere.yaml",), "nowhere.yaml: cannot read config")])
def test_an_actuator_that_cannot_be_is_refused(given, words):
    with pytest.raises(InputError, match=words) as caught:
        actuators(None, given, [], "monitor")
    assert "\n" not in str(caught.value)


def test_the_command_runs_two_waits_to_be_activated_and_ends_when_both_are_shut_down(graph):
    caller = Caller(graph, PATIENCE)
    both = ("--actuator", "left=", "--actuator", "right=")
    with command("monitor", *both, "--inactive") as process:
        for name in ("left", "right"):
            graph.until(lambda name=name: caller.state(f"/{name}/monitor") == "inactive", PATIENCE)
        health = listen(graph, DiagnosticArray, "/right/monitor/health", LATCHED)
        assert caller.change("/right/monitor", "activate")
        graph.until(lambda: health, PATIENCE)
        assert health[0].status[0].hardware_id == "right"
        for name in ("left", "right"):
            if name == "right":
                assert caller.change("/right/monitor", "deactivate")
            assert caller.change(f"/{name}/monitor", "shutdown")
        graph.until(lambda: process.poll() is not None, PATIENCE)
        out, err = process.communicate()
        assert process.returncode == 0, err
        assert "left: was not active" in out and "right: rows 0" in out
        assert "Traceback" not in err


def test_config_and_actuators_exclude_each_other(tmp_path):
    with command("monitor", "--config", "config/eha.yaml", "--actuator", "a=") as process:
        _, err = process.communicate(timeout=PATIENCE)
    assert process.returncode == 2 and "either it or --actuator" in err


def test_a_remap_that_makes_two_actuators_one_is_refused():
    with command("monitor", "--actuator", "a=", "--actuator", "b=", "--ros-args", "-r",
                 "__ns:=/c") as process:
        _, err = process.communicate(timeout=PATIENCE)
    assert process.returncode == 2 and "two actuators would both be /c/monitor" in err


def test_one_monitor_ends_on_a_signal_as_before(graph):
    caller = Caller(graph, PATIENCE)
    with command("monitor") as process:
        graph.until(lambda: caller.state(NODE) == "active", PATIENCE)
        assert end(process, signal.SIGTERM).startswith("rows 0;")
