"""Broken bags: a recording of what is left, or one line.  Nothing else may come out."""

import contextlib
import os
import struct

import numpy as np
import pytest
from bag_tools import JOINT, START, contract_messages, joint, motion, write_mcap
from hypothesis import given, settings
from hypothesis import strategies as st

from eha_monitor.errors import InputError
from eha_monitor.recordings.bag import iter_raw, topics
from eha_monitor.recordings.read import read_recording
from eha_monitor.settings import Settings

SETTINGS = Settings()
N = 400
FORMS = [("zstd", True), ("lz4", True), ("none", True), ("none", False)]


@pytest.fixture(scope="module", params=FORMS, ids=lambda form: f"{form[0]}-{form[1]}")
def whole(request, tmp_path_factory):
    compression, chunked = request.param
    path = write_mcap(tmp_path_factory.mktemp("whole") / "a.mcap", contract_messages(N),
                      compression=compression, chunked=chunked)
    return path.read_bytes()


def attempt(path):
    """Return the recording or None; the error must be one line that names the file."""
    try:
        recording = read_recording(path, SETTINGS)
    except InputError as problem:
        assert str(path) in str(problem) and "\n" not in str(problem), problem
        assert len(str(problem)) < 600
        return None
    assert all("\n" not in loss for loss in recording.losses)
    return recording


def check_prefix(recording):
    """Every value that came out is the one that was written."""
    _, x, p = motion(N)
    start = round((recording.start_ns - START) * 1e-6)
    for name, truth in (("x", x), ("p1", p)):
        if name in recording.channels:
            values = recording.channels[name]
            good = np.isfinite(values)
            np.testing.assert_array_equal(values[good], truth[start:start + len(values)][good])


@pytest.mark.parametrize("share", [0.15, 0.3, 0.5, 0.7, 0.9, 0.99])
def test_truncated_bag_is_used_up_to_the_cut(whole, tmp_path, share):
    path = tmp_path / "cut.mcap"
    data = whole[:int(len(whole) * share)]
    path.write_bytes(data)
    recording = attempt(path)
    if recording is None:
        assert share < 0.5  # a compressed file is short: the first chunk may be cut
        return
    check_prefix(recording)
    told = [loss for loss in recording.losses if "truncated at byte" in loss]
    assert len(told) == 1 and told[0].endswith(f"{recording.duration:.3f} s recovered")
    assert int(told[0].split("byte ")[1].split()[0]) <= len(data)


