"""`init`: what it makes of headers, files and answers, and what operators get wrong."""

import os
import pty
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from bag_tools import START, number, write_mcap
from command_tools import refused
from hypothesis import given, settings
from hypothesis import strategies as st

from eha_monitor.cli import main
from eha_monitor.draft.answers import answers_of, full_scale
from eha_monitor.draft.guess import guessed
from eha_monitor.draft.sources import layout_of, source_of
from eha_monitor.draft.words import read
from eha_monitor.errors import InputError
from eha_monitor.estimation.pipeline import estimate
from eha_monitor.physics.simulator import Simulator
from eha_monitor.recordings.importing import read_table
from eha_monitor.recordings.recording import Recording
from eha_monitor.recordings.write import write_recording
from eha_monitor.settings import Settings, load_settings, settings_from_tree
from eha_monitor.settings.load import tree_of

ROOT = Path(__file__).parents[1]
SEEN = Simulator(Settings(), seed=1).advance(6_000)
TIME = np.arange(6_000) * 1e-3
SHEET = ("area_1=5.05 cm^2", "area_2=5.05 cm^2", "volume_1=68.5 cm^3", "volume_2=68.5 cm^3",
         "mass=20 kg", "pump_displacement=1.6925e-7", "charge_pressure=20 bar")

HEADERS = [  # header, unit of the map, quantity, demand, chamber
    ("Kolbenweg [mm]", "mm", "position", False, 0),
    ("Sollweg [mm]", "mm", "position", True, 0),
    ("pos_mm", "mm", "position", False, 0),
    ("setpoint_mm", "mm", "position", True, 0),
    ("Course (mm)", "mm", "position", False, 0),
    ("Consigne (mm)", "mm", "position", True, 0),
    ("Posición [mm]", "mm", "position", False, 0),
    ("Consigna [mm]", "mm", "position", True, 0),
    ("Weg / mm", "mm", "position", False, 0),
    ("Weg in mm", "mm", "position", False, 0),
    ("x/mm", "mm", "position", False, 0),
    ("xd", "", "position", True, 0),
    ("Druck A [bar]", "bar", "pressure", False, 1),
    ("p_B [bar]", "bar", "pressure", False, 2),
    ("pA", "", "pressure", False, 1),
    ("P2", "", "pressure", False, 2),
    ("p_head_bar", "bar", "pressure", False, 0),
    ("Rod pressure (bar)", "bar", "pressure", False, 2),
    ("Druck Stangenseite", "", "pressure", False, 2),
    ("Presión 1 (psi)", "psi", "pressure", False, 1),
    ("pressure_a_psig", "psi gauge", "pressure", False, 1),
    ("p1 (barg)", "bar gauge", "pressure", False, 1),
    ("p_A [bar g]", "bar g", "pressure", False, 1),
    ("p_A bar g", "bar g", "pressure", False, 1),
    ("p_B [bar(a)]", "bar(a)", "pressure", False, 2),
    ("p_a", "", "pressure", False, 1),
    ("Supply pressure [bar]", "bar", "pressure", False, -1),
    ("p_tank", "", "pressure", False, -1),
    ("Pumpendrehzahl [1/min]", "rpm", "turning", False, 0),
    ("n_rpm", "rpm", "turning", False, 0),
    ("Vitesse pompe (tr/min)", "rpm", "turning", False, 0),
    ("motor speed", "", "turning", False, 0),
    ("Drehzahl Soll [U/min]", "rpm", "turning", True, 0),
    ("Motordrehzahl Ist [1/min]", "rpm", "turning", False, 0),
    ("motor rad_per_s", "rad/s", "turning", False, 0),
    ("Pump speed %", "%", "turning", False, 0),
    ("Geschwindigkeit mm/s", "mm/s", "velocity", False, 0),
    ("Kraft [kN]", "kN", "force", False, 0),
    ("Fuerza (N)", "N", "force", False, 0),
    ("Torque [Nm]", "N*m", "force", False, 0),
    ("Öltemperatur [°C]", "degC", "temperature", False, 0),
    ("oil_C", "degC", "temperature", False, 0),
    ("T_oil", "", "temperature", False, 0),
    ("temp_K", "K", "temperature", False, 0),
    ("phase_C", "", "", False, 0),
    ("Zeit [ms]", "ms", "time", False, 0),
    ("Temps (s)", "s", "time", False, 0),
    ("t_s", "s", "time", False, 0),
    ("n_rad_s", "rad/s", "turning", False, 0),
    ("v_mm_s", "mm/s", "velocity", False, 0),
    ("Tiempo", "", "time", False, 0),
    ("I_motor", "", "", False, 0),
    ("status", "", "", False, 0),
    ("Position error [mm]", "mm", "", False, 0),
    ("Winkel [°]", "°", "position", False, 0),
    ("pA_raw", "counts", "pressure", False, 1),
    ("Position [V]", "counts", "position", False, 0),
    ("Druck B [mA]", "counts", "pressure", False, 2),
]


@pytest.mark.parametrize(("name", "unit", "quantity", "demand", "chamber"), HEADERS,
                         ids=[one[0] for one in HEADERS])
def test_headers(name, unit, quantity, demand, chamber):
    found = read(name)
    assert (found.unit, found.quantity, found.chamber) == (unit, quantity, chamber)
    assert found.demand == demand or not quantity


@given(name=st.text(max_size=30))
@settings(max_examples=100)
def test_any_header_is_read(name):
    assert read(name).chamber in (-1, 0, 1, 2)


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    """Where `init` writes, unless it is told a place."""
    monkeypatch.chdir(tmp_path)


def table(path, columns, separator=";", decimal=".", encoding="utf-8"):
    rows = [separator.join(columns)]
    rows += [separator.join(f"{value:.9g}" for value in row).replace(".", decimal)
             for row in zip(*columns.values(), strict=True)]
    path.write_text("\n".join(rows) + "\n", encoding=encoding)
    return path


def german(path, **changed):
    columns = {"Zeit [ms]": TIME * 1e3, "Weg [mm]": SEEN["x"] * 1e3,
               "Sollweg [mm]": SEEN["x_d"] * 1e3, "Drehzahl [1/min]": SEEN["omega"] * 30 / np.pi,
               "Druck A [bar]": SEEN["p1"] * 1e-5, "Druck B [bar]": SEEN["p2"] * 1e-5} | changed
    return table(path, columns, decimal=",", encoding="cp1252")


