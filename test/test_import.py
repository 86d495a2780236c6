"""CSV and MAT files through a channel map."""

import gzip
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.io import savemat

from eha_monitor.errors import InputError
from eha_monitor.recordings.importing import import_file, read_table
from eha_monitor.recordings.read import read_recording
from eha_monitor.recordings.write import write_recording
from eha_monitor.settings import load_settings, settings_from_tree

ROOT = Path(__file__).parent.parent
DATA = ROOT.parent / "shared" / "data"
T = np.arange(200) * 1e-3
X = 0.04 * np.sin(2 * np.pi * T)


def of(**table):
    return settings_from_tree({"table": table}, "map")


BY_NAME = of(time="t", time_scale=1e-3, columns={
    "x": {"column": "pos", "scale": 1e-3}, "p1": {"column": "p", "scale": 1e5, "offset": 1e5}})
BY_INDEX = of(time=0, time_scale=1e-3, columns={
    "x": {"column": 1, "scale": 1e-3}, "p1": {"column": 2, "scale": 1e5, "offset": 1e5}})


def text_of(delimiter=",", header=True, decimal=".", comment=False):
    lines = ["# a comment"] * comment + [delimiter.join(["t", "pos", "p"])] * header
    for t, x in zip(T, X, strict=True):
        cells = [f"{value:.12g}".replace(".", decimal) for value in (t * 1e3, x * 1e3, 20 + x)]
        lines.append(delimiter.join(cells))
    return "\n".join(lines) + "\n"


def check(recording):
    np.testing.assert_allclose(recording.channels["x"], X, atol=1e-12)
    np.testing.assert_allclose(recording.channels["p1"], (21 + X) * 1e5, atol=1e-3)
    assert recording.sample_time == pytest.approx(1e-3)


@pytest.mark.parametrize("delimiter", [",", ";", "\t", "  "])
@pytest.mark.parametrize("header", [True, False])
def test_csv(tmp_path, delimiter, header):
    path = tmp_path / "a.csv"
    path.write_text(text_of(delimiter, header, comment=True))
    recording = read_table(path, BY_NAME if header else BY_INDEX)
    check(recording)
    assert recording.losses == ()


@pytest.mark.parametrize("cut", [1, 5, 9])
def test_a_line_that_is_cut_at_the_end_is_no_row(tmp_path, cut):
    """A logger that is killed leaves half a line, and half a number: 1 mm in place of 105."""
    path, text = tmp_path / "a.csv", text_of(",", True)
    last = text.rstrip().splitlines()[-1]
    path.write_text(text + last[:len(last) - cut].rpartition(",")[0][:-1])
    check(read_table(path, BY_NAME))


def test_packed_decimal_comma_and_byte_order_mark(tmp_path):
    path = tmp_path / "a.csv.gz"
    with gzip.open(path, "wb") as file:
        file.write(b"\xef\xbb\xbf" + text_of(";", decimal=",").encode())
    check(read_table(path, BY_NAME))


