"""One rule, live and offline: the same alarms, at nearly the same time."""

import math
from pathlib import Path

import pytest
from rig_tools import MULTISINE, SINE, TRIANGLE, fed, settings, simulated
from test_live_estimator import Stream, rows_of

from eha_monitor.api.estimate import judged
from eha_monitor.estimation.pipeline import estimate
from eha_monitor.health.alarms import AlarmBoard
from eha_monitor.live.estimator import LiveEstimator
from eha_monitor.recordings.read import read_recording

BAG = Path(__file__).parents[1] / "bags" / "air_ingress"


def fault(shape, seconds, parameter, value, duration):
    faults = {"it": {"parameter": parameter, "start": 4.0, "duration": duration, "value": value}}
    return lambda: simulated(shape, seconds, faults=faults).recording(0)


CASES = {
    "the bundled bag": (lambda: read_recording(BAG, settings()), "bulk_modulus_low"),
    "damping step": (fault(SINE, 9.0, "viscous_damping", 1300.0, 0.0), "viscous_damping_high"),
    "damping step, triangle": (fault(TRIANGLE, 9.0, "viscous_damping", 1300.0, 0.0),
                               "viscous_damping_high"),
    "damping ramp": (fault(SINE, 18.0, "viscous_damping", 1300.0, 12.0), "viscous_damping_high"),
    "air step": (fault(MULTISINE, 9.0, "entrained_air.alpha", 0.06, 0.0), "bulk_modulus_low"),
    "air ramp": (fault(MULTISINE, 14.0, "entrained_air.alpha", 0.06, 4.0), "bulk_modulus_low"),
}


def raised(history):
    """Return when each alarm was first raised, s."""
    found = {}
    for alarm in history:
        if alarm.raised:
            found.setdefault(alarm.name, alarm.time_s)
    return found


@pytest.mark.parametrize("recording, name", CASES.values(), ids=CASES)
def test_the_same_alarms_come_within_a_second_of_one_another(recording, name):
    recording = recording()
    offline = raised(judged(estimate(recording, settings()))[1])
    stream, board = Stream(), AlarmBoard(settings())
    stream.push(rows_of(recording))
    for snapshot in stream.history:
        board.update(snapshot.time_s, snapshot.parameters, None, snapshot.model.tainted)
    live = raised(board.history)
    assert set(live) == set(offline) == {name}
    assert abs(live[name] - offline[name]) < 1.0


@pytest.mark.parametrize("first", range(0, 900, 150))
def test_a_monitor_that_is_seldom_asked_alarms_no_earlier(first):
    recording = read_recording(BAG, settings())
    offline = raised(judged(estimate(recording, settings()))[1])
    live, board = LiveEstimator(settings()), AlarmBoard(settings())
    for count in fed(live, rows_of(recording)):
        if count % 900 == first:
            snapshot = live.snapshot()
            board.update(snapshot.time_s, snapshot.parameters, None, snapshot.model.tainted)
    name = "bulk_modulus_low"
    assert offline[name] - 0.5 < raised(board.history).get(name, math.inf)