def columns_of(path, heads, length=1e3, speed=30 / np.pi, pressure=1.0):
    """Write time, x, x_d, omega, p1 and p2 under these heads, in parts of the SI unit."""
    parts = (length, length, speed, pressure, pressure)
    seen = (SEEN[name] * part for name, part in zip(("x", "x_d", "omega", "p1", "p2"), parts,
                                                    strict=True))
    return table(path, dict(zip(heads, (TIME, *seen), strict=True)), ",")


def sets(*answers):
    return [word for answer in answers for word in ("--set", answer)]


def init(capsys, *words):
    status = main(["init", *map(str, words)])
    out, err = capsys.readouterr()
    return status, out, err


def test_the_step_of_an_encoder_is_in_the_config(tmp_path):
    """A diagnosis then has no step to find, and to call a mismatch."""
    rows = Recording(1e-3, SEEN | {"x": 2e-6 * np.round(SEEN["x"] / 2e-6)}, START)
    write_recording(tmp_path / "a", rows, Settings())
    for bag, step in ((tmp_path / "a", 2e-6), (ROOT / "bags/air_ingress", 0.0)):
        out = tmp_path / f"{bag.name}.yaml"
        assert main(["init", str(bag), "--yes", "--out", str(out), *sets(*SHEET)]) == 0
        assert load_settings(out).noise.position_resolution == pytest.approx(step)


def test_a_german_file_with_a_data_sheet(tmp_path, capsys):
    status, out, _ = init(capsys, german(tmp_path / "a.csv"), "--yes", *sets(*SHEET))
    assert status == 0
    b, beta = (re.search(rf"stage {stage} +\S+ +([\d.]+) ± \S+ \S+ +converged", out)
               for stage in ("one", "two"))
    assert float(b[1]) == pytest.approx(600, rel=0.01)
    assert float(beta[1]) == pytest.approx(600, rel=0.02)
    # The three commands that it names do what they say.
    steps = re.findall(r"^  eha-monitor (.*)$", out, re.MULTILINE)
    assert [step.split()[0] for step in steps] == ["import", "estimate", "diagnose"]
    for step in steps[:2]:
        assert main(step.split()) == 0
    text = Path("my_rig.yaml").read_text(encoding="utf-8")
    body = [line for line in text.splitlines() if re.match(r"  \w", line)
            and not re.search("^  columns|_damping|_modulus", line)]
    assert all("#" in line for line in body), "every value says where it comes from"
    assert load_settings("my_rig.yaml").thresholds.viscous_damping.high_warn is None


def test_geometry_is_never_made_up(tmp_path, capsys):
    status, out, _ = init(capsys, german(tmp_path / "a.csv"), "--yes")
    assert status == 0
    rig = load_settings("my_rig.yaml").rig
    assert (rig.area_1, rig.area_2, rig.volume_1, rig.volume_2, rig.pump_displacement) == (
        None,) * 5
    assert "needs rig.area_1" in out
    text = Path("my_rig.yaml").read_text(encoding="utf-8")
    assert len(re.findall("# ASK: ", text)) >= 9
    assert "mass: 20.0" in text
    assert re.search(r"mass: 20.0 +# ASK: .*default of the paper", text)


@pytest.mark.parametrize("wrong", ["swapped", "sign"])
def test_hoses_and_signs_are_seen_in_the_recording(tmp_path, capsys, wrong):
    changed = ({"Druck A [bar]": SEEN["p2"] * 1e-5, "Druck B [bar]": SEEN["p1"] * 1e-5}
               if wrong == "swapped" else {"Drehzahl [1/min]": -SEEN["omega"] * 30 / np.pi})
    status, out, _ = init(capsys, german(tmp_path / "a.csv", **changed), "--yes", *sets(*SHEET))
    assert status == 0
    columns = load_settings("my_rig.yaml").table.columns
    if wrong == "swapped":
        assert (columns["p1"].column, columns["p2"].column) == ("Druck B [bar]", "Druck A [bar]")
        assert "look swapped" in Path("my_rig.yaml").read_text(encoding="utf-8")
    else:
        assert columns["omega"].gain == pytest.approx(-np.pi / 30)
    assert re.search(r"stage one +B +(599|600)", out)


def test_units_without_a_header_come_from_the_values(tmp_path, capsys):
    file = columns_of(tmp_path / "a.csv", ("t", "x", "xd", "speed", "p1", "p2"))
    assert init(capsys, file, "--yes", *sets(*SHEET))[0] == 0
    columns = load_settings("my_rig.yaml").table.columns
    assert [columns[name].unit for name in ("x", "x_d", "omega", "p1")] == [
        "mm", "mm", "rpm", "Pa"]


def test_a_wrong_unit_in_the_header_is_asked_about_and_not_changed(tmp_path, capsys):
    file = columns_of(tmp_path / "a.csv", (
        "t [s]", "x [mm]", "xd [mm]", "n [1/min]", "p1 [bar]", "p2 [bar]"), pressure=1e-3)
    status, out, _ = init(capsys, file, "--yes", *sets(*SHEET))
    assert status == 0
    assert load_settings("my_rig.yaml").table.columns["p1"].unit == "bar"
    assert "check: p1 and p2 look" in out
    assert "no estimate yet" in out
    assert "# ASK: p1 and p2 look" in Path("my_rig.yaml").read_text(encoding="utf-8")


def test_the_pump_speed_of_a_rig_whose_geometry_is_known_decides_its_unit(tmp_path,
                                                                                 capsys):
    file = columns_of(tmp_path / "a.csv", ("t", "x", "xd", "pump speed", "p1", "p2"), 1.0, 1.0)
    assert init(capsys, file, "--yes", *sets(*SHEET))[0] == 0
    assert load_settings("my_rig.yaml").table.columns["omega"].gain == pytest.approx(1.0, rel=1e-3)


def test_per_cent_waits_for_its_full_scale(tmp_path, capsys):
    file = german(tmp_path / "a.csv", **{"Weg [%]": 50 + SEEN["x"] * 1e3, "Weg [mm]": 0 * TIME})
    file.write_text(file.read_text("cp1252").replace("Weg [mm];", "Nichts;", 1), "cp1252")
    status, out, _ = init(capsys, file, "--yes", *sets(*SHEET))
    assert status == 0
    assert "x.full" in out
    assert "x" not in load_settings("my_rig.yaml").table.columns
    assert init(capsys, file, "--yes", "--overwrite", *sets(*SHEET, "x.full=100 mm"))[0] == 0
    assert load_settings("my_rig.yaml").table.columns["x"].gain == pytest.approx(1e-3)


