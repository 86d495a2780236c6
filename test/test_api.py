"""The Python interface: stable names, the commands' own answers, and what users get wrong."""

import asyncio
import copy
import dataclasses
import inspect
import json
import os
import pickle
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pandas
import pytest

import eha_monitor as em
from eha_monitor.cli import main

ROOT = Path(__file__).parents[1]
AIR, HIDDEN = ROOT / "bags/air_ingress", ROOT / "bags/hidden_friction"
# Other programs rely on these: extend them, change what stands here only with a reason.
CALLS = {
    "read": "(path, config=None)",
    "simulate": "(config=None, *, duration=None, seed=None, progress=False)",
    "estimate": "(recording, config=None, *, progress=False)",
    "diagnose": "(recordings, config=None, *, held_out=None, references=(), hypothesis=None, "
                "without=(), vary=(), machine=None, progress=False)",
    "advise": "(recordings, config=None, *, check=True, progress=False)",
    "Config": "(**sections)",
    "Config.load": "(path)", "Config.from_dict": "(tree)", "Config.changed": "(self, **sections)",
    "Config.to_dict": "(self)", "Config.to_yaml": "(self, title='')",
    "Config.save": "(self, path)", "Config.to_frame": "(self)",
    "Recording": "(channels, sample_time, start_ns=0, source='', losses=(), config=None)",
    "Recording.from_frame": "(frame, sample_time=None, *, source='')",
    "Recording.between": "(self, start, stop)", "Recording.to_dict": "(self)",
    "Recording.to_frame": "(self)", "Recording.plot": "(self, *channels)",
    "Recording.write": "(self, path, *, overwrite=False)",
    "Estimate.to_dict": "(self)", "Estimate.to_frame": "(self, table='parameters')",
    "Estimate.plot": "(self, what='parameters')", "Estimate.report": "(self, path)",
    "Diagnosis.to_dict": "(self)", "Diagnosis.to_frame": "(self, table='effects')",
    "Diagnosis.plot": "(self, what='missing')", "Diagnosis.completed": "(self)",
    "Diagnosis.report": "(self, path, *, command='')",
    "Advice.to_dict": "(self)", "Advice.to_frame": "(self, table='visible_from')",
    "Advice.plot": "(self)", "Advice.excitation": "(self)",
}
SHOWN = {
    "Config": "rig simulation thresholds monitor effects",
    "Recording": "channels sample_time start_ns source losses config duration time",
    "Estimate": "config alarms alarm_history channels observability recording parameters joint "
                "model stage_one stage_two events warnings healthy",
    "Diagnosis": "config channels losses verdict message healthy bags probability effects "
                 "rig_data learned changes location before after signals health advice",
    "Advice": "config bags named channels sentences parameters confusions visible_from doubts "
              "motion",
    "ImplausibleError": "",
}


def bare(function) -> str:
    """Return a signature without its types."""
    signature = inspect.signature(function)
    return str(signature.replace(return_annotation=inspect.Signature.empty, parameters=[
        one.replace(annotation=inspect.Parameter.empty)
        for one in signature.parameters.values()]))


def in_new_process(code: str) -> str:
    """Run code in a fresh interpreter and return what it printed."""
    kept = {key: value for key, value in os.environ.items() if key != "OPENBLAS_NUM_THREADS"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT,
                          env=kept | {"PYTHONPATH": str(ROOT)}, timeout=100)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def healthy():
    return em.simulate(duration=4.0, seed=3)


@pytest.fixture(scope="module")
def air():
    return em.estimate(AIR)


def test_the_names_and_their_signatures_stand():
    assert set(em.__all__) == {name.partition(".")[0] for name in (*CALLS, *SHOWN)} | {
        "InputError"}
    for name, signature in CALLS.items():
        part = em
        for step in name.split("."):
            part = getattr(part, step)
        expected = signature.replace("(self)", "()").replace("(self, ", "(") if (
            inspect.ismethod(part)) else signature
        assert bare(part) == expected, name
    for record, names in SHOWN.items():
        shown = {name for name, part in inspect.getmembers_static(getattr(em, record))
                 if isinstance(part, property) or type(part).__name__ == "cached_property"}
        shown |= set(getattr(getattr(em, record), "__dataclass_fields__", ()))
        assert set(names.split()) <= shown, record


