"""Recordings that do not fit into memory: read, estimated, written and diagnosed in pieces."""

import tracemalloc
from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from rig_tools import SINE, TRIANGLE, copies, settings, simulated, write_channels

from eha_monitor.api.estimate import judged
from eha_monitor.estimation.joint import observability
from eha_monitor.estimation.pipeline import estimate_held
from eha_monitor.mismatch.data.experiment import experiment_of
from eha_monitor.mismatch.data.inputs import windows_of
from eha_monitor.recordings import columns, read
from eha_monitor.recordings.bag_writer import BagWriter
from eha_monitor.recordings.columns import Column, blocks, first_where, let_go, on_disk, spans_of
from eha_monitor.recordings.recording import Recording
from eha_monitor.recordings.write import ChannelWriter, messages_of

FINE = {"IN_MEMORY": 8192, "PIECE": 4096}


def same(one, other, but=()):
    """Whether two results hold the same numbers, bit for bit."""
    for field in fields(one):
        if field.name in but:
            continue
        a, b = getattr(one, field.name), getattr(other, field.name)
        if isinstance(a, np.ndarray):
            np.testing.assert_array_equal(a, b, err_msg=field.name)
        else:
            assert repr(a) == repr(b), field.name


# ---- columns ------------------------------------------------------------------------------------


def test_a_long_column_lies_on_disk_and_gives_its_memory_back(monkeypatch):
    monkeypatch.setattr(columns, "IN_MEMORY", 100)
    monkeypatch.setattr(columns, "PIECE", 64)
    values, column = np.random.default_rng(0).normal(size=1000), Column()
    for part in np.array_split(values, 7):
        column.append(part)
    column.fill(1010)
    found = column.values()
    assert on_disk(found) and not on_disk(values)
    let_go(found)
    np.testing.assert_array_equal(found[:1000], values)
    assert np.isnan(found[1000:]).all()
    seen = [rows for _, _, (rows,) in blocks(found)]
    assert max(map(len, seen)) == 64 and sum(map(len, seen)) == 1010
    assert first_where(lambda rows: rows == values[700], found) == 700


@given(st.lists(st.booleans(), min_size=1, max_size=60), st.integers(1, 20))
def test_stretches_go_on_over_the_edges_of_pieces(mask, size):
    mask = np.array(mask)
    starts, stops = spans_of((i, mask[i:i + size]) for i in range(0, len(mask), size))
    whole = spans_of([(0, mask)])
    assert starts.tolist() == whole[0].tolist() and stops.tolist() == whole[1].tolist()


# ---- reading ------------------------------------------------------------------------------------


def channels_of(seconds: float, seed: int = 0) -> dict[str, np.ndarray]:
    return {name: values.copy()
            for name, values in simulated(SINE, seconds).recording(seed).channels.items()}


@hypothesis_settings(max_examples=12)
@given(st.integers(20_000, 900_000), st.lists(st.tuples(
    st.sampled_from(["x", "p1", "omega", "all"]), st.integers(1500, 5000), st.integers(1, 700)),
    max_size=3), st.booleans())
def test_a_bag_reads_alike_as_it_comes_and_at_once(tmp_path_factory, size, gaps, slow):
    bag = tmp_path_factory.mktemp("bags") / "bag"
    given_ = channels_of(6.0)
    for name, first, length in gaps:
        for one in given_ if name == "all" else [name]:
            given_[one][first:first + length] = np.nan
    if slow:
        given_["temperature"] = np.where(np.arange(6000) % 100 == 0, 40.0 + np.arange(6000) / 1e4,
                                         np.nan)
    write_channels(bag, given_, settings(), start_ns=1_700_000_000_000_000_000)
    at_once = read._read(bag, settings(), streamed=False)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(read, "BATCH_BYTES", size)
        as_it_came = read.read_recording(bag, settings())
    assert list(as_it_came.channels) == list(at_once.channels)
    for name, values in at_once.channels.items():
        np.testing.assert_array_equal(as_it_came.channels[name], values, err_msg=name)
    same(as_it_came, at_once, ("channels", "losses"))
    assert sorted(as_it_came.losses) == sorted(at_once.losses)


