"""The ring of the last minutes, and bags from it: bounds, order, disks that are full."""

import os
import resource
import subprocess
import threading
import tracemalloc

import numpy as np
import pytest
from rosbags.rosbag2.metadata import parse_qos

from eha_monitor.recordings.bag import iter_raw, topics
from eha_monitor.recordings.ring import CHUNK_BYTES, Ring, Saver
from eha_monitor.recordings.write import TopicType

NUMBER = TopicType("std_msgs/msg/Float64")
START = 1_700_000_000_000_000_000
GENERATOR = np.random.default_rng(5)


def fill(ring, first, count, size=200):
    """Append messages that do not compress; their stamps count up."""
    a = ring.stream("/a", NUMBER)
    b = ring.stream("/b", TopicType("std_msgs/msg/Float64", latched=True))
    for k in range(first, first + count):
        data = b"\0\1\0\0" + GENERATOR.bytes(size)
        ring.append(a if k % 2 else b, START + k, data)


def stamps_in(path):
    return [stamp - START for _, _, stamp, _ in iter_raw(path)]


def saved(saver):
    saver.start()
    return saver.take(wait=True)


def test_a_bag_of_the_ring_is_complete_and_in_order(tmp_path):
    ring = Ring(60.0)
    fill(ring, 0, 5000)
    assert (ring.messages, ring.megabytes > 0.5) == (5000, True)
    result = saved(Saver(ring, tmp_path / "made" / "when_needed", "left arm/1"))
    assert result.problem is None and result.count == 5000
    assert result.path.name.startswith("left_arm_1_2") and str(result.path) in str(result)
    assert stamps_in(result.path) == list(range(5000))
    found = topics(result.path)
    assert {name: found[name].count for name in found} == {"/a": 2500, "/b": 2500}
    durable = {name: [str(p.durability) for p in parse_qos(found[name].qos)] for name in found}
    assert "TRANSIENT_LOCAL" in durable["/b"][0] and "VOLATILE" in durable["/a"][0]
    assert os.listdir(result.path.parent) == [result.path.name]
    assert ring.messages == 5000  # they age as before: the next bag may want them too


def test_memory_is_bounded_and_the_oldest_go_first():
    ring = Ring(60.0, limit_bytes=5 * CHUNK_BYTES)
    fill(ring, 0, 20_000)
    assert ring.megabytes <= 6.1 * CHUNK_BYTES / 1e6
    stamps = [stamp - START for chunk in ring.hold() for _, stamp, _ in chunk.messages()]
    assert stamps == list(range(stamps[0], 20_000)) and stamps[0] > 15_000


def test_what_compresses_well_takes_no_more_memory_than_it_says():
    ring = Ring(60.0)
    number = ring.stream("/a", NUMBER)
    tracemalloc.start()
    try:
        for k in range(200):
            ring.extend([(number, range(k, k + 400), [bytes(200)] * 400)])
        taken = tracemalloc.get_traced_memory()[0] / 1e6
    finally:
        tracemalloc.stop()
    assert ring.messages == 80_000 and taken < ring.megabytes + 0.5


def test_the_span_is_bounded():
    ring = Ring(1e-9)
    fill(ring, 0, 3000)
    ring.trim()
    assert ring.messages == 0


@pytest.fixture(params=["tmpfs", "file size"])
def small_disk(request, tmp_path):
    """A folder that takes 300 kB, and what makes it large enough."""
    if request.param == "tmpfs":
        folder = tmp_path / "disk"
        folder.mkdir()
        mount = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=300k", "tmpfs", folder],
                               capture_output=True, text=True)
        if mount.returncode:
            pytest.skip(f"no tmpfs of its own: {mount.stderr.strip()}")
        yield folder, lambda: subprocess.run(
            ["mount", "-o", "remount,size=50m", folder], check=True)
        subprocess.run(["umount", folder], check=True)
    else:
        limits = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, limits[1]))
        yield tmp_path, lambda: resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def test_a_full_disk_loses_nothing_and_is_left_clean(small_disk):
    folder, enlarge = small_disk
    ring = Ring(60.0, limit_bytes=3_000_000)
    saver = Saver(ring, folder, "rig")
    fill(ring, 0, 10_000)
    result = saved(saver)
    assert result.problem is not None and result.count == 10_000
    assert any(words in str(result) for words in ("No space left on device", "File too large"))
    assert "10000 messages" in str(result) and "\n" not in str(result)
    assert os.listdir(folder) == []
    fill(ring, 10_000, 10_000)  # more than the ring alone would keep
    assert saved(saver).problem is not None
    enlarge()
    result = saved(saver)
    assert (result.problem, result.count, result.dropped) == (None, 20_000, 0)
    assert stamps_in(result.path) == list(range(20_000))


def test_what_goes_while_a_disk_stays_full_is_counted_and_told(tmp_path):
    blocked = tmp_path / "blocked"
    blocked.write_text("a file where the folder should be")
    ring = Ring(60.0, limit_bytes=500_000)
    saver = Saver(ring, blocked, "rig")
    fill(ring, 0, 1000)
    assert "blocked" in saved(saver).problem
    fill(ring, 1000, 9000)
    blocked.unlink()
    result = saved(saver)
    stamps = stamps_in(result.path)
    assert stamps[:1000] == list(range(1000)) and stamps[-1] == 9999
    assert result.dropped == 10_000 - len(stamps) > 0
    assert f"{result.dropped} messages in between were dropped" in str(result)
    assert saved(saver).dropped == 0


def test_the_ring_goes_on_while_a_bag_is_written(tmp_path):
    ring = Ring(60.0)
    fill(ring, 0, 5000)
    saver = Saver(ring, tmp_path, "rig")
    saver.start()
    at_once = saver.take()
    fill(ring, 5000, 1000)
    assert at_once is None and saver.busy and threading.active_count() > 1
    result = saver.take(wait=True)
    assert stamps_in(result.path) == list(range(5000)) and ring.messages == 6000


def test_a_type_that_is_not_known_is_left_out_and_named(tmp_path):
    ring = Ring(60.0)
    fill(ring, 0, 10)
    ring.append(ring.stream("/odd", TopicType("odd_msgs/msg/Odd")), START + 10, b"\0\1\0\0")
    result = saved(Saver(ring, tmp_path, "rig"))
    assert result.left_out == ("/odd (odd_msgs/msg/Odd)",) and "/odd" in str(result)
    assert stamps_in(result.path) == list(range(10))


def test_an_empty_ring_says_so(tmp_path):
    result = saved(Saver(Ring(60.0), tmp_path, "rig"))
    assert "no message has come" in result.problem and os.listdir(tmp_path) == []
