"""What stands where a file should be, and what it is called: one line and exit 2, at once."""

import json
import os
import shutil
import socket
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
from archive_tools import here
from bag_tools import JOINT, START, joint, write_mcap
from command_tools import refused

from eha_monitor.cli import main
from eha_monitor.recordings.read import read_recording
from eha_monitor.recordings.recording import Recording
from eha_monitor.recordings.write import write_recording
from eha_monitor.settings import Settings

BAG = Path(__file__).parents[1] / "bags" / "air_ingress"
MAP = "table: {time: t, columns: {x: {column: x}}}"
PIPE, SOCKET, DEVICE = "a pipe", "a socket", "a device"
STRANGE = "/eha/\x1b[31mjoint_states"  # paints a terminal red

# Runs commands, one after another, in one process: each ends with ";".
ONE_BY_ONE = """
import sys
from eha_monitor.cli import main
words = []
for word in sys.argv[1:]:
    words.append(word)
    if word == ";":
        print(main(words[:-1]), file=sys.stderr)
        words = []
"""


def strange(path, kind):
    """Put something that is no file at ``path``."""
    if kind == PIPE:
        os.mkfifo(path)
    elif kind == SOCKET:
        with socket.socket(socket.AF_UNIX) as made:
            made.bind(str(path))
    else:
        Path(path).symlink_to("/dev/zero")
    return path


def bag_with(folder, name, kind):
    """Return a folder like a bag's, with something else under the name of one of its files."""
    folder.mkdir()
    for file in BAG.iterdir():
        if file.name == name:
            strange(folder / name, kind)
        else:
            shutil.copy(file, folder)
    return folder


@pytest.mark.timeout(30)
@pytest.mark.parametrize("kind", [PIPE, SOCKET, DEVICE])
@pytest.mark.parametrize("command", [["estimate"], ["diagnose"], ["advise"]],
                         ids=lambda words: words[0])
def test_what_is_no_file_in_a_bag_is_refused_at_once(tmp_path, capfd, command, kind):
    part = next(BAG.glob("*.mcap")).name
    for i, name in enumerate(("metadata.yaml", part)):
        bag = bag_with(tmp_path / f"bag{i}", name, kind)
        assert f"{bag / name}: expected " in (said := refused(capfd, *command, bag))
        assert f"found {kind}" in said
    alone = strange(tmp_path / "alone.mcap", kind)
    assert f"{alone}: expected an mcap bag, found {kind}" in refused(capfd, *command, alone)


@pytest.mark.timeout(30)
@pytest.mark.parametrize("kind", [PIPE, SOCKET, DEVICE])
def test_what_is_no_file_in_place_of_a_config_or_a_table(tmp_path, capfd, kind):
    config = strange(tmp_path / "rig.yaml", kind)
    expected = f"{config}: expected a config, found {kind}"
    out = tmp_path / "out"
    for arguments in (["estimate", BAG, "--config", config], ["config", "--config", config],
                      ["simulate", "--config", config, "--out", out],
                      ["import", __file__, "--map", config, "--out", out]):
        assert expected in refused(capfd, *arguments)
    (tmp_path / "map.yaml").write_text(MAP)
    for name in ("a.csv", "a.mat", "a.csv.gz"):
        table = strange(tmp_path / name, kind)
        assert f"{table}: expected a CSV or MAT file, found {kind}" in refused(
            capfd, "import", table, "--map", tmp_path / "map.yaml", "--out", out)


@pytest.mark.timeout(60)
def test_in_an_archive_it_costs_its_own_row_only(tmp_path, capfd, monkeypatch):
    pytest.importorskip("pyarrow")
    folder = tmp_path / "bags"
    folder.mkdir()
    bag_with(folder / "bad", "metadata.yaml", PIPE)
    shutil.copytree(BAG, folder / "good")
    monkeypatch.setattr("eha_monitor.archive.run.on_this_machine", here)
    assert main(["estimate", str(folder), "--out", str(tmp_path / "out"), "--jobs", "1"]) == 0
    assert "found a pipe" in " ".join(capfd.readouterr().out.split())