def test_a_bag(tmp_path, capsys):
    status, out, _ = init(capsys, ROOT / "bags" / "air_ingress", "--yes", *sets(*SHEET))
    assert status == 0
    assert set(load_settings("my_rig.yaml").channels) >= {"x", "x_d"}
    assert re.search(r"stage one +B +[56]\d\d", out)
    assert main(["estimate", str(ROOT / "bags" / "air_ingress"), "--config", "my_rig.yaml"]) == 0


def test_the_namespace_of_a_bag_is_written(tmp_path, capsys):
    config = load_settings(ROOT / "config" / "eha.yaml")
    config = config.model_copy(update={"monitor": config.monitor.model_copy(
        update={"namespace": "/press_3"})})
    write_recording(tmp_path / "bag", Recording(1e-3, SEEN), config)
    assert init(capsys, tmp_path / "bag", "--yes", *sets(*SHEET))[0] == 0
    assert load_settings("my_rig.yaml").monitor.namespace == "/press_3"


def test_topics_of_a_bag_of_unequal_length(tmp_path):
    """The demand begins later, and no header says which of the two positions it is."""
    late = 300
    rows = [(topic, "std_msgs/msg/Float64", START + k * 1_000_000, number(float(values[k])))
            for k in range(2000) for topic, values in (("/pos_b", SEEN["x"]),
                                                       ("/pos_a", SEEN["x_d"]))
            if topic != "/pos_a" or k >= late]
    found = guessed(source_of(write_mcap(tmp_path / "a.mcap", rows)))
    assert {name: one.candidate.place["topic"] for name, one in found.channels.items()
            if name in ("x", "x_d")} == {"x": "/pos_b", "x_d": "/pos_a"}


@pytest.mark.parametrize("unit, size", [("bar", 1e-5), ("kPa", 1e-3)])
def test_gauge_pressures_of_messages_that_are_not_in_pascal(tmp_path, capsys, unit, size):
    values = SEEN | {name: (SEEN[name] - 101325.0) * size for name in ("p1", "p2")}
    write_recording(tmp_path / "bag", Recording(1e-3, values), Settings())
    status, out, _ = init(capsys, tmp_path / "bag", "--yes", *sets(*SHEET, "pressures=gauge"))
    assert status == 0
    channels = load_settings("my_rig.yaml").channels
    assert {channels[name].unit for name in ("p1", "p2")} == {f"{unit} gauge"}
    assert re.search(r"stage one +B +(59|60)\d", out)


def test_a_mat_file_without_names(tmp_path, capsys):
    from scipy.io import savemat

    savemat("a.mat", {"data": np.column_stack([TIME, SEEN["x"] * 1e3, SEEN["p1"], SEEN["p2"]]),
                      "note": "hello"})
    status, out, _ = init(capsys, "a.mat", "--yes", *sets(
        *SHEET, "x.column=data[:,1]", "x.unit=mm", "p1.column=data[:,2]", "p2.column=data[:,3]"))
    assert status == 0
    assert re.search(r"stage one +B +(59|60)\d", out)


def entries(*answers, span=None):
    from eha_monitor.draft.rig import Seen, effects_of, rig_entries, tolerances

    said, seen = answers_of(answers), Seen(1e-3, span=span)
    rig = rig_entries(said, seen, False, "a")
    return ({one.key: one.value for one in rig}, {one.key: one for one in effects_of(
        said, rig, seen)}, {one.key: float(one.value) for one in tolerances(rig)})


def test_bore_rod_and_stroke():
    found, _, _ = entries("bore=40 mm", "rod=25 mm", "stroke=160 mm", "rig.line_volume=40 cm^3")
    bore, ring = np.pi / 4 * 0.04**2, np.pi / 4 * (0.04**2 - 0.025**2)
    assert [float(found[key]) for key in ("area_1", "area_2", "volume_1")] == pytest.approx(
        [bore, ring, bore * 0.08 + 40e-6], rel=1e-5)
    both, _, _ = entries("bore=40 mm", "rod=25 mm", "rods=2")
    assert both["area_1"] == both["area_2"] == found["area_2"]


@pytest.mark.parametrize(("answer", "said"), [
    ("area_1", "expected KEY=VALUE"),
    ("area_1=", "expected KEY=VALUE"),
    ("rig.aera_1=5 cm^2", "did you mean rig.area_1"),
    ("area_1=5 cm", "expected piston area"),
    ("area_1=-5 cm^2", "expected at least 0"),
    ("bore=40 bar", "expected bore of the cylinder in m"),
    ("rods=3", "expected 1 or 2"),
    ("machine=pump", "expected double_rod or two_pumps"),
    ("inclination=20", "such as '20 deg'"),
    ("x.colum=a", "expected x.column or unit"),
    ("x.unit=bar", "expected a length such as mm"),
    ("x.full=much", "such as"),
    ("x.column=nowhere", "column 'nowhere' not found, the file has"),
    ("force.unit=kN", "no column was found for it"),
    ("x.scale=abc", "expected"),
    ("bore=40", "expected bore of the cylinder from 1 mm to 2 m, such as '40 mm', got '40'; a "
     "number alone is in m"),
    ("charge_pressure=15", "expected absolute pressure of the make-up source from 1 kPa"),
    ("pump_displacement=5.2", "such as '1.6 cm^3/rev'"),
    ("stroke=50 mm", "expected at least the 72.8 mm that x moves in the recording"),
    ("mass=nan", "at least 0"),
    ("check_valve=9 l/min at 5", "expected a flow at a pressure, both with their units"),
    ("check_valve=9 l/min at -5 bar", "expected a flow at a pressure"),
    ("check_valve=3e-9", "expected a flow at a pressure"),
    ("leakage=0.1 bar at 100 bar", "expected a flow in m³/s"),
    ("relief_pressure=180", "a number alone is in Pa"),
    ("friction=1 bar", "expected dry friction of seals and guides in N"),
])
def test_a_bad_answer_is_one_line(tmp_path, capsys, answer, said):
    file = german(tmp_path / "a.csv")
    assert said in refused(capsys, "init", file, "--out", "r.yaml", "--yes", "--set", answer)
    assert not (tmp_path / "r.yaml").exists()


@pytest.mark.parametrize(("content", "said"), [
    (b"", "rows of numbers"),
    (b"hello\nworld\n", "rows of numbers"),
    (b"\0\1\2\3" * 50, "binary"),
    (b"a,b\n1,x\n", "rows of numbers|expected"),
])
def test_a_file_of_no_use_is_one_line(tmp_path, capsys, content, said):
    file = tmp_path / "a.csv"
    file.write_bytes(content)
    status, out, err = init(capsys, file, "--out", tmp_path / "r.yaml", "--yes")
    if status == 0:
        assert "no estimate yet" in out
        return
    assert status == 2
    assert re.search(said, err)
    assert err.count("\n") == 1


