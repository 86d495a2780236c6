"""The installation: `ros2 run` finds every executable, after pip and after colcon alike."""

import importlib.metadata
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

import eha_monitor
from eha_monitor.cli import cli

ROOT = Path(__file__).parents[1]
EXECUTABLES = sorted(path.name for path in (ROOT / "executables").iterdir())
# `config` prints a file; it is no program that a launch file would start.
COMMANDS = sorted(cli.commands)
SOURCES = ["eha_monitor", "executables", "scripts", "config", "launch", "bags", "resource",
           "package.xml", "setup.py", "setup.cfg", "pyproject.toml"]


def run(command: list, **options) -> subprocess.CompletedProcess:
    return subprocess.run([str(part) for part in command], capture_output=True, text=True,
                          timeout=120, **options)


def copy_of_the_source(target: Path) -> Path:
    """Copy what a build reads, so that nothing is built into the checkout."""
    target.mkdir()
    for name in SOURCES:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, target / name, symlinks=True,
                            ignore=shutil.ignore_patterns("__pycache__"))
        elif source.exists():
            shutil.copy(source, target / name)
    return target


def check_layout(prefix: Path) -> None:
    """Check what `ros2 run` and `ros2 launch` look for under an installation prefix."""
    marker = prefix / "share/ament_index/resource_index/packages/eha_monitor"
    assert marker.is_file()
    assert (prefix / "share/eha_monitor/package.xml").is_file()
    assert (prefix / "share/eha_monitor/config/eha.yaml").is_file()
    for name in EXECUTABLES:
        executable = prefix / "lib/eha_monitor" / name
        assert os.access(executable, os.X_OK), executable


def test_every_command_has_its_executable():
    assert EXECUTABLES == COMMANDS


def test_versions_agree():
    package = ElementTree.parse(ROOT / "package.xml").getroot()
    assert package.get("format") == "3"
    assert package.findtext("version") == eha_monitor.__version__
    assert f'version="{eha_monitor.__version__}"' in (ROOT / "setup.py").read_text()
    assert package.findtext("export/build_type") == "ament_python"


def test_lock_is_hashed_and_names_no_index():
    lock = (ROOT / "requirements.lock").read_text()
    assert "://" not in lock
    assert not re.search(r"^\s*(-i|--index-url|--extra-index-url|-f|--find-links)\b", lock,
                         re.MULTILINE)
    pinned = re.findall(r"^([a-z0-9._-]+)==", lock, re.MULTILINE)
    entries = re.split(r"\n(?=[a-z0-9._-]+==)", lock)[1:]
    assert len(entries) >= len(pinned) - 1
    assert all("--hash=sha256:" in entry for entry in entries)


def test_lock_has_every_requirement_and_each_has_its_reason():
    setup = (ROOT / "setup.py").read_text()
    required = re.findall(r'"([a-z0-9.-]+)(?:\[[a-z]+\])?"(?=[,\]])',
                          setup[setup.index("install_requires"):setup.index("entry_points")])
    assert len(required) > 20
    lock = (ROOT / "requirements.lock").read_text()
    reasons = (ROOT / "docs/dependencies.md").read_text()
    for name in required:
        assert re.search(rf"^{re.escape(name.replace('.', '-'))}==", lock, re.MULTILINE), name
        assert f"`{name}`" in reasons, f"docs/dependencies.md gives no reason for {name}"


def lock_part(*groups: str) -> set[str]:
    made = run([sys.executable, ROOT / "scripts/lock_groups.py", *groups])
    assert made.returncode == 0, made.stderr
    return set(re.findall(r"^([a-z0-9._-]+)==", made.stdout, re.MULTILINE))


def test_groups_of_the_lock_hold_all_that_they_need():
    from packaging.requirements import Requirement

    demo = lock_part("core", "ros")
    assert {"ros-rclpy", "ros-rmw-fastrtps-cpp", "setuptools"} <= demo
    assert not demo & {"casadi", "mujoco", "nicegui", "playwright", "pyarrow", "pytest", "ziglang"}
    for name in demo:
        try:
            asked = [Requirement(one) for one in importlib.metadata.requires(name) or ()]
        except importlib.metadata.PackageNotFoundError:
            continue  # of another Python or system
        for one in asked:
            if one.marker is None or one.marker.evaluate({"extra": ""}):
                need = re.sub("[._]", "-", one.name.lower())
                assert need in demo, f"{name} needs {one}"
    lock = (ROOT / "requirements.lock").read_text()
    groups = re.findall(r'^        "([a-z]+)": \[', (ROOT / "setup.py").read_text(), re.MULTILINE)
    assert lock_part("core", *groups) == set(re.findall(r"^([a-z0-9._-]+)==", lock, re.MULTILINE))