@pytest.mark.timeout(30)
def test_a_config_may_come_from_a_command(tmp_path):
    """``--config <(make_config)`` of a shell: an open pipe, with somebody at the other end."""
    read, write = os.pipe()
    child = subprocess.Popen([sys.executable, "-m", "eha_monitor", "config", "--config",
                              f"/dev/fd/{read}"], pass_fds=[read], stdout=subprocess.PIPE,
                             text=True)
    os.close(read)
    with os.fdopen(write, "w") as pipe:
        pipe.write("rig: {name: from_a_pipe}")
    assert "from_a_pipe" in child.communicate()[0] and child.returncode == 0


def packed_zeros(name, rows):
    """Return a compressed variable of a MAT file, made without its zeros ever being held."""
    letters = name.encode()
    head = (struct.pack("<IIII", 6, 8, 6, 0) + struct.pack("<IIii", 5, 8, rows, 1)
            + struct.pack("<II", 1, len(letters)) + letters + b"\0" * (-len(letters) % 8)
            + struct.pack("<II", 9, 8 * rows))
    pack, left = zlib.compressobj(1), 8 * rows
    parts = [pack.compress(struct.pack("<II", 14, len(head) + left) + head)]
    while left:
        size = min(left, 1 << 20)
        parts.append(pack.compress(bytes(size)))
        left -= size
    data = b"".join([*parts, pack.flush()])
    return struct.pack("<II", 15, len(data)) + data


def test_a_mat_file_is_unpacked_only_as_far_as_it_is_wanted(tmp_path):
    """800 MB of zeros: what is not asked for is not read, what is too large is refused."""
    table, out = tmp_path / "a.mat", tmp_path / "bag"
    table.write_bytes(b"MATLAB 5.0 MAT-file".ljust(116) + b"\0" * 8
                      + struct.pack("<HH", 0x0100, 0x4d49)
                      + packed_zeros("huge", 101_000_000) + packed_zeros("x", 1000))
    # Not getrusage's maximum, which begins with that of the process that forked.
    code = ONE_BY_ONE + (
        "import re\n"
        "print(re.search(r'VmHWM:\\s+(\\d+)', open('/proc/self/status').read())[1])\n")
    words = []
    for column in ("nothing", "huge", "x"):
        path = tmp_path / f"{column}.yaml"
        path.write_text(f"table: {{columns: {{x: {{column: {column}}}}}}}")
        words += ["import", str(table), "--map", str(path), "--out", str(out), ";"]
    child = subprocess.run([sys.executable, "-c", code, *words], text=True, capture_output=True,
                           timeout=100, check=False)
    nothing, two, huge, again, done = child.stderr.splitlines()
    assert nothing.endswith("a.mat: variable 'nothing' not found, the file has huge, x")
    assert "a.mat: the variables huge hold 101000000 numbers, expected at most" in huge
    assert (two, again, done) == ("2", "2", "0")
    assert int(child.stdout.split()[-1]) < 500_000  # kB, the most at any time
    assert len(read_recording(out, Settings())) == 1000


# What the terminal of a stranger may make of names: strict UTF-8, or no UTF-8 at all.
TERMINALS = [{"PYTHONIOENCODING": "utf-8:strict"},
             {"PYTHONIOENCODING": "ascii:strict"},
             {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}]