def test_a_rod_is_thinner_than_its_bore(tmp_path, capsys):
    said = refused(capsys, "init", german(tmp_path / "a.csv"), "--yes",
                   *sets("bore=40 mm", "rod=40 mm"))
    assert "--set rod=40 mm: expected a rod thinner than the bore of 40 mm" in said


@pytest.mark.parametrize(("unit", "answer"), [
    ("bar g", ("pressures=gauge",)), ("bar g", ()), ("bar(g)", ("pressures=gauge",)),
    ("bar abs", ("pressures=absolute",)), ("bara", ())])
def test_a_unit_that_says_gauge_or_absolute_says_it_once(tmp_path, capsys, unit, answer):
    file = table(tmp_path / "a.csv", {
        "Zeit [ms]": TIME * 1e3, "Weg [mm]": SEEN["x"] * 1e3, f"p_A [{unit}]": SEEN["p1"] * 1e-5,
        f"p_B [{unit}]": SEEN["p2"] * 1e-5})
    status, out, err = init(capsys, file, "--yes", *sets(*SHEET, *answer))
    assert status == 0, err
    assert "pressures:" not in out  # nobody is asked for what the header says
    zero = 101_325.0 if "g" in unit else 0.0
    assert load_settings(tmp_path / "my_rig.yaml").table.columns["p1"].zero == zero


def test_a_header_and_an_answer_that_contradict_each_other(tmp_path, capsys):
    file = table(tmp_path / "a.csv", {
        "Zeit [ms]": TIME * 1e3, "Weg [mm]": SEEN["x"] * 1e3, "p_A [bar g]": SEEN["p1"] * 1e-5,
        "p_B [bar g]": SEEN["p2"] * 1e-5})
    assert "'p_A [bar g]' is in 'bar g', which is gauge; expected pressures=gauge" in refused(
        capsys, "init", file, "--yes", *sets("pressures=absolute"))


@pytest.mark.parametrize(("answer", "asked"), [
    ("load=gravity", ("inclination: ", "rig.mass: moving mass")),
    ("load=spring", ("spring: ",))])
def test_a_load_whose_number_is_missing_is_not_in_the_config_and_said_so(tmp_path, capsys, answer,
                                                                        asked):
    _, out, _ = init(capsys, german(tmp_path / "a.csv"), "--yes", *sets(answer))
    missing = " ".join(out.partition("channels x")[0].split())
    for one in asked:
        assert one in missing
        assert "until told, the config has no load" in missing.partition(one)[2]
    assert not load_settings(tmp_path / "my_rig.yaml").effects


def test_no_weight_of_a_mass_that_nobody_has_told(tmp_path, capsys):
    init(capsys, german(tmp_path / "a.csv"), "--yes", *sets("load=gravity", "inclination=30 deg"))
    assert not load_settings(tmp_path / "my_rig.yaml").effects


def test_the_name_that_people_give_the_machine(tmp_path, capsys):
    init(capsys, german(tmp_path / "a.csv"), "--yes", *sets("name=Presse 3, links"))
    assert load_settings(tmp_path / "my_rig.yaml").rig.name == "Presse 3, links"
    assert "# answered" in (tmp_path / "my_rig.yaml").read_text().partition("motion")[0]


def test_nothing_is_overwritten(tmp_path, capsys):
    out = tmp_path / "r.yaml"
    out.write_text("mine")
    assert "--overwrite" in refused(capsys, "init", german(tmp_path / "a.csv"), "--out", out)
    assert out.read_text() == "mine"


def test_x_that_lies_elsewhere_is_counted_from_the_middle(tmp_path, capsys):
    file = german(tmp_path / "a.csv", **{"Weg [mm]": SEEN["x"] * 1e3 + 137,
                                         "Sollweg [mm]": SEEN["x_d"] * 1e3 + 137})
    sheet = sets("bore=40 mm", "rod=22 mm", "machine=double_rod", "stroke=160 mm",
                 "line_volume=40 cm^3", "p1.delay=5 ms", "charge_pressure=19 bar gauge")
    status, out, _ = init(capsys, file, "--yes", *sheet)
    assert status == 0
    assert "beyond the ends of a stroke of 160 mm" in " ".join(out.split())
    status, out, _ = init(capsys, file, "--yes", "--overwrite", *sheet, *sets("zero=137 mm"))
    assert status == 0 and "beyond the ends" not in out
    found = load_settings(tmp_path / "my_rig.yaml")
    assert found.table.columns["x"].offset == found.table.columns["x_d"].offset == -137
    assert found.table.columns["p1"].delay == pytest.approx(5e-3)
    assert found.rig.charge_pressure == pytest.approx(19e5 + 101325)
    # x falls while the pump drives it out: the sign turns round with the middle in its place.
    turned = german(tmp_path / "b.csv", **{"Weg [mm]": 137 - SEEN["x"] * 1e3,
                                           "Sollweg [mm]": 137 - SEEN["x_d"] * 1e3})
    assert init(capsys, turned, "--yes", "--overwrite", *sheet, *sets("zero=137 mm"))[0] == 0
    x = load_settings(tmp_path / "my_rig.yaml").table.columns["x"]
    assert x.scale * 137 + x.offset == 0, x


def test_thousands_in_groups_and_a_time_that_begins_anew(tmp_path, capsys):
    lines = german(tmp_path / "a.csv").read_text("cp1252").splitlines()
    cells = [line.split(";") for line in lines]
    grouped = [";".join([*row[:3], f"{float(row[3].replace(',', '.')):,.2f}".translate(
        str.maketrans(",.", ".,")), *row[4:]]) for row in cells[1:]]
    assert any(row.count(".") for row in grouped)
    (tmp_path / "a.csv").write_text("\n".join([lines[0], *grouped, grouped[0]]), "cp1252")
    status, out, _ = init(capsys, "a.csv", "--yes", *sets(*SHEET))
    assert status == 0 and "are NaN" not in out
    assert re.search(r"^time +Zeit \[ms\] ", out, re.M), out