def test_most_of_a_cut_bag_is_recovered(tmp_path):
    path = write_mcap(tmp_path / "a.mcap", contract_messages(4000), chunk_size=10**9,
                      compression="none")
    data = path.read_bytes()
    path.write_bytes(data[:len(data) // 2])
    recording = read_recording(path, SETTINGS)  # a single chunk, cut in its middle
    assert len(recording) > 1500


@given(data=st.data())
def test_any_cut(whole, tmp_path, data):
    path = tmp_path / "cut.mcap"
    path.write_bytes(whole[:data.draw(st.integers(0, len(whole)))])
    recording = attempt(path)
    if recording is not None:
        check_prefix(recording)


@given(data=st.data())
def test_any_damage(whole, tmp_path, data):
    path = tmp_path / "damaged.mcap"
    content = bytearray(whole)
    for _ in range(data.draw(st.integers(1, 4))):
        place = data.draw(st.integers(0, len(content) - 1))
        content[place] = data.draw(st.integers(0, 255))
    path.write_bytes(content)
    attempt(path)
    for reader in (lambda: list(iter_raw(path)), lambda: topics(path)):
        with contextlib.suppress(InputError):
            reader()


@given(data=st.data())
def test_any_damaged_message(tmp_path, data):
    """Garbage inside messages, in a file that is sound."""
    messages = []
    for topic, msgtype, stamp, raw in contract_messages(40):
        if data.draw(st.booleans()) and data.draw(st.booleans()):
            raw = bytearray(raw[:data.draw(st.integers(0, len(raw)))])
            for _ in range(data.draw(st.integers(0, 3))):
                if raw:
                    raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
        messages.append((topic, msgtype, stamp, bytes(raw)))
    attempt(write_mcap(tmp_path / "a.mcap", messages))


@settings(max_examples=30)
@given(text=st.text(max_size=80))
def test_any_message_definition(tmp_path, text):
    try:
        encoded = text.encode()
    except UnicodeEncodeError:
        return
    path = write_mcap(tmp_path / "a.mcap", contract_messages(5),
                      definitions={JOINT: encoded.decode()})
    recording = attempt(path)
    if not any(letter.isalpha() for letter in text):  # no definition: the type itself is known
        np.testing.assert_array_equal(recording.channels["x"], motion(5)[1])


def test_damaged_chunk_is_a_gap(tmp_path):
    path = write_mcap(tmp_path / "a.mcap", contract_messages(N), compression="none",
                      chunk_size=10_000)
    data = bytearray(path.read_bytes())
    data[len(data) // 3] ^= 0xFF
    path.write_bytes(data)
    recording = read_recording(path, SETTINGS)
    check_prefix(recording)
    assert any("1 damaged chunk left out" in loss for loss in recording.losses)
    assert any(loss.startswith("the file declares 800 messages") for loss in recording.losses)
    assert np.isnan(recording.channels["x"]).any()


@pytest.mark.parametrize("content, expected", [
    (b"", "the file is empty"),
    (b"time;x\n0;1\n" * 50, "expected an mcap bag"),
    (b"\x89MCAP0\r\n", "holds no message"),
    (b"SQLite format 3\x00" + bytes(100), "got sqlite3"),
    (b"\x28\xb5\x2f\xfdgarbage", "cannot unpack|expected an mcap bag"),
    (os.urandom(1000), "expected an mcap bag"),
])
def test_not_a_bag(tmp_path, content, expected):
    path = tmp_path / "a.mcap"
    path.write_bytes(content)
    with pytest.raises(InputError, match=expected):
        read_recording(path, SETTINGS)
    assert attempt(path) is None


def test_folders_without_a_bag(tmp_path):
    with pytest.raises(InputError, match="no such bag"):
        read_recording(tmp_path / "none", SETTINGS)
    with pytest.raises(InputError, match=r"neither metadata.yaml nor \.mcap file"):
        read_recording(tmp_path, SETTINGS)
    (tmp_path / "a_0.db3").write_bytes(b"SQLite format 3\x00")
    with pytest.raises(InputError, match="sqlite3"):
        read_recording(tmp_path, SETTINGS)
    (tmp_path / "metadata.yaml").write_text(
        "rosbag2_bagfile_information: {relative_file_paths: [a_0.db3]}")
    with pytest.raises(InputError, match="sqlite3"):
        read_recording(tmp_path, SETTINGS)


@pytest.mark.parametrize("text", ["", "[", "a: 1", "rosbag2_bagfile_information: 3", "\xff\xfe",
                                  "rosbag2_bagfile_information: {relative_file_paths: 4}"])
def test_bad_metadata_does_not_matter(tmp_path, text):
    write_mcap(tmp_path / "a_0.mcap", contract_messages(50))
    (tmp_path / "metadata.yaml").write_bytes(text.encode("latin-1"))
    recording = read_recording(tmp_path, SETTINGS)
    assert len(recording) == 50
    assert "metadata.yaml cannot be read" in recording.losses[0]


def test_no_messages(tmp_path):
    with pytest.raises(InputError, match="holds no message"):
        read_recording(write_mcap(tmp_path / "a.mcap", []), SETTINGS)


def test_only_nan(tmp_path):
    messages = [("/eha/joint_states", JOINT, START + i, joint(START + i, position=(np.nan,)))
                for i in range(10)]
    with pytest.raises(InputError, match="no finite value"):
        read_recording(write_mcap(tmp_path / "a.mcap", messages), SETTINGS)


def test_chunk_that_claims_to_be_huge(tmp_path):
    path = write_mcap(tmp_path / "a.mcap", contract_messages(50), chunk_size=10**6)
    data = bytearray(path.read_bytes())
    chunk = data.index(b"\x06", 8 + 9 + data[9])  # opcode of the first chunk
    struct.pack_into("<Q", data, chunk + 9 + 16, 2**60)
    path.write_bytes(data)
    with pytest.raises(InputError, match="holds no message"):
        read_recording(path, SETTINGS)


def test_unknown_compression(tmp_path):
    path = write_mcap(tmp_path / "a.mcap", contract_messages(50), chunk_size=10**6)
    path.write_bytes(path.read_bytes().replace(b"zstd", b"zsts"))
    with pytest.raises(InputError, match="compression 'zsts', expected zstd, lz4 or none"):
        read_recording(path, SETTINGS)
