"""Units beside scale and offset in the map: what they make of a number, and what is refused."""

import re
from pathlib import Path

import numpy as np
import pint
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eha_monitor.errors import InputError
from eha_monitor.recordings.importing import read_table
from eha_monitor.settings import settings_from_tree
from eha_monitor.settings.channels import LINEAR, ROTARY, unit_of

# Channel -> unit -> SI units in it, and SI at zero of it: by hand, from the definitions.
KNOWN = {
    "x": {"mm": (1e-3, 0), "cm": (1e-2, 0), "µm": (1e-6, 0), "um": (1e-6, 0), "inch": (0.0254, 0),
          "in": (0.0254, 0), "Zoll": (0.0254, 0), "m": (1, 0)},
    "v": {"mm/s": (1e-3, 0), "m/min": (1 / 60, 0)},
    "omega": {"rpm": (np.pi / 30, 0), "1/min": (np.pi / 30, 0), "U/min": (np.pi / 30, 0),
              "tr/min": (np.pi / 30, 0), "min-1": (np.pi / 30, 0), "rev/s": (2 * np.pi, 0),
              "deg/s": (np.pi / 180, 0), "rad/s": (1, 0)},
    "p1": {"bar": (1e5, 0), "bar gauge": (1e5, 101_325), "barg": (1e5, 101_325),
           "bar(g)": (1e5, 101_325), "bara": (1e5, 0), "MPa": (1e6, 0), "kPa": (1e3, 0),
           "psi": (6894.757293168, 0), "psig": (6894.757293168, 101_325),
           "PSI": (6894.757293168, 0),
           "kgf/cm²": (98_066.5, 0), "mbar": (100, 0), "BAR": (1e5, 0)},
    "force": {"kN": (1e3, 0), "N": (1, 0), "kgf": (9.80665, 0), "lbf": (4.4482216152605, 0)},
    "temperature": {"degC": (1, 0), "°C": (1, 0), "K": (1, -273.15),
                    "degF": (5 / 9, -160 / 9), "°F": (5 / 9, -160 / 9)},
}
CASES = [(channel, unit, *two) for channel, units in KNOWN.items() for unit, two in units.items()]
NUMBERS = st.floats(-1e4, 1e4, allow_subnormal=False)


def config(section="table", rotary=False, **channels):
    tree = {"rig": {"motion": "rotary" if rotary else "linear"}}
    tree |= {"table": {"columns": channels}} if section == "table" else {"channels": channels}
    return settings_from_tree(tree, "my_rig.yaml")


@settings(max_examples=200)
@given(case=st.sampled_from(CASES), raw=NUMBERS, scale=NUMBERS, offset=NUMBERS)
def test_scale_and_offset_give_the_number_that_the_unit_is_of(case, raw, scale, offset):
    channel, unit, factor, zero = case
    column = config(**{channel: {"column": "c", "unit": unit, "scale": scale, "offset": offset}}
                    ).table.columns[channel]
    expected = factor * (scale * raw + offset) + zero
    # To the rounding of the parts, which may cancel, and of products too small for a float.
    size = abs(factor * scale * raw) + abs(factor * offset) + abs(zero)
    assert abs(column.gain * raw + column.zero - expected) <= 1e-9 * size + 1e-300


@pytest.mark.parametrize("section", ["table", "channels"])
@given(channel=st.sampled_from(sorted(LINEAR)), case=st.sampled_from(CASES))
def test_a_unit_of_another_quantity_is_refused_in_one_line(section, channel, case):
    of, unit, *_ = case
    same = LINEAR[channel] == LINEAR[of]
    entry = {"unit": unit} | ({"column": "c"} if section == "table" else {})
    if same:
        config(section, **{channel: entry})
        return
    place = re.escape("table.columns" if section == "table" else "channels")
    said = rf"^my_rig\.yaml: {place}\.{channel}\.unit: expected a"
    with pytest.raises(InputError, match=said) as e:
        config(section, **{channel: entry})
    assert "\n" not in str(e.value)


@settings(max_examples=300)
@given(text=st.one_of(st.text(max_size=8), st.sampled_from(["mm;", "3 mm", "Hz", "%", "mmm g", "",
                                                            "bar gauge gauge", "mm gauge", "1"])))
def test_whatever_is_written_is_a_unit_or_one_line(text):
    try:
        config(x={"column": "c", "unit": text})
    except InputError as problem:
        assert "\n" not in str(problem)
        assert str(problem).startswith("my_rig.yaml: table.columns.x.unit: expected a length")


@given(name=st.sampled_from(["mm", "cm", "inch", "km", "mile", "um"]))
def test_lengths_are_those_of_pint(name):
    assert unit_of(name).factor == pytest.approx(
        pint.get_application_registry().Quantity(1, name).to("m").magnitude)


def test_an_angle_is_the_position_of_a_rig_that_turns():
    column = config(rotary=True, x={"column": "c", "unit": "deg"}).table.columns["x"]
    assert column.gain == pytest.approx(np.pi / 180)
    with pytest.raises(InputError, match="expected an angle such as deg, got 'mm'"):
        config(rotary=True, x={"column": "c", "unit": "mm"})
    with pytest.raises(InputError, match="expected a length such as mm, got 'deg'"):
        config(x={"column": "c", "unit": "deg"})
    torque = config(rotary=True, force={"column": "c", "unit": "Nm"}).table.columns["force"]
    assert torque.gain == 1
    assert set(ROTARY) == set(LINEAR)