def test_stamps_that_jitter_are_read_as_a_whole(tmp_path, monkeypatch):
    given_ = channels_of(6.0)
    rng = np.random.default_rng(1)
    stamps = 10**18 + 10**6 * np.arange(6000) + rng.integers(0, 150_000, 6000)
    stamps[:3000] = 10**18 + 10**6 * np.arange(3000)  # the jitter comes later
    streams = messages_of(given_, stamps, "/eha")
    with BagWriter(tmp_path / "bag", {one.topic: one.msgtype for one in streams}) as writer:
        writer.write_many({one.topic: (one.stamps, one.data) for one in streams})
    at_once = read._read(tmp_path / "bag", settings(), streamed=False)
    monkeypatch.setattr(read, "BATCH_BYTES", 100_000)
    found = read.read_recording(tmp_path / "bag", settings())
    assert "jitter" in " ".join(found.losses)
    for name, values in at_once.channels.items():
        np.testing.assert_array_equal(found.channels[name], values)


@pytest.mark.parametrize("missing", [slice(0, 0), slice(2500, 2600)], ids=["whole", "gap"])
def test_joints_in_messages_of_their_own_are_read_as_they_come(tmp_path, monkeypatch, missing):
    """As the simulator and several drivers publish them: piston and pump on one topic."""
    given_ = channels_of(6.0)
    stamps = 10**18 + 10**6 * np.arange(6000)
    apart = [messages_of({name: given_[name]}, stamps, "/eha")[0] for name in ("x", "omega")]
    rest = messages_of({name: values for name, values in given_.items()
                        if name not in ("x", "omega")}, stamps, "/eha")
    kinds = {one.topic: one.msgtype for one in (*apart, *rest)}
    left_out = set(range(6000)[missing])
    with BagWriter(tmp_path / "bag", kinds) as writer:
        for k, stamp in enumerate(stamps.tolist()):
            for one in (*apart, *rest):
                if one is not apart[1] or k not in left_out:
                    writer.write_raw(one.topic, stamp, one.data[k].tobytes())
    ways, read_ = [], read._read
    monkeypatch.setattr(read, "_read", lambda *given, **how: ways.append(how) or read_(
        *given, **how))
    monkeypatch.setattr(read, "BATCH_BYTES", 150_000)
    found = read.read_recording(tmp_path / "bag", settings())
    assert len(ways) == 1  # no second time, as a whole
    expected = {name: values.copy() for name, values in given_.items()}
    expected["omega"][missing] = np.nan
    for name, values in expected.items():
        np.testing.assert_array_equal(found.channels[name], values, err_msg=name)
    at_once = read_(tmp_path / "bag", settings(), streamed=False)
    same(found, at_once, ("channels", "losses"))
    assert sorted(found.losses) == sorted(at_once.losses)


def test_a_bag_of_several_files_is_one_recording(tmp_path, monkeypatch):
    given_ = channels_of(6.0)
    folder = tmp_path / "night"
    folder.mkdir()
    for i in range(3):
        part = {name: values[2000 * i:2000 * (i + 1)] for name, values in given_.items()}
        write_channels(folder / f"night_{i}.mcap", part, settings(),
                       start_ns=10**18 + 2000 * i * 10**6)
    monkeypatch.setattr(read, "BATCH_BYTES", 150_000)
    found = read.read_recording(folder, settings())
    for name, values in given_.items():
        np.testing.assert_array_equal(found.channels[name], values)
    assert not found.losses


# ---- estimate -----------------------------------------------------------------------------------


def rising(seconds):
    """B and the bulk modulus change on the way, so that stages jump and start anew."""
    return simulated(SINE, seconds, faults={
        "wear": {"parameter": "viscous_damping", "start": 5.0, "duration": 0.2, "value": 1100.0},
        "air": {"parameter": "entrained_air.alpha", "start": 8.0, "duration": 0.2, "value": 0.05},
    }).recording(3)


@pytest.fixture(scope="module")
def changing():
    recording = rising(12.0)
    channels = copies(recording)
    for values in channels.values():
        values[3000:3040] = np.nan
    channels["x"][7000] += 0.3  # a wild sample
    return replace(recording, channels=channels)


@pytest.fixture(scope="module")
def at_once(changing):
    return estimate_held(changing, settings(command_hold="continuous"))


@hypothesis_settings(max_examples=8)
@given(size=st.integers(130, 9000))
def test_pieces_give_the_numbers_of_the_whole(changing, at_once, size):
    found = estimate_held(changing, settings(command_hold="continuous"), size)
    same(found.stage_one, at_once.stage_one)
    same(found.stage_two, at_once.stage_two)
    same(found.joint, at_once.joint)
    same(found, at_once, ("recording", "settings", "stage_one", "stage_two", "joint", "wall_s"))
    assert judged(found) == judged(at_once)


