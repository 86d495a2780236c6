"""Nothing is compiled after the set-up, whatever the recording and the config.

Here are the commands that take seconds; ``python benchmarks/compilations.py`` runs all of them,
with a diagnosis, a monitor and a proof.  What fails here is mended by its ``--write``.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from eha_monitor.compiled import CACHE

ROOT = Path(__file__).parents[1]
LIST = "python benchmarks/compilations.py --write makes eha_monitor/signatures.json anew"
# One process, for each takes a second to start: what any command compiled is told all the same.
COMMANDS = """
import json
from pathlib import Path

import numpy as np

from eha_monitor.cli import main
from eha_monitor.live.estimator import LiveEstimator
from eha_monitor.recordings.read import read_recording
from eha_monitor.recordings.recording import Recording
from eha_monitor.recordings.write import write_recording
from eha_monitor.settings import Settings

assert main(["simulate", "--duration", "4", "--out", "plain"]) == 0
whole = read_recording(Path("plain"), Settings())


def part(name, samples, channels):
    write_recording(Path(name), Recording(whole.sample_time, {
        channel: whole.channels[channel][:samples] for channel in channels}), Settings())


part("one", 1, whole.channels)
part("short", 600, whole.channels)
part("positions", 4000, ("x", "x_d"))
part("speeds", 4000, ("x", "omega"))
part("pressures", 4000, ("x", "p1", "p2"))
names = ("x", "x_d", "p1", "p2")
np.savetxt("table.csv", np.column_stack([np.arange(3000) * whole.sample_time, *(
    whole.channels[name][:3000] for name in names)]), delimiter=",",
    header="t,x,x_d,p1,p2", comments="")
Path("map.yaml").write_text(json.dumps({"table": {"time": "t", "columns": {
    name: {"column": name} for name in names}}}))
assert main(["import", "table.csv", "--map", "map.yaml", "--out", "imported"]) == 0
for bag in ("plain", "one", "short", "positions", "speeds", "pressures", "imported"):
    assert main(["estimate", bag, "--json", "answer.json"]) == (2 if bag == "one" else 0), bag
for name, tree in (("euler", {"discretisation": "euler"}), ("held", {"command_hold": "sampled"}),
                   ("late", {"effects": {"command_delay": {"T": 1e-3}}}),
                   ("dry", {"effects": {"coulomb_friction": {"F_c": 10.0}}})):
    Path("config.yaml").write_text(json.dumps(tree))
    assert main(["simulate", "--duration", "1", "--config", "config.yaml", "--out", name]) == 0
    assert main(["estimate", "plain", "--config", "config.yaml"]) == 0
live = LiveEstimator(Settings())
for k in range(0, len(whole), 10):
    live.push_rows(whole.time[k:k + 10], whole.part(k, k + 10).channels)
live.snapshot()
live.rehearse()
"""
# A signature that no command asks for.
ANOTHER = """
import numpy as np
from eha_monitor.estimation.small_matrices import times
times(np.eye(2, dtype=np.float32), np.eye(2))
"""


def run(script, folder, cache):
    """Run a script with a cache; returns what it compiled."""
    file = folder / "compiled.jsonl"
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=folder, text=True, capture_output=True, timeout=300,
        env=os.environ | {"EHA_MONITOR_CACHE": str(cache), "EHA_MONITOR_COMPILED": str(file),
                          "PYTHONPATH": str(ROOT)})
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []


@pytest.mark.timeout(600)
def test_no_command_compiles_after_the_set_up(tmp_path):
    subprocess.run([sys.executable, "-m", "eha_monitor.compile_all"], check=True, cwd=tmp_path,
                   env=os.environ | {"EHA_MONITOR_CACHE": str(CACHE.parent),
                                     "PYTHONPATH": str(ROOT)})
    compiled = run(COMMANDS, tmp_path, CACHE.parent)
    assert not compiled, f"{LIST}; it lacks {[line[1:5] for line in compiled if line[0] == 0]}"


def test_another_signature_is_told(tmp_path):
    compiled = run(ANOTHER, tmp_path, tmp_path / "cache")
    assert [line[:3] for line in compiled if line[0] == 0] == [
        [0, "eha_monitor.estimation.small_matrices", "times"]]
    assert compiled[-1][4] == "(float32[:, ::1], float64[:, ::1])"