def test_index_works_with_a_header_too(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(text_of())
    check(read_table(path, BY_INDEX))


def test_a_channel_at_half_the_rate_is_read_as_import_does(tmp_path):
    """Every other cell of a slower logger is empty: that left no two channels together."""
    lines = text_of().splitlines()
    lines[2::2] = [line.rpartition(",")[0] + "," for line in lines[2::2]]
    (tmp_path / "a.csv").write_text("\n".join(lines))
    recording = read_table(tmp_path / "a.csv", BY_NAME)
    p1 = recording.channels["p1"][1:-1]
    np.testing.assert_allclose(p1, (21 + X[1:1 + len(p1)]) * 1e5, atol=50.0)


def test_garbage_cells_are_nan_and_counted(tmp_path):
    lines = text_of().splitlines()
    for row, cell in ((11, "n/a"), (12, ""), (13, "1e400")):
        cells = lines[row].split(",")
        lines[row] = ",".join([cells[0], cell, cells[2]])
    lines[50] = "x," + lines[50].split(",", 1)[1]
    path = tmp_path / "a.csv"
    path.write_text("\n".join(lines))
    recording = read_table(path, BY_NAME)
    assert np.isnan(recording.channels["x"][[10, 11, 12, 49]]).all()
    assert np.isfinite(recording.channels["x"]).sum() == len(T) - 4
    assert "1 of 200 rows have no time and are left out" in recording.losses
    assert "x: 2 of 199 values are NaN" in recording.losses


def test_without_time_rows_follow_at_the_sample_time(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(text_of())
    config = settings_from_tree({"rig": {"sample_time": 0.02}, "table": {
        "columns": {"x": {"column": "pos", "scale": 1e-3}}}}, "map")
    recording = read_table(path, config)
    assert recording.sample_time == 0.02 and len(recording) == len(T)


def reordered(kind):
    rng = np.random.default_rng(5)
    rows = np.arange(len(T))
    return {"reversed": rows[::-1], "shuffled": rng.permutation(rows),
            "blocks": np.concatenate([rows[120:], rows[:120]]),
            "two late rows": np.concatenate([rows[:7], rows[9:12], rows[7:9], rows[12:]])}[kind]


@pytest.mark.parametrize("kind, expected", [
    ("reversed", "the rows run backwards in time: sorted by time"),
    ("shuffled", "the rows are not in order of time ("), ("blocks", "(1 of 199 steps run backw"),
    ("two late rows", "a.csv: 1 reversed stamp put in order")])
def test_rows_out_of_order_are_sorted_and_it_is_said(tmp_path, kind, expected):
    lines = text_of().splitlines()
    (tmp_path / "a.csv").write_text(
        "\n".join(lines[:1] + [lines[1 + row] for row in reordered(kind)]))
    recording = read_table(tmp_path / "a.csv", BY_NAME)
    check(recording)
    assert len(recording.losses) == 1 and expected in recording.losses[0]


def test_shuffled_rows_of_an_uneven_recording(tmp_path):
    rng = np.random.default_rng(6)
    t = np.cumsum(rng.uniform(0.7e-3, 1.3e-3, 3000))
    rows = rng.permutation(3000)
    np.savetxt(tmp_path / "a.csv", np.column_stack([t, 3 * t])[rows], delimiter=",", fmt="%.12g")
    recording = read_table(tmp_path / "a.csv", of(time=0, columns={"x": {"column": 1}}))
    assert np.isfinite(recording.channels["x"]).sum() > 2900
    assert "sorted by time" in recording.losses[0]


def test_a_clock_that_starts_anew_is_not_sorted(tmp_path):
    t = np.concatenate([T, T[:60] + 3.3e-4])
    np.savetxt(tmp_path / "a.csv", np.column_stack([t, 3 * t]), delimiter=",", fmt="%.12g")
    recording = read_table(tmp_path / "a.csv", of(time=0, columns={"x": {"column": 1}}))
    assert len(recording) == 200 and "the clock jumps back 1 time" in recording.losses[0]


def test_each_channel_on_its_own_clock(tmp_path):
    """Rows of 2 ms beside rows of 1 ms: the slower task has half of them, the rest is empty."""
    rows = [f"{k},{1e3 * X[k]:.9g}," + (f"{2 * k},{20 + X[2 * k]:.9g}" if 2 * k < len(X) else ",")
            for k in range(len(X))]
    path = tmp_path / "a.csv"
    path.write_text("\n".join(["t,pos,clock,p", *rows]) + "\n")
    own = {"time": "clock", "time_scale": 1e-3}
    recording = read_table(path, of(time="t", time_scale=1e-3, columns={
        "x": {"column": "pos", "scale": 1e-3},
        "p1": {"column": "p", "scale": 1e5, "offset": 1e5, **own}}))
    np.testing.assert_allclose(recording.channels["x"], X, atol=1e-12)
    np.testing.assert_allclose(recording.channels["p1"][:-1], (21 + X[:-1]) * 1e5, atol=10.0)
    assert recording.losses == ("p1: 500 Hz, interpolated to 1000 Hz",)
    with pytest.raises(InputError, match="column 'tick' not found"):
        read_table(path, of(time="t", columns={"x": {"column": "pos", "time": "tick"}}))


def test_delay_shifts_a_column(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(text_of())
    config = of(time="t", time_scale=1e-3, columns={
        "x": {"column": "pos", "scale": 1e-3}, "v": {"column": "pos", "scale": 1e-3,
                                                     "delay": 0.005}})
    recording = read_table(path, config)
    np.testing.assert_allclose(recording.channels["v"][:190], X[5:195], atol=1e-12)


def test_mat(tmp_path):
    path = tmp_path / "a.mat"
    savemat(path, {"t": T, "pos": X[:, None], "data": np.column_stack([T, X, 2 * X])})
    config = of(time="t", columns={"x": {"column": "pos"}, "v": {"column": "data[:,2]"}})
    recording = read_table(path, config)
    np.testing.assert_array_equal(recording.channels["x"], X)
    np.testing.assert_array_equal(recording.channels["v"], 2 * X)
    for column, expected in (("none", "variable 'none' not found, the file has data, pos, t"),
                             ("data", r"expected a column such as 'data\[:,0\]'"),
                             ("data[:,7]", "the variable has shape"), ("data[1", "not found")):
        with pytest.raises(InputError, match=expected):
            read_table(path, of(columns={"x": {"column": column}}))


def test_mat_of_text_and_of_unequal_lengths(tmp_path):
    path = tmp_path / "a.mat"
    savemat(path, {"a": "text", "b": np.zeros(3), "c": np.zeros(4)})
    with pytest.raises(InputError, match="holds no real numbers"):
        read_table(path, of(columns={"x": {"column": "a"}}))
    with pytest.raises(InputError, match="variables differ in length: b 3, c 4"):
        read_table(path, of(columns={"x": {"column": "b"}, "v": {"column": "c"}}))


def test_mat_of_version_7_3(tmp_path):
    path = tmp_path / "a.mat"
    path.write_bytes(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM"
                     + b"\x89HDF\r\n\x1a\n" + bytes(600))
    with pytest.raises(InputError, match=r"version 7\.3 are not read"):
        read_table(path, of(columns={"x": {"column": "a"}}))


def test_missing_column_names_those_that_there_are(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(text_of())
    with pytest.raises(InputError, match=r"a.csv: column 'q' not found, the file has columns t, "):
        read_table(path, of(columns={"x": {"column": "q"}}))
    path.write_text(text_of(header=False))
    with pytest.raises(InputError, match="3 columns without names, 0 to 2"):
        read_table(path, of(columns={"x": {"column": 3}}))


@pytest.mark.parametrize("content", [b"", b"\n\n", b"t,pos,p\n", b"\x00\x01\x02" * 50,
                                     b"t,pos,p\nx,y,z\n", b"# only\n# comments\n"])
@pytest.mark.parametrize("name", ["a.csv", "a.mat", "a.csv.gz"])
def test_nothing_in_it(tmp_path, content, name):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(InputError, match=name):
        read_table(path, BY_NAME)


def test_file_that_is_none(tmp_path):
    for path in (tmp_path / "none.csv", tmp_path):
        with pytest.raises(InputError, match="expected a CSV or MAT file"):
            read_table(path, BY_NAME)


@pytest.mark.parametrize("text, expected", [
    ("table: {colums: {}}", "table.colums: unknown key, did you mean 'columns'"),
    ("table: {columns: {y: {column: a}}}", "table.columns"),
    ("table: {columns: {x: {colum: a}}}", "table.columns.x"),
    ("table: {columns: {x: {column: a, scale: much}}}", "table.columns.x.scale: expected a num"),
    ("table: {time_scale: -1}", "table.time_scale: expected more than 0"),
    ("rig: {}", "table.columns: expected at least one channel"),
])
def test_bad_map(tmp_path, text, expected):
    (tmp_path / "map.yaml").write_text(text)
    (tmp_path / "a.csv").write_text(text_of())
    with pytest.raises(InputError, match=expected) as problem:
        import_file(tmp_path / "a.csv", tmp_path / "map.yaml", tmp_path / "bag")
    assert "map.yaml" in str(problem.value) and "\n" not in str(problem.value)
    assert not (tmp_path / "bag").exists()


def test_bag_of_an_import(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(text_of())
    recording = read_table(path, BY_NAME)
    write_recording(tmp_path / "bag", recording, BY_NAME)
    again = read_recording(tmp_path / "bag", BY_NAME)
    for name, values in recording.channels.items():
        np.testing.assert_array_equal(again.channels[name], values)
    with pytest.raises(InputError, match="exists already"):
        write_recording(tmp_path / "bag", recording, BY_NAME)


def test_overwrite_replaces_a_bag_only_and_asks_before_the_work(tmp_path):
    (tmp_path / "a.csv").write_text(text_of())
    (tmp_path / "map.yaml").write_text("table: {columns: {x: {column: pos}}}")
    with pytest.raises(InputError, match="is no bag; refusing to overwrite it"):
        import_file(tmp_path / "none.csv", tmp_path / "map.yaml", tmp_path, overwrite=True)
    assert (tmp_path / "a.csv").read_text() == text_of()
    for _ in range(2):
        import_file(tmp_path / "a.csv", tmp_path / "map.yaml", tmp_path / "bag", overwrite=True)


@given(content=st.binary(max_size=300) | st.text(",;\t .e-+0123456789\nabc\"#", max_size=300).map(
    str.encode), kind=st.sampled_from(["a.csv", "a.mat", "a.csv.gz"]))
def test_any_content(tmp_path, content, kind):
    path = tmp_path / kind
    path.write_bytes(gzip.compress(content) if kind == "a.csv.gz" else content)
    try:
        recording = read_table(path, of(columns={"x": {"column": 0}}))
    except InputError as problem:
        assert kind in str(problem) and "\n" not in str(problem)
    else:
        assert len(recording)


def real(folder, pattern):
    found = sorted((DATA / folder).glob(pattern)) if DATA.is_dir() else []
    if not found:
        pytest.skip(f"{folder}: real recordings are not in ../shared/data")
    return found


def held(folder, path, tmp_path):
    """Import a real file, read the bag back, and return it with its settings."""
    config = ROOT / "config" / f"{folder}.yaml"
    import_file(path, config, tmp_path / path.stem)
    settings_ = load_settings(config)
    return read_recording(tmp_path / path.stem, settings_), settings_.rig


def smooth(values, width=101):
    return np.convolve(values, np.ones(width) / width, mode="same")


def test_crane_jib(tmp_path):
    """A scope wrote the cylinder's pressures by a task of 5 ms, so that they end half way.

    Read by the rows, they would follow the valve's own, beside them, three seconds late.
    """
    for path in real("crane_jib", "*.csv.gz"):
        recording, _ = held("crane_jib", path, tmp_path)
        valve = read_table(path, of(time="time", columns={
            "x": {"column": "JibPistonPosition"},
            "p1": {"column": "JibPaDCV", "unit": "bar gauge"}})).channels["p1"]
        there = np.flatnonzero(np.isfinite(recording.channels["p1"]))
        assert there[-1] < 0.51 * len(recording)
        moves = there[np.gradient(recording.channels["x"])[there] > 5e-5]
        apart = valve[moves] - recording.channels["p1"][moves]  # what is lost in the line
        assert np.std(apart) < 2e5 and 1e5 < np.mean(apart) < 9e5


def test_ivliev(tmp_path):
    for path in real("ivliev_eha", "exp_data_1_*.csv"):
        recording, rig = held("ivliev_eha", path, tmp_path)
        assert len(recording) == 31000 and recording.losses == ()
        v = np.gradient(smooth(recording.channels["x"]), 1e-3)
        omega = smooth(recording.channels["omega"])
        moving = np.abs(v) > 5e-3
        assert (np.sign(v[moving]) == np.sign(omega[moving])).mean() > 0.99
        force = smooth(rig.area_1 * recording.channels["p1"] - rig.area_2
                       * recording.channels["p2"])
        damping = np.polyfit(v, force, 1)[0]
        assert 1.2e5 < damping < 2.2e5  # 159 kN·s/m in the source's own fit


def test_emps(tmp_path):
    recording, rig = held("emps", real("emps", "*.mat")[0], tmp_path)
    assert len(recording) == 24841 and recording.losses == ()
    v = np.gradient(smooth(recording.channels["x"], 31), 1e-3)
    a = np.gradient(smooth(v, 31), 1e-3)
    inner = slice(200, -200)
    damping = np.polyfit(v[inner], (smooth(recording.channels["force"], 31) - rig.mass * a)[inner],
                         1)[0]
    assert damping == pytest.approx(411, rel=0.02)


def test_hsm150(tmp_path):
    for path in real("hsm150", "*.mat"):
        recording, rig = held("hsm150", path, tmp_path)
        assert len(recording) == 20000 and rig.motion == "rotary"
        v = recording.channels["v"]
        x = recording.channels["x"]
        np.testing.assert_allclose(smooth(np.gradient(x, 1e-3))[200:-200], smooth(v)[200:-200],
                                   atol=2.0)
        a = np.gradient(smooth(v), 1e-3)
        table = np.column_stack([v, np.ones_like(v)])[200:-200]
        damping = np.linalg.lstsq(table, (recording.channels["force"] - rig.mass * a)[200:-200],
                                  rcond=None)[0][0]
        assert 3e-5 < damping < 9e-5  # 7.03e-5 in the file


def test_pneumatic_seals(tmp_path):
    for path in real("pneumatic_seals", "1_O*.csv"):
        recording, rig = held("pneumatic_seals", path, tmp_path)
        assert recording.sample_time == 0.01
        v = np.gradient(recording.channels["x"], 0.01)
        friction = rig.area_1 * recording.channels["p1"] - rig.area_2 * recording.channels["p2"]
        up, down = friction[v > 5e-3], friction[v < -5e-3]
        assert 3 < (np.nanmedian(up) - np.nanmedian(down)) / 2 < 12


def test_hanging_load_and_simulator(tmp_path):
    recording, _ = held("hanging_load", real("hanging_load", "*.csv")[0], tmp_path)
    assert len(recording) == 16060 and recording.sample_time == 0.02
    recording, rig = held("fluid_power_sim", real("fluid_power_sim", "h32_tri*")[0], tmp_path)
    assert len(recording) == 20001 and set(recording.channels) == {"x", "v", "x_d", "omega", "p1",
                                                                   "p2"}
    force = rig.area_1 * (recording.channels["p1"] - recording.channels["p2"])
    v = recording.channels["v"]
    a = np.gradient(v, 1e-3)
    assert np.polyfit(v, force - rig.mass * a, 1)[0] == pytest.approx(600, rel=0.02)


@pytest.mark.parametrize(("channel", "head", "unit", "scale", "said"), [
    ("p1", "Pumpe U/min", "bar", 1.0, "rpm"), ("x", "Druck A [bar]", "mm", 1.0, "bar"),
    ("omega", "pos_mm", "rpm", 1.0, "mm"), ("p1", "p (psi)", "", 1.0, ""),
    ("p1", "Pumpe U/min", "bar", 0.5, ""), ("x", "Weg [mm]", "m", 1.0, ""),
    ("x", "AI3 [V]", "mm", 1.0, ""), ("x", "AI3", "mm", 1.0, "")])
def test_a_column_whose_name_is_of_another_quantity_is_refused(tmp_path, channel, head, unit,
                                                             scale, said):
    """A wrong column of numbers reads like any other; its own head tells."""
    rows = "\n".join(f"{k / 1000};{k % 7}" for k in range(50))
    (tmp_path / "a.csv").write_text(f"t;{head}\n{rows}\n")
    settings = settings_from_tree({"table": {"time": "t", "columns": {
        channel: {"column": head, "unit": unit, "scale": scale}}}}, "map")
    if not said:
        assert len(read_table(tmp_path / "a.csv", settings)) == 50
        return
    with pytest.raises(InputError, match=f"table.columns.{channel}: column .* is in {said} by "):
        read_table(tmp_path / "a.csv", settings)
    by_index = settings_from_tree({"table": {"time": "t", "columns": {
        channel: {"column": 1, "unit": unit}}}}, "map")
    assert len(read_table(tmp_path / "a.csv", by_index)) == 50