@pytest.mark.parametrize(("zero", "span", "oil"), [
    ("zero=middle", (-0.07, 0.07), (140.5, 101.3)),
    ("zero=retracted", (0, 0.15), (40, 162.5)),
    ("zero=extended", (-0.15, 0), (241.1, 40)),
    ("mass=1 kg", (0.001, 0.15), (40, 162.5)),  # nobody said it: the recording shows it
])
def test_volumes_at_zero_follow_from_where_it_lies(zero, span, oil):
    rig, effects, _ = entries("bore=40 mm", "rod=25 mm", "stroke=160 mm", "line_volume=40 cm^3",
                              zero, span=span)
    assert [1e6 * float(rig[f"volume_{k}"]) for k in (1, 2)] == pytest.approx(oil, rel=1e-3)
    if zero == "zero=middle":
        assert "position_dependent_volume" not in effects
        return
    slope, ratio = (float(found) for found in re.search(
        r"A_v: ([\d.e-]+), r: ([\d.e-]+)", effects["position_dependent_volume"].value).groups())
    assert slope == pytest.approx(float(rig["area_1"])) and ratio == pytest.approx(
        float(rig["area_2"]) / float(rig["area_1"]), rel=1e-5)
    for x in span:  # no chamber runs out of oil
        assert float(rig["volume_1"]) + slope * x > 0 < float(rig["volume_2"]) - slope * ratio * x


def test_a_single_rod_that_is_counted_from_its_end(tmp_path, capsys):
    """A plant of other equations, 40/25 mm: each chamber has its own area, not the areas' mean."""
    from quarter_hour import SINES, Sheet, rig
    from strangers.plant import recording

    sheet = Sheet(40, 25, 1, 160, 40, 60, 3.1, 15)
    made = rig("end", sheet.plant(2400, 8e8, 20000, cross_leakage=1.5e-13, makeup=1.5e-13), 500,
               SINES)
    seen = recording(made, 3)
    file = table(tmp_path / "a.csv", {
        "time [s]": seen["time"], "position [mm]": 1e3 * (seen["x"] + 0.08),
        "setpoint [mm]": 1e3 * (seen["x_d"] + 0.08), "pump [rpm]": seen["omega"] * 30 / np.pi,
        "pressure A [bar]": 1e-5 * seen["p1"], "pressure B [bar]": 1e-5 * seen["p2"]}, ",")
    status, out, _ = init(capsys, file, "--yes", *sets(
        *sheet.answers(), "machine=two_pumps", "load=none", "zero=retracted",
        "pressures=absolute", "leakage=4.5e-13", "makeup_conductance=1.5e-13"))
    assert status == 0
    law = load_settings("my_rig.yaml").effects["position_dependent_volume"]
    assert law["r"] == pytest.approx(1 - (25 / 40)**2, rel=1e-4)
    assert "model: consistent" in out
    B, beta = (float(re.search(rf"{row} +\S+ +([\d.]+) ± ", out)[1])
               for row in ("stage one", "stage two"))
    assert pytest.approx(2400, rel=0.01) == B and beta == pytest.approx(800, rel=0.03)
    mean = settings_from_tree({**tree_of("my_rig.yaml"), "effects": {
        "position_dependent_volume": {"A_v": law["A_v"] * (1 + law["r"]) / 2},
        "constant_load": {"F_0": 101_325 * np.pi / 4 * 0.025**2}}}, "mean")
    found = estimate(read_table(file, mean), mean)
    assert abs(found.parameters["beta_e"].value / 800e6 - 1) > 0.1


def test_a_load_becomes_an_effect_that_the_model_has():
    from eha_monitor.settings.load import settings_from_tree

    _, effects, _ = entries("mass=60 kg", "load=gravity", "inclination=20 deg")
    assert float(effects["constant_load"].value[6:-1]) == pytest.approx(201.3, rel=1e-3)
    _, effects, _ = entries("load=spring", "spring=8 N/mm", "spring_rest=-5 mm")
    assert effects["spring_load"].value == "{k: 8000.0, x_0: -0.005}"
    # As x reads, like the middle of the stroke: 3000 N too much on a stranger's rig.
    _, effects, _ = entries("load=spring", "spring=8 N/mm", "spring_rest=100 mm", "zero=100 mm")
    assert effects["spring_load"].value == "{k: 8000.0, x_0: 0.0}"
    assert settings_from_tree({"effects": {"spring_load": {"k": 8e3, "x_0": -5e-3}}}, "a")
    assert not entries("load=unknown")[1]


@pytest.mark.parametrize(("answers", "effect", "values"), [
    # 9 l/min in the 0.2 bar beyond the 0.3 bar at which it opens, below 17 bar.
    (("check_valve=9 l/min at 0.5 bar", "check_valve_opens=0.3 bar", "charge_pressure=17 bar"),
     "anti_cavitation", {"k": 9e-3 / 60 / 0.2e5, "p_min": 16.7e5}),
    (("check_valve=9 l/min at 0.5 bar", "charge_pressure=17 bar"), "anti_cavitation",
     {"k": 9e-3 / 60 / 0.5e5, "p_min": 17e5}),
    (("check_valve=none", "charge_pressure=17 bar"), "anti_cavitation", None),
    (("check_valve=9 l/min at 0.5 bar",), "anti_cavitation", None),  # below what nobody has told
    (("relief_valve=20 l/min at 10 bar", "relief_pressure=180 bar"), "relief_valve",
     {"k": 20e-3 / 60 / 10e5, "p_c": 180e5}),
    (("relief_valve=20 l/min at 10 bar",), "relief_valve", None),
    (("friction=120 N",), "coulomb_friction", {"F_c": 120.0}),
    (("motion=rotary", "friction=12 N m"), "coulomb_friction", {"F_c": 12.0}),
    (("drive_lag=2 ms",), "drive_lag", {"tau": 2e-3}),
    (("drive_lag=80 Hz",), "drive_lag", {"tau": 1 / (2 * np.pi * 80)}),
    (("drive_lag=none",), "drive_lag", None)])
def test_what_a_data_sheet_says_of_valves_friction_and_drive_is_in_the_config(answers, effect,
                                                                              values):
    _, effects, _ = entries(*answers)
    if values is None:
        assert effect not in effects
        return
    written = settings_from_tree({"effects": {effect: yaml.safe_load(effects[effect].value)}},
                                 "the draft").effects[effect]
    assert {name: written[name] for name in values} == pytest.approx(values, rel=1e-3)


def test_a_leakage_is_answered_as_a_flow_at_a_pressure():
    """C_T/2 times a pressure difference is the flow: half of C_T is what a test stand shows."""
    found, _, spread = entries("leakage=0.15 l/min at 100 bar")
    assert float(found["leakage"]) == pytest.approx(2 * 0.15e-3 / 60 / 100e5)
    assert spread["leakage"] == entries("leakage=5e-13")[2]["leakage"] < entries()[2]["leakage"]