def test_importing_it_imports_nothing_heavy_and_dir_lists_it():
    heavy = in_new_process(
        "import sys, eha_monitor as em; assert set(em.__all__) <= set(dir(em));"
        "print(*{'numpy', 'numba', 'pandas', 'pydantic', 'matplotlib', 'click'} & "
        "set(sys.modules))")
    assert not heavy.strip()
    with pytest.raises(AttributeError, match="no attribute 'diagnos'"):
        em.diagnos  # noqa: B018


def test_numpy_first_changes_no_number_and_an_answer_needs_neither_tables_nor_pictures(air):
    written = in_new_process(
        "import numpy, sys, json, eha_monitor as em; em.diagnose, em.advise, em.simulate;"
        f"answer = em.estimate({str(AIR)!r}).to_dict();"
        "heavy = {'pandas', 'matplotlib', 'rclpy', 'IPython', 'click'} & set(sys.modules);"
        "assert not heavy, heavy; print(json.dumps(answer))")
    assert json.loads(written) | {"wall_s": 0} == air.to_dict() | {"wall_s": 0}


def test_to_dict_is_what_the_command_writes(air, tmp_path, capsys):
    target = tmp_path / "answer.json"
    assert main(["estimate", str(AIR), "--json", str(target)]) == 0
    written = json.loads(target.read_text())
    assert written | {"wall_s": 0} == air.to_dict() | {"wall_s": 0}
    json.dumps(air.to_dict(), allow_nan=False)


def test_a_simulation_is_the_bag_that_the_command_writes(healthy, tmp_path, capsys):
    bag = tmp_path / "bag"
    assert main(["simulate", "--out", str(bag), "--duration", "4", "--seed", "3"]) == 0
    there = em.read(bag)
    assert list(there.channels) == list(healthy.channels)
    for name, values in there.channels.items():
        np.testing.assert_array_equal(values, healthy.channels[name])
    assert there.start_ns == healthy.start_ns
    again = em.read(healthy.write(tmp_path / "again.mcap"))
    np.testing.assert_array_equal(again.channels["p1"], healthy.channels["p1"])
    with pytest.raises(em.InputError, match=r"again\.mcap"):
        healthy.write(tmp_path / "again.mcap")


def test_a_table_is_read_as_it_is_imported(healthy, tmp_path, capsys):
    columns = {"ms": healthy.time * 1e3, "mm": healthy.channels["x"] * 1e3,
               "goal": healthy.channels["x_d"] * 1e3, "bar a": healthy.channels["p1"] * 1e-5,
               "bar b": healthy.channels["p2"] * 1e-5}
    pandas.DataFrame(columns).to_csv(tmp_path / "log.csv", index=False, sep=";")
    config = em.Config(table={"time": "ms", "time_scale": "1 ms", "columns": {
        "x": {"column": "mm", "scale": 1e-3}, "x_d": {"column": "goal", "scale": 1e-3},
        "p1": {"column": "bar a", "scale": 1e5}, "p2": {"column": "bar b", "scale": 1e5}}})
    config.save(tmp_path / "map.yaml")
    assert em.Config.load(tmp_path / "map.yaml") == config
    assert main(["import", str(tmp_path / "log.csv"), "--map", str(tmp_path / "map.yaml"),
                 "--out", str(tmp_path / "bag")]) == 0
    table, bag = em.read(tmp_path / "log.csv", config), em.read(tmp_path / "bag")
    for name, values in table.channels.items():
        np.testing.assert_array_equal(values, bag.channels[name])
    b = em.estimate(table).parameters["B"]
    assert abs(b.value - 600.0) < 4 * b.stddev + 3.0
    # Read without a map, or with one that is not that of the diagnosis.
    with pytest.raises(em.InputError, match=r"config: table\.columns: expected"):
        em.read(tmp_path / "log.csv")
    with pytest.raises(em.InputError, match=r"another section table .*em\.read\(path, config\)"):
        em.estimate(table, config.changed(table={"time_scale": "2 ms"}))
    em.estimate(bag, config)  # the map of an import is none of the bag's