def test_what_may_be_read_in_two_ways_is_asked_for():
    with pytest.raises(InputError, match="write rev/s or rad/s"):
        config(omega={"column": "c", "unit": "Hz"})
    with pytest.raises(InputError, match="full scale over raw value as scale"):
        config(x={"column": "c", "unit": "%"})


def test_a_table_in_units(tmp_path: Path):
    rows = np.column_stack([np.arange(2000.0), 10 * np.sin(np.arange(2000) * 0.01),
                            np.full(2000, 19.0), np.arange(2000) % 7 - 3.0])
    file = tmp_path / "a.csv"
    np.savetxt(file, rows, delimiter=",", header="t,x,p,n", comments="")
    got = read_table(file, settings_from_tree({"table": {
        "time": "t", "time_scale": "1 ms", "columns": {
        "x": {"column": "x", "unit": "mm"},
        "p1": {"column": "p", "unit": "bar gauge"},
        "omega": {"column": "n", "unit": "rpm", "scale": 100, "negative_scale": 50}}}}, "m"))
    np.testing.assert_allclose(got.channels["x"], rows[:, 1] * 1e-3)
    np.testing.assert_allclose(got.channels["p1"], 19e5 + 101_325)
    per = np.where(rows[:, 3] < 0, 50, 100) * np.pi / 30
    np.testing.assert_allclose(got.channels["omega"], rows[:, 3] * per)


def test_pumps_are_sold_in_cubic_centimetres_a_revolution():
    rig = settings_from_tree({"rig": {"pump_displacement": "1.6 cm^3/rev"}}, "m").rig
    assert rig.pump_displacement == pytest.approx(1.6e-6 / (2 * np.pi))


def test_a_bag_in_units_reads_as_in_si(tmp_path):
    from eha_monitor.cli import main
    from eha_monitor.recordings.read import read_recording
    from eha_monitor.ros.topics import topics_of

    bag = tmp_path / "bag"
    assert main(["simulate", "--out", str(bag), "--duration", "1"]) == 0
    si = read_recording(bag, settings_from_tree({}, "m"))
    # The same numbers, said in other units: x in m is 1000 mm, p in Pa is 1e-5 bar.
    units = config("channels", x={"unit": "mm", "scale": 1e3},
                   p1={"unit": "bar gauge", "scale": 1e-5, "offset": -1.01325},
                   omega={"unit": "rpm", "scale": 30 / np.pi})
    got = read_recording(bag, units)
    for name in ("x", "p1", "omega"):
        np.testing.assert_allclose(got.channels[name], si.channels[name], rtol=1e-9, atol=1e-9)
    live = {name: channel for topic in topics_of(units, "m") for entry in topic.entries
            for name, channel in entry.channels}
    assert live["x"].gain == pytest.approx(1.0)
    assert live["p1"].zero == pytest.approx(0.0, abs=1e-6)


# --- what else a logger writes -------------------------------------------------------------------
MAP = {"table": {"time": "Zeit", "columns": {"x": {"column": "Öl µm", "unit": "µm"}}}}


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "cp1252", "utf-16"])
def test_umlauts_in_every_encoding_of_windows(tmp_path, encoding):
    file = tmp_path / "a.csv"
    lines = ["Zeit;Öl µm", "s;µm", *(f"{k / 1000:.3f};{k}".replace(".", ",") for k in range(900))]
    file.write_text("\r\n".join(lines), encoding=encoding)
    got = read_table(file, settings_from_tree(MAP, "m"))
    np.testing.assert_allclose(got.channels["x"], np.arange(900) * 1e-6)
    assert got.losses == ()  # the row of units is none of the data


@pytest.mark.parametrize("form", ["%Y-%m-%dT%H:%M:%S.%fZ", "%Y-%m-%d %H:%M:%S,%f",
                                  "%d.%m.%Y %H:%M:%S,%f", "%m/%d/%Y %H:%M:%S.%f", "%H:%M:%S.%f"])
def test_dates_and_times_of_day_over_midnight(tmp_path, form):
    import datetime

    start = datetime.datetime(2026, 11, 23, 23, 59, 59, 500_000)
    lines = ["Zeit;Öl µm"] + [f"{(start + datetime.timedelta(milliseconds=k)).strftime(form)};{k}"
                              for k in range(900)]
    file = tmp_path / "a.csv"
    file.write_text("\n".join(lines), encoding="utf-8")
    got = read_table(file, settings_from_tree(MAP, "m"))
    assert got.sample_time == pytest.approx(1e-3)
    np.testing.assert_allclose(got.channels["x"], np.arange(900) * 1e-6)


def test_lines_above_the_names_are_skipped(tmp_path):
    file = tmp_path / "a.csv"
    file.write_text("Logger 3\nRange\t250\n\nZeit\tÖl µm\n" + "".join(
        f"{k / 1000:.3f}\t{k}\n" for k in range(900)), encoding="utf-8")
    tree = {"table": MAP["table"] | {"skip_rows": 3, "delimiter": "tab", "header": "present"}}
    np.testing.assert_allclose(read_table(file, settings_from_tree(tree, "m")).channels["x"],
                               np.arange(900) * 1e-6)


def test_a_pressure_of_another_topic_keeps_its_field():
    """``channels: {p1: {topic: /a/b, unit: bar}}`` asked for a field that only one can be."""
    found = settings_from_tree({"channels": {
        "p1": {"topic": "/a/b", "unit": "bar"}, "x": {"topic": "/rod"}}}, "test").channels
    assert (found["p1"].topic, found["p1"].field) == ("/a/b", "fluid_pressure")
    assert (found["x"].name, found["x"].field) == ("", "")  # which joint, nobody knows