@pytest.mark.parametrize(("answers", "load"), [
    (("bore=40 mm", "rod=25 mm"), 101_325 * np.pi / 4 * 0.025**2),
    (("bore=40 mm", "rod=25 mm", "load=none"), 101_325 * np.pi / 4 * 0.025**2),
    (("bore=40 mm", "rod=25 mm", "ambient_pressure=0.9 bar"), 0.9e5 * np.pi / 4 * 0.025**2),
    (("bore=40 mm", "rod=25 mm", "mass=60 kg", "load=gravity", "inclination=-20 deg"),
     101_325 * np.pi / 4 * 0.025**2 - 60 * 9.81 * np.sin(np.radians(20))),
    (("area_1=5 cm^2", "area_2=9 cm^2"), -101_325 * 4e-4),  # the rod is on the side of chamber 1
    (("bore=40 mm", "rod=25 mm", "rods=2"), 0.0),
    (("bore=40 mm", "rod=25 mm", "ambient_pressure=0"), 0.0),
    (("bore=40 mm",), 0.0)])
def test_the_open_air_on_the_end_of_the_rod_is_in_the_config(answers, load):
    """F = A1 p1 - A2 p2 of absolute pressures: air all around gives p_a (A1 - A2) at rest."""
    _, effects, _ = entries(*answers)
    written = effects.get("constant_load")
    assert (float(written.value[6:-1]) if written else 0.0) == pytest.approx(load, rel=1e-4)


def test_tolerances_follow_from_where_a_number_comes_from():
    answered = entries("mass=60 kg", "area_1=5 cm^2", "bore=40 mm", "rod=25 mm")[2]
    nobody = entries("bore=40 mm")[2]
    assert answered["mass"] < nobody["mass"]
    assert answered["area_1"] < answered["area_2"] == nobody["area_1"]
    assert nobody["leakage"] > entries("leakage=1e-12")[2]["leakage"]


@pytest.mark.parametrize(("more", "said"), [
    (("zero=extended",), "beyond the ends of a stroke"),
    (("zero=retracted", "volume_1=110 cm^3", "volume_2=20 cm^3"),
     "volume_2=20 cm^3: expected more"),
])
def test_a_cylinder_that_would_hold_less_than_no_oil_is_refused(tmp_path, capsys, more, said):
    file, x = german(tmp_path / "a.csv"), SEEN["x"]
    shift = 1e3 * float(0.005 - x.min())  # x counts from the end with the rod in
    assert said in refused(capsys, "init", file, "--out", "r.yaml", "--yes", *sets(
        *(one for one in SHEET if not one.startswith(("stroke", "zero"))), "stroke=120 mm",
        f"x.offset={shift:.3f}", f"x_d.offset={shift:.3f}", *more))


@pytest.mark.parametrize(("machine", "nothing"), [
    ("valve", ("volume_1", "pump_displacement", "position_gain")),
    ("force", ("area_1", "area_2", "volume_1", "pump_displacement")),
])
def test_a_machine_without_a_pump_is_not_asked_for_one(tmp_path, capsys, machine, nothing):
    status, out, _ = init(capsys, german(tmp_path / "a.csv"), "--yes", "--set",
                          f"machine={machine}", *sets("mass=20 kg", "load=none"))
    assert status == 0
    rig = load_settings("my_rig.yaml").rig
    assert all(getattr(rig, key) is None for key in nothing)
    assert not any(f"rig.{key}:" in out for key in (*nothing, "leakage"))


@pytest.mark.parametrize(("more", "unit", "said"), [
    ((), "bar gauge", "is not below 1 bar"),
    (("pressures=absolute",), "bar absolute", "are these gauge pressures"),
    (("pressures=gauge",), "bar gauge", "answered"),
])
def test_pressures_below_the_open_air_are_no_absolute_ones(tmp_path, capsys, more, unit, said):
    low = {f"Druck {one} [bar]": (SEEN[key] - SEEN[key].min()) * 1e-5 for one, key in
           (("A", "p1"), ("B", "p2"))}
    status, *_ = init(capsys, german(tmp_path / "a.csv", **low), "--yes", *sets(
        *(one for one in SHEET if "charge" not in one), *more))
    assert status == 0
    assert load_settings("my_rig.yaml").table.columns["p1"].unit == unit
    assert said in Path("my_rig.yaml").read_text(encoding="utf-8")


@pytest.mark.parametrize(("answer", "unit"), [
    ("absolute", "bar absolute"), ("gauge", "bar gauge"), (None, "bar gauge")])
def test_an_answer_stands_whatever_the_pressures_look_like(tmp_path, capsys, answer, unit):
    """Their mean is one atmosphere below the charge pressure, as that of gauge pressures is."""
    lower = {f"Druck {one} [bar]": (SEEN[key] - 101_325.0) * 1e-5
             for one, key in (("A", "p1"), ("B", "p2"))}
    status, out, _ = init(capsys, german(tmp_path / "a.csv", **lower), "--yes", *sets(
        *SHEET, *([f"pressures={answer}"] if answer else [])))
    assert status == 0
    columns = load_settings("my_rig.yaml").table.columns
    assert [columns[name].unit for name in ("p1", "p2")] == [unit, unit]
    assert ("look like gauge pressures" in " ".join(out.split())) == (answer != "gauge")


def test_an_answer_holds_for_a_bag_whose_messages_name_no_unit(tmp_path, capsys):
    status, *_ = init(capsys, ROOT / "bags" / "hidden_friction", "--yes",
                      *sets(*SHEET, "pressures=gauge"))
    assert status == 0
    assert load_settings("my_rig.yaml").channels["p1"].zero == 101_325.0


def test_full_scales():
    assert full_scale("x", "80 mm", "share") == ("mm", 0.8)
    assert full_scale("p1", "27648 = 250 bar", "counts") == ("bar", pytest.approx(250 / 27648))
    with pytest.raises(InputError, match="27648 = 250 bar"):
        full_scale("p1", "250 bar", "counts")


def test_a_header_block_with_units_below(tmp_path):
    file = tmp_path / "a.lvm"
    file.write_text(
        "LabVIEW Measurement\nWriter\t2\n***End_of_Header***\n\nX_Value\tPos\tComment\n"
        "s\tmm\t\n" + "".join(f"{k}\t{k}.5\t\n" for k in range(9)))
    found = layout_of(file)
    assert (found.delimiter, found.skip_rows, found.names[:2]) == ("tab", 4, ("X_Value", "Pos"))
    assert found.units[:2] == ("s", "mm")