@pytest.mark.parametrize("known", [
    {"effects": {"drive_lag": {"tau": 3e-3}}},
    {"effects": {"command_delay": {"T": 4e-3}, "position_delay": {"T": 2e-3}}},
    {"effects": {"coulomb_friction": {"F_c": 30.0}}},
    {"command_hold": "sampled"},
])
def test_pieces_carry_what_drive_and_effects_remember(known):
    known = {"command_hold": "continuous"} | known
    recording = simulated(TRIANGLE, 6.0, **{
        key: value for key, value in known.items() if key == "effects"}).recording(0)
    whole = estimate_held(recording, settings(**known))
    found = estimate_held(recording, settings(**known), 700)
    np.testing.assert_allclose(found.stage_one.value, whole.stage_one.value, rtol=1e-12)
    np.testing.assert_allclose(found.stage_two.value, whole.stage_two.value, rtol=1e-9)


def test_memory_does_not_grow_with_the_length(monkeypatch):
    for name, value in FINE.items():
        monkeypatch.setattr(columns, name, value)

    def peak(seconds: float) -> float:
        channels = {}
        for name, values in simulated(SINE, seconds).recording(0).channels.items():
            column = Column()
            column.append(values)
            channels[name] = column.values()
            assert on_disk(channels[name])
        recording = Recording(1e-3, channels)
        tracemalloc.start()
        found = estimate_held(recording, settings(command_hold="continuous"))
        judged(found)
        observability(found)
        largest = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert found.parameters["B"].status == "converged"
        return largest

    peak(15.0)  # what is loaded once
    short, long = peak(20.0), peak(80.0)
    assert long < 1.3 * short + 200e3, (short, long)


# ---- writing ------------------------------------------------------------------------------------


def test_thousands_of_messages_are_written_as_one_by_one(tmp_path):
    given_ = channels_of(3.0)
    given_["p1"][100:900] = np.nan
    stamps = 10**18 + 10**6 * np.arange(3000)
    streams = messages_of(given_, stamps, "/eha")
    kinds = {one.topic: one.msgtype for one in streams}
    with BagWriter(tmp_path / "one" / "bag", kinds) as writer:
        rows = sorted((int(stamp), i, k) for i, one in enumerate(streams)
                      for k, stamp in enumerate(one.stamps))
        for stamp, i, k in rows:
            writer.write_raw(streams[i].topic, stamp, streams[i].data[k].tobytes())
    with ChannelWriter(tmp_path / "many" / "bag", tuple(given_), 1e-3, "/eha",
                       start_ns=10**18) as writer:
        for first in range(0, 3000, 271):
            writer.write({name: values[first:first + 271] for name, values in given_.items()})
    one, many = ((tmp_path / kind / "bag" / "bag_0.mcap").read_bytes() for kind in ("one", "many"))
    assert one == many
    with (tmp_path / "many" / "bag" / "bag_0.mcap").open("rb") as stream:
        told = make_reader(stream)
        assert told.get_summary().statistics.message_count == len(rows)
        assert sum(1 for _ in told.iter_messages(topics=["/eha/pressure/chamber_1"])) == 2200


def test_memory_of_a_writer_does_not_grow(tmp_path):
    block = channels_of(4.0)

    def peak(blocks_: int) -> float:
        tracemalloc.start()
        with ChannelWriter(tmp_path / f"bag{blocks_}", tuple(block), 1e-3, "/eha",
                           start_ns=10**18) as writer:
            for _ in range(blocks_):
                writer.write(block)
        largest = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return largest

    peak(1)
    assert peak(16) < 1.2 * peak(4)


# ---- diagnose -----------------------------------------------------------------------------------


def test_the_windows_of_a_long_recording_are_those_that_move():
    moving = simulated(SINE, 8.0).recording(0)
    resting = {name: np.full(8000, values[0]) for name, values in moving.channels.items()}
    rng = np.random.default_rng(0)
    parts = [moving.channels if i in (2, 7) else {
        name: values + 1e-9 * rng.normal(size=8000) for name, values in resting.items()}
        for i in range(10)]
    long = Recording(1e-3, {name: np.concatenate([part[name] for part in parts])
                            for name in moving.channels}, source="long")
    chosen = windows_of([long], settings(), most=16_000)
    assert [one.first for one in chosen] == [16_000, 56_000]
    assert windows_of([long], settings(), most=80_000) is None


def test_an_experiment_of_a_long_recording_holds_windows_of_it():
    short = simulated(SINE, 8.0).recording(0)
    long = Recording(1e-3, {name: np.tile(values, 10) for name, values in short.channels.items()},
                     source="long")
    experiment = experiment_of([long], settings(command_hold="continuous"))
    assert experiment.windows and experiment.n <= 64_000
    for one in experiment.stretches:
        assert one.start * 1e3 % 8000 == pytest.approx(0.0)
        np.testing.assert_array_equal(one.z[:, 0], short.channels["x"])
