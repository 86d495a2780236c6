"""The bundled bag over DDS, through the processes: its alarm, on the bag's own time."""

from pathlib import Path

from rig_tools import settings
from ros_tools import PATIENCE, command, end
from test_live_offline import BAG, raised
from watch import Watcher

from eha_monitor.api.estimate import judged
from eha_monitor.estimation.pipeline import estimate
from eha_monitor.recordings.read import read_recording


def test_a_replay_alarms_when_the_bag_does_and_the_watcher_tells_the_bags_time(graph):
    name = "bulk_modulus_low"
    offline = raised(judged(estimate(read_recording(Path(BAG), settings()), settings()))[1])[name]
    lines = []
    watcher = Watcher(graph.node("watch", "/eha"), lambda line, level: lines.append(line))
    with command("monitor") as monitor:
        graph.until(lambda: watcher.seen.heard, PATIENCE)
        with command("replay", BAG) as replay:
            graph.until(lambda: name in watcher.seen.raised, PATIENCE)
            graph.until(lambda: replay.poll() is not None, PATIENCE)
        seconds = max(float(line.split()[0]) for line in lines  # STALE comes after the bag's end
                      if line.split()[1:2] == ["s"] and "STALE" not in line)
        assert seconds <= 16.0  # the bag's time, however long the processes took
        assert "FATAL" not in end(monitor)
    if watcher.seen.missing:
        assert "were lost on the way" in watcher.seen.losses
    told = next(line for line in lines if f"WARN  {name}: effective" in line)
    # Times are told since the first row that the monitor had, on a busy machine not the bag's.
    began = (watcher._first_ns - read_recording(Path(BAG), settings()).start_ns) * 1e-9
    assert began > -0.01
    # A busy machine loses messages and asks late; no alarm comes for that before its time.
    assert offline - 1.0 < began + float(told.split()[0]) < offline + 3.0, (began, lines)