def test_what_is_there_first_compiles():
    """`make` begins to compile while the other packages are still being installed."""
    imports = """
import sys
before = set(sys.modules)
import importlib
import eha_monitor.compile_all as first
for module, _ in first.LIVE:
    importlib.import_module(f"eha_monitor.{module}")
print(*{name.split(".")[0] for name in set(sys.modules) - before
        if "site-packages" in (getattr(sys.modules[name], "__file__", "") or "")})"""
    made = run([sys.executable, "-c", imports], env=os.environ | {"PYTHONPATH": str(ROOT)})
    assert made.returncode == 0, made.stderr
    owners = importlib.metadata.packages_distributions()
    taken = {re.sub("[._]", "-", owners[name][0].lower()) for name in made.stdout.split()
             if name in owners and name != "eha_monitor"}
    assert "numba" in taken
    assert taken - {"coverage", "pyyaml"} <= lock_part("compiles")  # numba takes what is there


def test_an_unknown_group_is_told_in_a_line():
    made = run([sys.executable, ROOT / "scripts/lock_groups.py", "exports"])
    assert made.returncode and made.stderr.count("\n") == 1 and "not exports" in made.stderr


def test_pip_layout(tmp_path):
    """The package that pip installs has the layout, and its executables run."""
    source = copy_of_the_source(tmp_path / "source")
    prefix = tmp_path / "prefix"
    made = run([sys.executable, "-m", "pip", "install", "--quiet", "--no-deps",
                "--no-build-isolation", "--disable-pip-version-check",
                "--ignore-installed",  # else pip removes the one in this environment
                "--prefix", prefix,
                source], cwd=tmp_path)
    assert made.returncode == 0, made.stderr
    check_layout(prefix)
    assert (prefix / "bin/eha-monitor").is_file()
    check_executables(prefix, tmp_path)


def test_colcon_build(tmp_path):
    """`colcon build` puts the same layout below install/, and its executables run."""
    if importlib.util.find_spec("colcon_core") is None:
        pytest.skip("colcon is not installed (make setup WITH=colcon)")
    workspace = tmp_path / "workspace"
    workspace.mkdir()
    copy_of_the_source(workspace / "eha_monitor")
    made = run([Path(sys.executable).with_name("colcon"), "build"], cwd=workspace,
               env=os.environ | {"COLCON_HOME": str(tmp_path / "colcon")})
    assert made.returncode == 0, made.stderr
    prefix = workspace / "install/eha_monitor"
    check_layout(prefix)
    check_executables(prefix, tmp_path)


def check_executables(prefix: Path, elsewhere: Path) -> None:
    """Start an executable away from the checkout, with the prefix's own package.

    All are one file under several names.
    """
    texts = {(prefix / "lib/eha_monitor" / name).read_text() for name in EXECUTABLES}
    assert len(texts) == 1
    library, = prefix.glob("lib/python3*/site-packages")
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = os.environ | {"PYTHONPATH": str(library), "PATH": path}
    name = EXECUTABLES[0]
    shown = run([prefix / "lib/eha_monitor" / name, "--help"], cwd=elsewhere, env=environment)
    assert shown.returncode == 0, shown.stderr
    assert f"eha_monitor {name}" in shown.stdout


def test_installed_package_is_found_by_the_ament_index(tmp_path):
    prefix = Path(sys.prefix)
    if not (prefix / "share/ament_index/resource_index/packages/eha_monitor").is_file():
        pytest.skip("eha_monitor is not installed into this environment (make setup)")
    code = ("from ament_index_python import get_package_prefix, get_package_share_directory;"
            "print(get_package_prefix('eha_monitor'));"
            "print(get_package_share_directory('eha_monitor'))")
    found = run([sys.executable, "-c", code], cwd=tmp_path,
                env=os.environ | {"AMENT_PREFIX_PATH": str(prefix)})
    assert found.stdout.split() == [str(prefix), str(prefix / "share/eha_monitor")], found.stderr


def test_no_registry_host_and_no_machine_path_in_the_repository():
    listed = run(["git", "ls-files", "-z"], cwd=ROOT)
    if listed.returncode:
        pytest.skip("not a git checkout")
    # Put together here, so that this file does not name them.
    banned = ["pypi" + ".org", "pythonhosted" + ".org", "/root" + "/", "/work" + "/main"]
    for name in filter(None, listed.stdout.split("\0")):
        path = ROOT / name
        if path.is_file() and path.suffix not in (".mcap", ".png"):
            text = path.read_text(encoding="utf-8", errors="replace")
            assert not [word for word in banned if word in text], name
