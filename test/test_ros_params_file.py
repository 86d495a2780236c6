"""One form of config: the same file as ``--config`` and as ``--params-file``, read by rcl."""

import re
from pathlib import Path

import pytest
import rclpy
import yaml
from command_tools import refused
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient

from eha_monitor.errors import InputError
from eha_monitor.ros import running
from eha_monitor.ros.parameters import MONITOR_KEYS, declare, settings_of_node, with_namespace
from eha_monitor.settings import Settings, load_settings

ROOT = Path(__file__).parents[1]
CONFIGS = sorted(path for path in (ROOT / "config").glob("*.yaml")
                 if path.name != "diagnostic_aggregator.yaml")
README = re.search(r"```yaml\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"),
                   re.S).group(1)
PLAIN = """
rig: {name: bench, mass: 25, area_1: 5.05 cm^2, position_gain: null, sample_time: 2 ms}
monitor: {namespace: /bench, save_on: off}
thresholds: {viscous_damping: {low_warn: 1200, high_error: null}}
effects: {}
channels: {p1: {offset: 101325}, p2: {offset: 1.0e+5}}
simulation: {publish: [x, x_d], excitation: {wave: {kind: sine, amplitude: 1}}}
"""
IN_ROS_FORM = "/**:\n  ros__parameters:\n" + "".join(
    f"    {line}\n" for line in PLAIN.strip().splitlines())
NESTED = ("eha:\n  monitor:\n    ros__parameters:\n      use_sim_time: false\n"
          "      rig.mass: 25\n      rig: {area_1: 5.0e-4}\n")


def as_parameters(path, name="monitor"):
    """Return what a node reads of a file that is given to ROS."""
    arguments = ["--ros-args", "--params-file", str(path)]
    with running.ros_session(arguments):
        settings = with_namespace(Settings(), arguments, name)
        with running.node(name, settings.monitor.namespace) as node:
            return settings_of_node(node, settings), node.get_namespace()


def check_alike(path):
    by_ros, namespace = as_parameters(path)
    by_config = load_settings(path)
    assert list(by_ros.simulation.excitation) == list(by_config.simulation.excitation)
    assert by_ros == by_config and namespace == by_config.monitor.namespace
    assert by_ros.rig.model_fields_set == by_config.rig.model_fields_set


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.name)
def test_every_config_is_a_parameter_file(path):
    check_alike(path)


@pytest.mark.parametrize("text", [README, PLAIN, IN_ROS_FORM, NESTED],
                         ids=["readme", "plain", "in_ros_form", "nested"])
def test_both_forms_say_the_same_to_both(text, tmp_path):
    path = tmp_path / "rig.yaml"
    path.write_text(text, encoding="utf-8")
    check_alike(path)


def test_a_file_beside_a_config_and_a_parameter_have_their_order(tmp_path):
    """As ROS has it: what comes later wins, and all of it over ``--config``."""
    first, second = tmp_path / "first.yaml", tmp_path / "second.yaml"
    first.write_text("rig: {mass: 11, leakage: 4.0e-13}", encoding="utf-8")
    second.write_text("/eha/monitor: {ros__parameters: {rig: {mass: 12.0}}}", encoding="utf-8")
    arguments = ["--params-file", str(first), "--params-file", str(second),
                 "-p", "thresholds.confidence:=3"]
    with running.ros_session(arguments), running.node("monitor", "/eha") as node:
        found = settings_of_node(node, load_settings(ROOT / "config" / "eha.yaml"))
    assert (found.rig.mass, found.rig.leakage, found.thresholds.confidence) == (12.0, 4e-13, 3.0)


def test_what_ros2_param_dump_writes_is_a_config(tmp_path, graph):
    """The dump as ``ros2 param dump`` makes it: nested, with NaN where nothing is set."""
    settings = load_settings(ROOT / "config" / "ivliev_eha.yaml")
    declare(graph.node("monitor", "/eha"), settings, MONITOR_KEYS)
    client = AsyncParameterClient(graph.node("shell"), "/eha/monitor")
    graph.until(client.services_are_ready)
    listed = client.list_parameters()
    graph.until(listed.done)
    names = list(listed.result().result.names)
    answer = client.get_parameters(names)
    graph.until(answer.done)
    tree = {}
    for name, value in zip(names, answer.result().values, strict=True):
        *path, last = name.split(".")
        place = tree
        for part in path:
            place = place.setdefault(part, {})
        place[last] = parameter_value_to_python(value)
    dump = tmp_path / "dump.yaml"
    dump.write_text(yaml.dump({"/eha/monitor": {"ros__parameters": tree}}), encoding="utf-8")
    found = load_settings(dump)
    assert all(getattr(found, key) == getattr(settings, key) for key in MONITOR_KEYS)


@pytest.mark.parametrize(("text", "words"), [
    ("rig: {mas: 1}", "ROS parameters: rig.mas: unknown key, did you mean 'mass'"),
    ("rig: {mass: 20 m}", "ROS parameters: rig.mass: expected a number in kg, got '20 m'"),
    ("rig: [", "file.yaml: expected YAML, cannot parse at line 1"),
    ("- 1", "file.yaml: expected a mapping of sections, got list"),
    ("simulation: {publish: []}", "file.yaml: simulation.publish: expected at least one entry"),
    (None, "file.yaml: cannot read parameter file: No such file")])
def test_what_cannot_be_is_one_line_and_status_2(text, words, tmp_path, capfd):
    path = tmp_path / "file.yaml"
    if text is not None:
        path.write_text(text, encoding="utf-8")
    assert words in refused(capfd, "simulator", "--duration", 0.1,
                            "--ros-args", "--params-file", path)
    assert not rclpy.ok()


def test_a_parameter_file_of_others_is_left_to_rcl(tmp_path):
    """Not one of ours may be YAML that only rcl knows; it is refused there, in one line."""
    path = tmp_path / "file.yaml"
    path.write_text("/**: {ros__parameters: {a: 1}}\n/**: {ros__parameters: {b: 2.5}}\n")
    with running.ros_session(["--params-file", str(path)]), running.node("any") as node:
        assert node.get_parameter("b").type_ == Parameter.Type.DOUBLE
    path.write_text("/**: {ros__parameters: {a: [1, two, ]}")
    with (pytest.raises(InputError, match="Couldn't parse params file"),
          running.ros_session(["--params-file", str(path)])):
        pass