@pytest.mark.timeout(300)
@pytest.mark.parametrize("terminal", TERMINALS, ids=["strict", "ascii", "C"])
def test_names_that_are_no_text(tmp_path, terminal):
    def name(plain):
        return os.fsdecode(os.fsencode(str(tmp_path)) + b"/\xff" + plain)

    def run(*commands):
        """Run commands, one after another, in one process with that terminal."""
        words = [word for arguments in commands for word in (*arguments, ";")]
        return subprocess.run(
            [sys.executable, "-c", ONE_BY_ONE, *words], text=True, errors="surrogateescape",
            capture_output=True, timeout=300, env=os.environ | terminal, check=False)

    Path(name(b"map.yaml")).write_text(MAP)
    Path(name(b"a.csv")).write_text("t,x\n" + "".join(
        f"{k * 1e-3},{0.01 * np.sin(k / 50)}\n" for k in range(1200)))
    whole = (
            ["simulate", "--out", name(b"bag"), "--duration", "1"],
            ["config", "--config", name(b"map.yaml")],
            ["estimate", name(b"bag"), "--json", name(b".json")],
            ["import", name(b"a.csv"), "--map", name(b"map.yaml"), "--out", name(b"table")],
            ["diagnose", name(b"bag"), "--json", name(b"d.json"), "--report",
             name(b"d.html"), "--write-config", name(b"d.yaml")],
            ["advise", name(b"bag"), "--no-check", "--json", name(b"v.json")])
    whole = whole if terminal is TERMINALS[0] else whole[:3]
    done = run(*whole, ["estimate", name(b"nothing")], ["config", "--config", name(b"nothing")])
    said = done.stderr.splitlines()
    assert done.returncode == 0 and said[:len(whole)] == ["0"] * len(whole), done.stderr
    assert len(said) == len(whole) + 4 and said[-3::2] == ["2", "2"], done.stderr
    assert json.loads(Path(name(b".json")).read_text())["samples"] == 1000


def strange_bag(path):
    stamps = START + np.arange(1000) * 1_000_000
    return str(write_mcap(path, [
        (STRANGE, JOINT, int(stamp), joint(int(stamp), ("piston",), (1e-5 * k % 0.01,), (), ()))
        for k, stamp in enumerate(stamps) if not 400 < k < 500]))


def test_a_topic_with_terminal_controls_is_read_and_told_without_them(tmp_path, capfd):
    bag, config = strange_bag(tmp_path / "a.mcap"), tmp_path / "rig.yaml"
    config.write_text(f"channels: {{x: {{topic: {json.dumps(STRANGE)}, name: piston, "
                      "field: position}}")
    assert main(["estimate", bag, "--config", str(config)]) == 0
    said = capfd.readouterr()
    assert "\x1b" not in said.out + said.err and "Traceback" not in said.err
    assert "\x1b" not in refused(capfd, "estimate", bag)


@pytest.mark.parametrize("topic", [STRANGE, "/eha/x\x00y", "a b", "/é", "/2x", "/x/"])
def test_a_topic_that_ros_does_not_take_is_one_line(tmp_path, capfd, topic):
    pytest.importorskip("rclpy")
    config = tmp_path / "rig.yaml"
    config.write_text(f"channels: {{x: {{topic: {json.dumps(topic)}, name: piston, "
                      "field: position}}")
    for arguments in (["monitor", "--config", config, "--duration", "1"],
                      ["simulator", "--config", config, "--duration", "1"],
                      ["dashboard", "--config", config, "--port", "0", "--duration", "1"],
                      ["record", "--out", tmp_path / "a", "--topic", topic, "--duration", "1"],
                      ["record", "--out", tmp_path / "b", "--config", config,
                       "--duration", "1"]):
        said = refused(capfd, *arguments)
        assert "is no name of a topic" in said and "\x1b" not in said, said


def test_a_bag_of_such_topics_is_not_replayed(tmp_path, capfd):
    pytest.importorskip("rclpy")
    bag = strange_bag(tmp_path / "a.mcap")
    assert main(["replay", bag]) == 2
    out, err = capfd.readouterr()
    assert "is no name of a topic" in err and "\x1b" not in err and "Traceback" not in out + err
    assert f"{bag}: expected a topic" in err.splitlines()[-1]


@pytest.mark.parametrize("samples", [1, 100, 499])
def test_a_bag_shorter_than_half_a_second_has_no_answer(tmp_path, capfd, samples):
    x = 0.01 * np.sin(np.arange(samples) / 20)
    bag = write_recording(tmp_path / "short", Recording(1e-3, {"x": x, "x_d": x}, START),
                          Settings())
    said = refused(capfd, "estimate", bag)
    assert said == (f"eha_monitor: {bag}: expected a recording of at least 0.5 s, found "
                    f"{samples * 1e-3:.3g} s\n")
    assert "expected at least 0.5 s" in refused(capfd, "diagnose", bag)
