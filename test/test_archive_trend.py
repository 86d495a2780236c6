"""The line through many recordings: its slope, and how sure it is."""

import numpy as np
import pytest

from eha_monitor.archive.history import MONTH, history, outlook, trend
from eha_monitor.archive.store import iso_time
from eha_monitor.reports.archive_report import history_block, summary_words, trend_words
from eha_monitor.settings import Settings

DAY = 86_400.0
START = 1.79e9  # s since the epoch


def row(day: float, value: float, stddev: float = 1.0, **more) -> dict:
    return {"bag": f"d{day}", "start": iso_time(round((START + day * DAY) * 1e9)), "B": value,
            "B_stddev": stddev, "B_unit": "N·s/m", "B_status": "converged", "B_doubt": None,
            "made_with": "now", **more}


def test_a_line_without_noise_is_found():
    time = START + DAY * np.array([0.0, 4.0, 9.0, 30.0])
    line = trend(time, 600.0 + 2.0 * (time - START) / MONTH, np.full(4, 0.5))
    assert MONTH * line.slope == pytest.approx(2.0)
    assert line.scatter == 0.0
    assert line.at(np.array([START]))[0][0] == pytest.approx(600.0)


@pytest.mark.parametrize("scatter", [0.0, 8.0])
def test_slopes_lie_within_their_standard_deviation(scatter):
    """With and without a scatter from night to night that no recording knows of."""
    rng = np.random.default_rng(3)
    off = []
    for _ in range(150):
        time = START + DAY * np.sort(rng.uniform(0.0, 60.0, 20))
        stddev = rng.uniform(0.5, 3.0, 20)
        value = 600.0 + 5.0 * (time - START) / MONTH + rng.normal(
            0.0, np.hypot(stddev, scatter))
        line = trend(time, value, stddev)
        off.append((MONTH * line.slope - 5.0) / (MONTH * line.slope_stddev))
    assert 0.85 < np.std(off) < 1.15
    assert abs(np.mean(off)) < 0.2


def test_no_line_where_there_is_none():
    time = START + DAY * np.arange(3.0)
    assert trend(time[:2], np.ones(2), np.ones(2)) is None
    assert trend(np.full(3, START), np.ones(3), np.ones(3)) is None
    assert trend(time, np.array([1.0, np.nan, 2.0]), np.ones(3)) is None
    assert trend(time, np.zeros(3), np.zeros(3)).slope == 0.0


def test_doubtful_values_do_not_bend_the_line():
    rows = [row(day, 600.0) for day in range(5)]
    rows += [row(5, 900.0, B_doubt="the model does not fit"),
             row(6, 4e9, B_status="diverged"), row(7, 900.0, made_with="before")]
    found = history(rows, "B", "estimate", "now")
    assert found.line.count == 5
    assert found.line.slope == pytest.approx(0.0, abs=1e-12)
    assert found.reliable.tolist() == [True] * 5 + [False] * 3
    block = history_block(found, Settings())
    assert block.pictures
    assert "not significant" in block.notes[0]


def test_no_line_goes_through_values_of_a_model_that_does_not_fit():
    """Of a stranger's press with constant oil: beta_e of 4.1 and 4.6 GPa, -2820 +- 330 a month."""
    rows = [row(day, 900.0 + day, 0.1, B_doubt="dry friction") for day in range(6)]
    found = history([*rows, row(6, 600.0), row(7, 601.0)], "B", "estimate", "now")
    assert found.line is None
    assert "needs 3 values" in trend_words(found) and "2 there" in trend_words(found)
    air = [{**one, "free_air_percent": -3.8, "free_air_percent_noise": 0.01,
            "free_air_percent_status": "in_doubt"} for one in rows]
    assert history(air, "free_air", "estimate", "now").line is None


def test_copies_of_a_recording_count_once():
    """By the moment from which they are, and how long."""
    rows = [row(day, 600.0, samples=100) for day in range(3)]
    found = history([*rows, {**rows[0], "bag": "copy"}], "B", "estimate", "now")
    assert found.line.count == 3


def test_measured_temperatures_make_it_the_reference():
    rows = [row(day, 600.0 + 50.0 * (day % 2), B_reference=600.0, B_reference_stddev=1.0)
            for day in range(4)]
    found = history(rows, "B", "estimate", "now")
    assert found.at_reference
    assert found.value.tolist() == [600.0] * 4
    rows[1]["B_reference"] = None
    assert not history(rows, "B", "estimate", "now").at_reference


def test_stamps_that_are_no_calendar_time_are_told():
    rows = [row(-START / DAY + 1.0, 600.0), row(0, 600.0)]
    found = history(rows, "B", "estimate", "now")
    assert found.undated == 1
    assert "needs 3 values" in trend_words(found)
    alone = history(rows[:1], "B", "estimate", "now")
    assert "not calendar times" in history_block(alone, Settings()).notes[0]
    nothing = history([{"bag": "a", "made_with": "now", "error": "broken"}], "beta_e",
                      "estimate", "now")
    assert "no recording gives a value" in history_block(nothing, Settings()).notes[0]


def test_an_alarm_that_nobody_asked_for_is_no_ok():
    rows = [row(day, 600.0, alarm=None) for day in range(3)]
    assert "no limit is set, so that no alarm was judged" in summary_words(rows, "estimate")
    rows[0]["alarm"] = "OK"
    assert "no alarm at the end of any recording" in summary_words(rows, "estimate")


def test_what_is_beyond_its_limit_is_not_said_to_have_no_growth():
    """A stranger's leak: 470 to 1190 ml/min in eight recordings, the limit 900."""
    values = [(480.0, 390.0), (470.0, 290.0), (630.0, 76.0), (775.0, 89.0), (765.0, 88.0),
              (950.0, 100.0), (1030.0, 106.0), (1190.0, 111.0)]
    time = START + 4.0 * DAY * np.arange(8)
    for count, status in ((5, "cannot_be_told_yet"), (8, "beyond")):
        value, stddev = np.array(values[:count]).T
        (one,) = outlook(time[:count], value, stddev, (None, 900.0)).forecasts
        assert one.status == status