@pytest.mark.parametrize("above", ["Messung Achse 1;;\n", "Messung Achse 1;;\nDatum;2026-03-02;\n",
                                   "Rig;Axis 1;\n\n"])
def test_a_title_that_a_spreadsheet_has_filled_up(tmp_path, above):
    file = tmp_path / "a.csv"
    file.write_text(above + "Zeit [ms];Weg [mm];Druck A [bar]\n"
                    + "".join(f"{2 * k};{k},5;17,2\n" for k in range(9)))
    found = layout_of(file)
    assert found.names == ("Zeit [ms]", "Weg [mm]", "Druck A [bar]")
    assert list(source_of(file).candidates[1].values[:2]) == [0.5, 1.5]


def test_clocks_that_count_hours(tmp_path, capsys):
    signals = [("Weg [mm]", SEEN["x"] * 1e3), ("Soll [mm]", SEEN["x_d"] * 1e3),
               ("Druck A [bar]", SEEN["p1"] * 1e-5), ("Druck B [bar]", SEEN["p2"] * 1e-5)]
    clocks = {"Zeit [h]": TIME, "Zeit": 2.0 * TIME}
    heads = ["Zeit [h]", *(name for name, _ in signals[:2]), "Zeit",
             *(name for name, _ in signals[2:])]
    columns = [clocks[head] / 3600.0 if head in clocks else dict(signals)[head] for head in heads]
    file = tmp_path / "hours.csv"
    file.write_text("\n".join(";".join(row) for row in (heads, *(
        [f"{value:.12g}" for value in row] for row in zip(*columns, strict=True)))) + "\n")
    status, *_ = init(capsys, file, "--yes", *sets("machine=valve"))
    table = load_settings("my_rig.yaml").table
    assert status == 0 and table.time_scale == 3600.0
    assert {name: column.time_scale for name, column in table.columns.items()
            if column.time} == {"p1": 3600.0, "p2": 3600.0}


@pytest.mark.parametrize("attributes", [False, True])
@pytest.mark.parametrize("empty", [False, True])
def test_a_scope_writes_the_time_of_each_task(tmp_path, capsys, attributes, empty):
    """Names that repeat, what is said of each signal below them, pressures at half the rate."""
    signals = [("Weg", TIME, SEEN["x"] * 1e3), ("Sollweg", TIME, SEEN["x_d"] * 1e3),
               *((f"Druck {mark}", TIME[::2], SEEN[name][::2] * 1e-5)
                 for mark, name in (("A", "p1"), ("B", "p2")))]
    said = {"SymbolComment": "", "Data-Type": "REAL64", "SampleTime[ms]": "2", "Port": "851",
            "Offset": "0", "ScaleFactor": "1"} if attributes else {}
    rows = ["Name;Press", "File;C:\\scope.tcscopex", "",
            ";".join(f"Name;{name}" for name, *_ in signals),
            *(";".join([key, value] * len(signals)) for key, value in said.items()), *[""] * empty]
    rows += [";".join(f"{1e3 * time[k]:.9g};{values[k]:.9g}" if k < len(time) else ";"
                      for _, time, values in signals) for k in range(len(TIME))]
    file = tmp_path / "scope.csv"
    file.write_text("\n".join(rows) + "\n")
    status, out, _ = init(capsys, file, "--yes", *sets("machine=valve"))
    assert status == 0 and "scope.csv" in out
    settings = load_settings("my_rig.yaml")
    clocks = {name: column.time for name, column in settings.table.columns.items()}
    assert clocks == {"x": "", "x_d": "", "p1": "4", "p2": "6"}
    recording = read_table(file, settings)
    for name in ("x", "x_d", "p1", "p2"):
        seen = recording.channels[name][:-1]
        rough = np.ptp(SEEN[name]) * (1e-3 if name in "x_d" else 0.05)
        at = TIME[0] + recording.sample_time * np.arange(len(seen))
        assert np.abs(seen - np.interp(at, TIME, SEEN[name])).max() < rough


def seen_rows(heads, between=",", **parts):
    """Return lines of time, x, x_d, omega, p1 and p2 in ms, mm, rpm and bar, each as its part."""
    forms = {"t": lambda t: f"{1e3 * t:.9g}", "x": lambda x: f"{1e3 * x:.9g}",
             "w": lambda w: f"{w * 30 / np.pi:.9g}", "p": lambda p: f"{1e-5 * p:.9g}"} | parts
    rows = zip(TIME - TIME[0], *(SEEN[name] for name in ("x", "x_d", "omega", "p1", "p2")),
               strict=True)
    return heads + [between.join(forms[kind](value) for kind, value in
                                 zip("txxwpp", row, strict=True)) for row in rows]


HEADS = "t [ms],Position [mm],Setpoint [mm],Pump speed [rpm],Pressure A [bar],Pressure B [bar]"
PLAIN = "Time,Position,Setpoint,Pump speed,Pressure A,Pressure B"


@pytest.mark.parametrize("lines", [
    seen_rows([PLAIN, "(ms),(mm),(mm),(rpm),(bar),(bar)", ""]),  # a picture scope's
    seen_rows([PLAIN.replace(",", ";")], ";", t=lambda t: f"{t:.6g} sec",  # a timetable's
              x=lambda x: f"{1e3 * x:.9g} mm", w=lambda w: f"{w * 30 / np.pi:.9g} rpm",
              p=lambda p: f"{1e-5 * p:.9g} bar"),
    seen_rows(["# t[ms]  x[mm]  xd[mm]  n[rpm]  pA[bar]  pB[bar]"], "  "),
    seen_rows([HEADS.replace("ms", "us")],  # a counter of 32 bits
              t=lambda t: str((2**32 - 3_000_000 + round(1e6 * t)) % 2**32)),
    ], ids=["empty line", "units in cells", "commented names", "counter"])
def test_forms_in_which_others_write_a_recording(tmp_path, capsys, lines):
    file = tmp_path / "a.csv"
    file.write_text("\n".join(lines) + "\n")
    status, _, _ = init(capsys, file, "--yes")
    recording = read_table(file, load_settings("my_rig.yaml"))
    assert status == 0 and recording.losses == () and len(recording) == len(TIME)
    for name in ("x", "x_d", "omega", "p1", "p2"):
        np.testing.assert_allclose(recording.channels[name], SEEN[name], rtol=1e-7, atol=1e-7)


