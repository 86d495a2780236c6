"""The demo's child processes: none survives its step, and a failed one is told."""

import os
from pathlib import Path

import pytest
from demo import Children, DemoFailed

ROOT = Path(__file__).parents[1]


def test_children_end_with_their_step(tmp_path, monkeypatch):
    pytest.importorskip("rclpy")
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path))
    with pytest.raises(ZeroDivisionError), Children(tmp_path) as children:
        children.start("monitor")
        children.start("simulator")
        numbers = [child.pid for child in children._running.values()]
        raise ZeroDivisionError
    for number in numbers:
        with pytest.raises(ProcessLookupError):
            os.kill(number, 0)


def test_a_child_that_fails_is_told(tmp_path):
    with Children(tmp_path) as children:
        children.start("estimate", "missing_bag")
        with pytest.raises(DemoFailed, match="status 2: eha_monitor: missing_bag: no such bag"):
            children.finish()


def test_bundled_bags_are_small():
    size = sum(path.stat().st_size for path in (ROOT / "bags").rglob("*") if path.is_file())
    assert size < 4_000_000
