"""Which room may use which: held on the import statements of the source."""

import ast
import re
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "eha_monitor"
FILES = sorted(PACKAGE.rglob("*.py"))

# Room -> rooms and libraries that it must not import.
FORBIDDEN = {
    "physics": ("rclpy", "eha_monitor.recordings", "eha_monitor.estimation", "eha_monitor.health",
                "eha_monitor.mismatch", "eha_monitor.reports", "eha_monitor.ros"),
    "estimation": ("rclpy", "eha_monitor.ros", "eha_monitor.mismatch", "eha_monitor.reports",
                   "eha_monitor.commands", "eha_monitor.live"),
    "live": ("rclpy", "eha_monitor.ros", "eha_monitor.mismatch", "eha_monitor.reports",
             "eha_monitor.commands"),
    "health": ("rclpy", "eha_monitor.ros", "eha_monitor.mismatch", "eha_monitor.reports"),
    "plausibility": ("rclpy", "eha_monitor.ros", "eha_monitor.estimation", "eha_monitor.mismatch",
                     "eha_monitor.reports", "eha_monitor.commands", "eha_monitor.health"),
    "indicators": ("rclpy", "eha_monitor.ros", "eha_monitor.reports", "eha_monitor.commands",
                   "eha_monitor.archive"),
    "recordings": ("rclpy", "eha_monitor.ros", "eha_monitor.estimation", "eha_monitor.mismatch"),
    "mismatch": ("rclpy", "eha_monitor.ros", "eha_monitor.commands", "eha_monitor.prove",
                 "eha_monitor.concealed", "eha_monitor.reports"),
    "identify": ("rclpy", "eha_monitor.ros", "eha_monitor.commands", "eha_monitor.reports",
                 "eha_monitor.concealed"),
    "prove": ("rclpy", "eha_monitor.ros", "eha_monitor.commands", "eha_monitor.reports"),
    "reports": ("rclpy", "eha_monitor.ros", "eha_monitor.commands"),
    "exports": ("rclpy", "eha_monitor.ros", "eha_monitor.estimation", "eha_monitor.health",
                "eha_monitor.reports", "eha_monitor.commands"),
    "draft": ("rclpy", "eha_monitor.ros", "eha_monitor.estimation", "eha_monitor.mismatch",
              "eha_monitor.reports", "eha_monitor.commands", "eha_monitor.health"),
    "archive": ("rclpy", "eha_monitor.ros", "eha_monitor.mismatch", "eha_monitor.reports",
                "eha_monitor.commands"),
    "api": ("rclpy", "click", "eha_monitor.ros", "eha_monitor.commands", "eha_monitor.prove",
            "eha_monitor.concealed", "eha_monitor.dashboard"),
    "dashboard": ("rclpy", "eha_monitor.ros", "eha_monitor.commands", "eha_monitor.recordings",
                  "eha_monitor.mismatch"),
}
# Who may use the Python interface: the package's own face, and the commands.
USES_API = {"__init__.py", "api", "commands"}
ROS_PACKAGES = ("rclpy", "rcl_interfaces", "sensor_msgs", "std_msgs", "std_srvs",
                "diagnostic_msgs", "lifecycle_msgs", "rosgraph_msgs", "builtin_interfaces")
# The one place that asks whether ROS is there, to say so in one line.
MAY_ASK_FOR_ROS = {"commands/common.py"}


@cache
def imported(path: Path) -> set[str]:
    """Return every module that a file imports, wherever the statement stands."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names.update(f"{node.module}.{alias.name}" for alias in node.names)
    return names


def uses(names: set[str], prefix: str) -> list[str]:
    return sorted(name for name in names if name == prefix or name.startswith(prefix + "."))


@pytest.mark.parametrize("room", FORBIDDEN)
def test_rooms_import_only_what_they_may(room):
    wrong = {str(path.relative_to(PACKAGE)): found for path in FILES
             if path.relative_to(PACKAGE).with_suffix("").parts[0] == room
             if (found := [name for other in FORBIDDEN[room]
                           for name in uses(imported(path), other)])}
    assert not wrong


def test_ros_is_imported_only_in_its_room():
    wrong = {place: found for path in FILES
             if not (place := str(path.relative_to(PACKAGE))).startswith("ros/")
             and place not in MAY_ASK_FOR_ROS
             if (found := [name for package in ROS_PACKAGES
                           for name in uses(imported(path), package)])}
    assert not wrong


def test_only_the_commands_use_the_python_interface():
    users = {path.relative_to(PACKAGE).parts[0] for path in FILES
             if uses(imported(path), "eha_monitor.api")}
    assert users == USES_API


def test_no_circle_of_imports():
    """Wherever the statements stand, those inside functions too."""
    modules = {".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts): path
               for path in FILES if path.name != "__init__.py"}
    needs = {name: {other for other in modules if other != name and uses(imported(path), other)}
             for name, path in modules.items()}
    while free := [name for name, others in needs.items() if not others & needs.keys()]:
        for name in free:
            del needs[name]
    while unused := needs.keys() - set().union(*needs.values()):
        for name in unused:  # it leads to a circle, and is in none
            del needs[name]
    assert not set(needs)


@pytest.mark.parametrize("folder", ["benchmarks", "scripts"])
def test_what_runs_seldom_imports_what_is_there(folder):
    """A statement inside a function fails only when somebody runs it."""
    gone = {f"{path.name}: {node.module}.{alias.name}"
            for path in (PACKAGE.parent / folder).rglob("*.py")
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
            if isinstance(node, ast.ImportFrom) and node.module.startswith("eha_monitor")
            for alias in node.names if not hasattr(import_module(node.module), alias.name)
            and find_spec(f"{node.module}.{alias.name}") is None}
    assert not gone


def test_physics_names_nothing_of_the_diagnosis():
    for path in (PACKAGE / "physics").rglob("*.py"):
        code = ast.unparse(ast.parse(path.read_text(encoding="utf-8")))
        assert not re.search(r"\bmismatch\b", code), path
