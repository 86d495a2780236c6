"""The README's three commands, as they stand there: simulator, monitor, dashboard."""

import os
import re
import signal
import subprocess
import sys
import threading
import urllib.request
from pathlib import Path

import pytest

pytest.importorskip("rclpy")
pytest.importorskip("nicegui")

ROOT = Path(__file__).parents[1]
WANTED = re.compile(r"βe converged at (\d+) ± \d+ MPa")


def start(words: list[str]) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, "-m", "eha_monitor", *words], cwd=ROOT, text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"},
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)


# Three processes until βe has converged; test_ros_processes.py and test_dashboard.py run each.
@pytest.mark.slow
@pytest.mark.timeout(120)
def test_three_commands_show_a_rig(tmp_path):
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    part = readme.split("each in a terminal of its own:")[1].split("`make demo`")[0]
    lines = re.findall(r"^    eha-monitor (\w+)", part, re.MULTILINE)
    assert lines == ["simulator", "monitor", "dashboard"]
    processes = [start([name, *(["--port", "0"] if name == "dashboard" else [])])
                 for name in lines]
    watch = threading.Timer(90.0, lambda: [one.kill() for one in processes])
    watch.start()
    try:
        found = next((match for line in processes[1].stdout if (match := WANTED.search(line))),
                     None)
        assert found, "the monitor ended before βe converged"
        assert abs(int(found[1]) / 600 - 1) < 0.1
        address = re.search(r"http://127\.0\.0\.1:\d+/", processes[2].stdout.readline())[0]
        with urllib.request.urlopen(address, timeout=30) as page:
            assert re.search(r"<title>. (OK|STALE): eha</title>", page.read().decode())
    finally:
        watch.cancel()
        for one in processes:
            one.send_signal(signal.SIGINT)
        for one in processes:
            one.communicate(timeout=30)
    assert [one.returncode for one in processes] == [0, 0, 0]