@pytest.mark.parametrize("words", [
    ("estimate", "no/such/bag"), ("estimate", "setup.py"), ("estimate", "docs"),
    ("estimate", "bags/air_ingress", "--config", "no.yaml"),
    ("estimate", "bags/air_ingress", "--config", "setup.py"),
    ("diagnose", "bags/air_ingress", "bags/air_ingress"),
    ("diagnose", "bags/air_ingress", "--hypothesis", "config/eha.yaml")])
def test_bad_input_is_the_line_of_the_command(words, monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    assert main(list(words)) == 2
    line = capsys.readouterr().err.removeprefix("eha_monitor: ").strip()
    bags = [word for word in words[1:3] if not word.startswith("--")][:2]
    named = {words[i].strip("-"): words[i + 1] for i in range(len(words))
             if words[i].startswith("--")}
    with pytest.raises(em.InputError) as problem:
        getattr(em, words[0])(bags if len(bags) > 1 else bags[0], **named)
    assert str(problem.value) == line


@pytest.mark.parametrize(("call", "words"), [
    (lambda: em.read("bags"), r"^bags: expected one bag, found a folder of 2: air_ingress, hid"),
    (lambda: em.read(None), "path: expected a bag, a CSV or a MAT file, got None"),
    (lambda: em.read(em.read(AIR)), "read: expected a path, got a recording of .*air_ingress"),
    (lambda: em.estimate([AIR, HIDDEN]), "expected one, got 2"),
    (lambda: em.estimate(np.zeros(9)), "recording: expected an em.Recording, a path, or a list"),
    (lambda: em.diagnose([]), "recordings: expected at least one recording"),
    (lambda: em.diagnose(AIR, without="friction"), "without: friction: expected an effect of the"),
    (lambda: em.diagnose(AIR, held_out=AIR), "held_out names a bag that is fitted"),
    (lambda: em.diagnose(AIR, references=HIDDEN, without="added_mass"), "references: expected ne"),
    (lambda: em.diagnose(AIR, hypothesis={"name": "mine"}), "hypothesis: adds: field required"),
    (lambda: em.diagnose(AIR, 5), "config: expected an em.Config, a YAML file, a mapping or None"),
    (lambda: em.simulate(duration="2 m"), "duration: expected seconds, more than 0, got '2 m'"),
    (lambda: em.simulate(seed=-1), "seed: expected a whole number from 0 on, got -1"),
    (lambda: em.simulate(seed=0.5), "seed: expected a whole number"),
    (lambda: em.Config(rig={"mass": "20 m"}), "config: rig.mass: expected a number in kg, got '2"),
    (lambda: em.Config(rig={"mas": 20}), "config: rig.mas: unknown key, did you mean 'mass'"),
    (lambda: em.Config(mass=20), "config: mass: unknown key"),
    (lambda: em.Config.from_dict([1]), "config: expected a mapping of sections, got list"),
    (lambda: em.Config().changed(rig={"mass": -1}), "rig.mass: expected more than 0 in kg, got -"),
    (lambda: em.Config.load("~/no/rig.yaml"), r"^/.*/no/rig\.yaml: "),
    (lambda: em.Recording({}, 1e-3), "channels: expected a mapping of channel to array"),
    (lambda: em.Recording({"y": [1.0]}, 1e-3), "channel 'y': expected one of x, v, x_d"),
    (lambda: em.Recording({"x": ["a"]}, 1e-3), "channel x: expected numbers in m"),
    (lambda: em.Recording({"x": np.zeros((2, 2))}, 1e-3), r"got shape \(2, 2\)"),
    (lambda: em.Recording({"x": [0.0], "v": [0.0, 1.0]}, 1e-3), "differ in length: x 1, v 2"),
    (lambda: em.Recording({"x": [0.0]}, "1 ms"), "sample_time: expected seconds, more than 0"),
    (lambda: em.Recording.from_frame(pandas.DataFrame({"x": [0.0, 1.0, 2.0]}, [0.0, 1.0, 5.0])),
     "expected an index of evenly spaced times in s, or sample_time"),
    (lambda: em.Recording.from_frame({"x": [1.0]}), "expected a pandas.DataFrame, got dict"),
    (lambda: em.estimate(em.Recording({"x": np.zeros(900)}, 2e-3)),
     r"a row every 0\.002 s, and the config says rig\.sample_time 0\.001 s"),
    (lambda: em.estimate(em.Recording({"x": np.zeros(9)}, 1e-3, source="own")),
     "own: expected a recording of at least 0.5 s"),
    (lambda: em.read(AIR).between(5.0, 2.0), "between 5.0 and 2.0: expected two times in s"),
    (lambda: em.read(AIR).plot("force"), "plot: expected one of x, x_d, omega, p1, p2, got 'for"),
])
def test_what_users_get_wrong_is_told_in_one_line(call, words, monkeypatch):
    monkeypatch.chdir(ROOT)
    with pytest.raises(em.InputError, match=words) as problem:
        call()
    assert "\n" not in str(problem.value)


def test_a_recording_that_contradicts_its_config_comes_with_the_mended_one(healthy):
    metres = em.Recording({name: values * (1e3 if name[0] == "x" else 1.0)
                           for name, values in healthy.channels.items()}, 1e-3, source="mm")
    with pytest.raises(em.ImplausibleError, match=r"^mm: x.* looks? like") as problem:
        em.diagnose(metres)
    found = problem.value
    assert isinstance(found, em.InputError)
    assert {name for one in found.channels for name in one.channels} >= {"x"}
    # What the channels say belongs into the reading of a file: 1e-3 m for each mm.
    assert found.corrected.settings.channels["x"].scale == pytest.approx(1e-3)
    again = pickle.loads(pickle.dumps(found))
    assert str(again) == str(found) and again.corrected == found.corrected


def test_configs_take_units_and_merge_by_section():
    config = em.Config(rig={"mass": "25 kg", "area_1": "5.05 cm^2",
                            "sample_time": np.float64(2e-3)},
                       effects={"coulomb_friction": {"F_c": "40 N"}})
    assert (config.rig.mass, config.rig.area_1, config.rig.sample_time) == (25.0, 5.05e-4, 2e-3)
    assert em.Config.from_dict(config.to_dict()) == config
    assert em.Config.from_dict(json.loads(json.dumps(config.to_dict()))) == config
    one = {"kind": "sine", "amplitude": "5 mm", "frequency": "2 Hz", "duration": "2 s"}
    other = config.changed(rig={"name": "b"}, effects={}, simulation={"excitation": {"one": one}},
                           channels={"x": {"scale": 1e-3}})
    assert (other.rig.mass, other.rig.name, other.effects) == (25.0, "b", {})
    assert list(other.simulation.excitation) == ["one"]  # names of one's own: replaced
    assert other.settings.channels["x"].topic == "joint_states"  # a section: completed
    assert config.rig.name == "eha" and config.effects  # the first one stands
    with pytest.raises(dataclasses.FrozenInstanceError):
        config.settings = other.settings
    assert config.to_frame().loc["effects", "value"]["coulomb_friction"]["F_c"] == 40.0
    assert set(config.to_frame().columns) == {"value", "unit", "description"}


def test_results_cannot_be_changed_and_survive_a_pickle(healthy, air):
    config = em.Config()
    for one in (healthy, air, config, em.Recording({"x": [0.0, 1.0]}, 1e-3)):
        for twin in (pickle.loads(pickle.dumps(one)), copy.deepcopy(one)):
            assert repr(twin) == repr(one)
            assert twin.to_dict() == one.to_dict()
    for recording in (healthy, pickle.loads(pickle.dumps(healthy))):
        with pytest.raises(ValueError, match="read-only"):
            recording.channels["x"][0] = 1.0
        with pytest.raises(TypeError, match="cannot be changed"):
            recording.channels["x"] = np.zeros(4000)
        with pytest.raises(dataclasses.FrozenInstanceError):
            recording.sample_time = 1.0
    for estimate in (air, pickle.loads(pickle.dumps(air))):
        with pytest.raises(ValueError, match="read-only"):
            estimate.stage_one.value[:] = 0.0
        with pytest.raises(TypeError, match="cannot be changed"):
            estimate.parameters["B"] = None
    own = np.zeros(10)
    kept = em.Recording({"x": own}, 1e-3)
    own += 1.0
    assert not kept.channels["x"].any()
    other = dataclasses.replace(healthy, channels={**healthy.channels,
                                                   "x": healthy.channels["x"] + 1e-3})
    assert other.channels["x"][0] == pytest.approx(healthy.channels["x"][0] + 1e-3)


def test_tables_of_a_recording_and_an_estimate(healthy, air):
    frame = healthy.to_frame()
    assert frame.index.name == "time_s" and frame.shape == (4000, 5)
    frame["x"] = 0.0  # a table is the user's own
    assert healthy.channels["x"].any()
    twin = em.Recording.from_frame(healthy.to_frame())
    assert (twin.sample_time, len(twin)) == (1e-3, 4000)
    part = healthy.between(1.0, 3.0)
    np.testing.assert_array_equal(part.channels["x"], healthy.channels["x"][1000:3000])
    b = air.to_frame().query("estimator == 'stage one'").loc["B"]
    assert b["value"] == air.parameters["B"].value and b["unit"] == "N·s/m"
    course = air.to_frame("course")
    assert len(course) == len(air.recording)
    assert course["beta_e"].iloc[-1] == pytest.approx(air.parameters["beta_e"].value, rel=1e-2)
    assert "bulk_modulus_low" in set(air.to_frame("alarms")["name"])
    with pytest.raises(em.InputError, match="table: expected one of parameters, course"):
        air.to_frame("nothing")


def test_a_notebook_gets_escaped_tables_and_pictures(healthy, air):
    bad = dataclasses.replace(healthy, source="<script>alert(1)</script>")
    for one in (bad, em.estimate(bad), em.Config(rig={"name": "<script>"})):
        page = one._repr_html_()
        assert "<script>" not in page and "&lt;script&gt;" in page
        assert page.count("<td") > 4
    for figure in (healthy.plot(), healthy.plot("x", "p1"), air.plot(), air.plot("B")):
        picture, size = figure._repr_png_()
        assert picture.startswith(b"\x89PNG") and size["width"] > 300
        width = int.from_bytes(picture[16:20], "big")
        assert abs(width - 2 * size["width"]) <= 2
    with pytest.raises(em.InputError, match="what: expected one of parameters, B, beta_e"):
        air.plot("beta")
    still = em.estimate(em.Recording({"x": np.zeros(2000)}, 1e-3, source="still"))
    still.plot()._repr_png_()
    assert still.to_frame("course").isna().all().all()


def test_nothing_is_printed_unless_asked(capfd):
    em.estimate(AIR)
    assert capfd.readouterr() == ("", "")
    told = []
    em.estimate(AIR, progress=lambda text, share: told.append((text, share)))
    assert told[-1][1] == 1.0 and [share for _, share in told] == sorted(s for _, s in told)
    em.simulate(duration=2.0, progress=True)
    assert "100 % simulating" in capfd.readouterr().err


def test_threads_and_an_event_loop_get_the_same_answer(air):
    found = []
    threads = [threading.Thread(target=lambda: found.append(em.estimate(AIR).to_dict()))
               for _ in range(3)]
    for one in threads:
        one.start()
    for one in threads:
        one.join()

    async def in_a_kernel():
        return em.estimate(AIR).to_dict()  # as a cell runs: a loop is there

    found.append(asyncio.run(in_a_kernel()))
    assert all(one | {"wall_s": 0} == air.to_dict() | {"wall_s": 0} for one in found)
