"""One rule, live and offline: the same alarms, at nearly the same time."""

from functools import cache
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


@cache
def offline_of(case):
    """Return a recording, and when each alarm is first raised of it offline, s."""
    recording = CASES[case][0]()
    return recording, raised(judged(estimate(recording, settings()))[1])


@pytest.mark.parametrize("case", CASES)
def test_the_same_alarms_come_within_a_second_of_one_another(case):
    recording, offline = offline_of(case)
    name = CASES[case][1]
    stream, board = Stream(), AlarmBoard(settings())
    stream.push(rows_of(recording))
    for snapshot in stream.history:
        board.update(snapshot.time_s, snapshot.parameters, None, snapshot.model.tainted)
    live = raised(board.history)
    assert set(live) == set(offline) == {name}
    assert abs(live[name] - offline[name]) < 1.0


@pytest.mark.parametrize("first", [0, 450])
def test_a_monitor_that_is_seldom_asked_alarms_no_earlier(first):
    """Where a value is on trial only when somebody asks, the first of these fails by 0.9 s."""
    (recording, offline), name = offline_of("air ramp"), "bulk_modulus_low"
    early = recording.part(0, round((offline[name] - 0.5) / recording.sample_time))
    live, board, asked = LiveEstimator(settings()), AlarmBoard(settings()), 0
    for count in fed(live, rows_of(early)):
        if count % 900 == first:
            snapshot = live.snapshot()
            board.update(snapshot.time_s, snapshot.parameters, None, snapshot.model.tainted)
            asked += 1
    assert asked > 8 and name not in raised(board.history)