def test_a_person_at_a_terminal_is_asked(tmp_path):
    file = german(tmp_path / "a.csv")
    leader, follower = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-m", "eha_monitor", "init", str(file), "--out",
         str(tmp_path / "r.yaml")], stdin=follower, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True, cwd=ROOT)
    # machine, load, pressures, bore (first nonsense), rod and stroke (first impossible),
    # where x = 0 lies, lines, mass, pump, leakage, charge, valves, friction, drive: as asked.
    os.write(leader, b"double_rod\nnone\nabsolute\nforty\n40 mm\n45 mm\n25 mm\n50 mm\n100 mm\n"
             b"middle\n20 cm^3\n30 kg\n\n\n20 bar\nforty\n9 l/min at 0.5 bar\n"
             b"0.3 bar\nnone\n90 N\n\n\n\n")
    _, err = process.communicate(timeout=60)
    os.close(leader)
    os.close(follower)
    assert process.returncode == 0, err
    assert "expected bore of the cylinder" in err
    assert "expected a rod thinner than the bore" in err
    assert "expected a flow at a pressure" in err
    effects = load_settings(tmp_path / "r.yaml").effects
    assert effects["anti_cavitation"]["p_min"] == pytest.approx(19.7e5)
    assert effects["coulomb_friction"]["F_c"] == 90.0 and "relief_valve" not in effects
    assert "that x moves in the recording" in err
    rig = load_settings(tmp_path / "r.yaml").rig
    assert rig.area_1 == pytest.approx(np.pi / 4 * (0.04**2 - 0.025**2), rel=1e-4)
    assert rig.volume_2 == pytest.approx(rig.area_1 * 0.05 + 20e-6, rel=1e-4)
    assert (rig.mass, rig.tolerance.mass) == (30.0, 0.05)
    assert "x = 0 of the position lies" in err
    assert "ASK" in (tmp_path / "r.yaml").read_text()


def turned(path):
    """The same recording as that of an actuator that turns: its angle in degrees."""
    rows = [TIME, *(np.rad2deg(SEEN[key]) for key in ("x", "x_d")), SEEN["omega"] * 30 / np.pi,
            SEEN["p1"] * 1e-5, SEEN["p2"] * 1e-5]
    names = "time_s,angle_deg,angle_set_deg,pump_rpm,p1_bar,p2_bar"
    np.savetxt(path, np.array(rows).T, "%.8g", ",", header=names, comments="")
    return path


def test_a_rotary_actuator_is_asked_and_answered_in_its_own_units(tmp_path, capsys):
    status, out, _ = init(capsys, turned(tmp_path / "a.csv"), "--yes", *sets("load=none"))
    assert status == 0
    assert "cm^3/rad" in out and "kg m^2" in out and "bore" not in out
    told = ("area_1=505 cm^3/rad", "stroke=40 deg", "line_volume=50 cm^3", "mass=20 kg m^2",
            "pump_displacement=1.6925e-7", "charge_pressure=20 bar", "zero=middle")
    status, out, _ = init(capsys, turned(tmp_path / "a.csv"), "--yes", "--overwrite", *sets(*told))
    assert status == 0
    rig = load_settings("my_rig.yaml").rig
    assert (rig.motion, rig.mass) == ("rotary", 20.0)
    assert (rig.area_1, rig.area_2) == (pytest.approx(505e-6), pytest.approx(505e-6))
    assert rig.volume_1 == pytest.approx(505e-6 * np.deg2rad(20) + 50e-6, rel=1e-5)
    assert re.search(r"stage one +B +(59|60)\d", out)


@pytest.mark.parametrize(("answer", "said"), [
    ("mass=20 bar", "in kg (of a rotary actuator kg·m²)"),
    ("load=gravity", "of a rotary actuator"),
    ("area_1=5 cm^2", "rig.area_1: expected a number in m³/rad"),
])
def test_a_line_is_no_angle(tmp_path, capsys, answer, said):
    more = ("inclination=20 deg",) if "gravity" in answer else ()
    assert said in refused(capsys, "init", turned(tmp_path / "a.csv"), "--yes",
                           *sets(answer, *more))


def test_an_area_in_turning_units_is_refused_of_a_cylinder(tmp_path, capsys):
    assert "rig.area_1: expected a number in m²" in refused(
        capsys, "init", german(tmp_path / "a.csv"), "--yes", *sets("area_1=120 cm^3/rad"))


def test_the_loop_gain_is_seen_beside_lag_and_limit():
    """K_pos of a drive with a lag that reaches its limit; the closed form is the truth."""
    from eha_monitor.draft.rig import _loop_gain

    step, gain, lag, limit = 1e-3, 2.0e4, 5e-3, 300.0
    time = np.arange(20000) * step
    error = 0.02 * np.sin(2 * np.pi * 3.0 * time) * np.sin(2 * np.pi * 0.1 * time)
    omega = np.zeros_like(error)
    for k in range(1, len(time)):
        wanted = np.clip(gain * error[k - 1], -limit, limit)
        omega[k] = omega[k - 1] + (wanted - omega[k - 1]) * (1.0 - np.exp(-step / lag))
    found = _loop_gain(omega, np.zeros_like(error), error, step)
    assert abs(found.K_pos / gain - 1.0) < 0.01 and found.explains > 0.99 and not found.fed
    plain = float(omega @ error / (error @ error))
    assert abs(plain / gain - 1.0) > 0.03  # what least squares on the gain alone would say


def test_the_loop_gain_is_seen_beside_a_feed_forward():
    """The piston follows its demand, so the error is a small rest of what drives the pump."""
    from eha_monitor.draft.rig import BESIDE_FED, _loop_gain

    step, gain, fed, over = 1e-3, 2.0e4, 1440.0, 0.00059  # over: m of travel per rad of the pump
    time = np.arange(20000) * step
    demand = 0.02 * np.sin(2 * np.pi * 0.4 * time) + 0.01 * np.sin(2 * np.pi * 1.1 * time)
    rate, x, omega = np.gradient(demand, step), np.zeros_like(time), np.zeros_like(time)
    for k in range(1, len(time)):
        x[k] = x[k - 1] + over * omega[k - 1] * step
        omega[k] = gain * (demand[k] - x[k]) + fed * rate[k]
    demand[500:520] = np.nan  # not recorded for a while
    found = _loop_gain(omega, demand, demand - x, step)
    assert abs(found.K_pos / gain - 1.0) < BESIDE_FED and abs(found.fed / fed - 1.0) < 0.02
    error = np.nan_to_num(demand - x)
    plain = float(omega @ error / (error @ error))
    assert plain > 3.0 * gain  # what least squares on the gain alone would say
