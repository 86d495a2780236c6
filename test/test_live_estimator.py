"""The live estimator against the offline pipeline, and what streams do to it."""

import math

import numpy as np
import pytest
from rig_tools import (
    BETA,
    LOUD,
    MULTISINE,
    SINE,
    TRIANGLE,
    fed,
    settings,
    simulated,
    with_channels,
    without,
)

from eha_monitor.estimation.pipeline import estimate
from eha_monitor.live.checks import APART_S, Turns
from eha_monitor.live.diagnosing import Adopted, Candidate
from eha_monitor.live.estimator import LiveEstimator

FIXED = {"noise": {"fixed": True}}


def rows_of(recording, start=0.0):
    """Yield (time, row) as the aligner hands them on: what is missing is absent."""
    names, columns = list(recording.channels), list(recording.channels.values())
    for k, values in enumerate(zip(*columns, strict=True)):
        yield start + k * recording.sample_time, {
            name: float(value) for name, value in zip(names, values, strict=True)
            if math.isfinite(value)}


class Stream:
    """A live estimator that is looked at ten times a second, as the monitor does."""

    def __init__(self, **config):
        self.live = LiveEstimator(settings(**config))
        self.events = []
        self.history = []

    def push(self, rows):
        for count in fed(self.live, rows):
            if count % 100 == 0:
                self.look()
        return self.look()

    def look(self):
        snapshot = self.live.snapshot()
        self.events += snapshot.events
        self.history.append(snapshot)
        return snapshot

    def told(self, word):
        return [event for event in self.events if word in event.message]


@pytest.fixture(scope="module")
def run():
    return simulated(SINE, 6.0)


@pytest.fixture(scope="module")
def stream(run):
    made = Stream(**FIXED)
    made.push(rows_of(run.recording(0)))
    return made


def test_an_adopted_model_is_no_surer_than_its_diagnosis(stream):
    snapshot = stream.history[-1]
    adopted = Adopted("service", "", "", "", {}, {}, {"B": 0.05, "beta_e": 1e-9})
    widened = adopted.widened(snapshot, settings())
    b, before = widened.parameters["B"], snapshot.parameters["B"]
    assert b.value == before.value and b.stddev == pytest.approx(0.05 * b.value)
    assert b.status == "converged" and "5 %" in b.message
    assert widened.parameters["beta_e"] == snapshot.parameters["beta_e"]


def test_live_and_offline_agree(run, stream):
    # The last rows wait for their neighbours: the same stretch for both.
    offline = estimate(run.recording(0).part(0, 5990), settings(**FIXED)).parameters
    live = stream.history[-1].parameters
    for name, tolerance in (("B", 0.1), ("beta_e", 1.0)):
        assert live[name].status == offline[name].status == "converged"
        assert live[name].stddev == pytest.approx(offline[name].stddev, rel=0.1)
        assert abs(live[name].value - offline[name].value) < tolerance * offline[name].stddev
    assert stream.history[-1].model.status == "consistent"


def test_filterpy_runs_live_to_the_same_numbers(run):
    """``engine: filterpy`` is the readable reference, live as over recordings."""
    recording = run.recording(0).part(0, 2500)
    rows, made = list(rows_of(recording)), {}
    for engine in ("compiled", "filterpy"):
        made[engine] = Stream(engine=engine, **FIXED)
        made[engine].push(rows)
    for mine, theirs in zip(*(stream.history for stream in made.values()), strict=True):
        for name in ("B", "beta_e"):
            for value in ("value", "stddev"):
                assert getattr(mine.parameters[name], value) == pytest.approx(
                    getattr(theirs.parameters[name], value), rel=1e-6, nan_ok=True)
        assert mine.position == pytest.approx(theirs.position, rel=1e-9, nan_ok=True)
    for name, value in estimate(recording, settings(**FIXED)).parameters.items():
        other = estimate(recording, settings(engine="filterpy", **FIXED)).parameters[name]
        assert (value.value, value.stddev) == pytest.approx((other.value, other.stddev), rel=1e-6)


def test_rows_in_batches_of_any_length_give_what_one_by_one_give(run):
    """Batches with holes, repeats and a gap: the same grid, the same estimates."""
    recording = run.recording(0).part(0, 4000)
    times = recording.time.copy()
    times[3000:] += 2.0  # a long gap
    keep = np.ones(4000, dtype=bool)
    keep[1500:1503] = keep[2000] = False
    order = np.flatnonzero(keep)
    order = np.insert(order, 800, order[799])  # one twice
    columns = {name: values[order] for name, values in recording.channels.items()}
    made = {size: LiveEstimator(settings(**FIXED)) for size in (1, 10, 97)}
    for size, live in made.items():
        for start in range(0, len(order), size):
            live.push_rows(times[order][start : start + size], {
                name: values[start : start + size] for name, values in columns.items()})
    expected = made[10].snapshot().parameters
    for size in (1, 97):
        for name, found in made[size].snapshot().parameters.items():
            assert found.value == pytest.approx(
                expected[name].value, abs=0.2 * expected[name].stddev)


def test_estimates_come_within_a_second_and_their_story_is_told(stream):
    at_one = next(s for s in stream.history if s.time_s >= 1.0)
    assert at_one.parameters["B"].status == at_one.parameters["beta_e"].status == "converged"
    assert stream.history[0].parameters["B"].status == "no_data"
    assert stream.history[0].model.status == "not_judged"
    assert len(stream.told("B converged")) == len(stream.told("βe converged")) == 1
    first, *again = stream.told("handed over by stage one")
    assert first.message.startswith("runs with") and first.time_s < 0.5
    assert again and all(event.message.startswith("re-run") for event in again)
    assert not stream.told("changed")
    times = [event.time_s for event in stream.events]
    assert times == sorted(times)


def test_position_and_velocity_follow(run, stream):
    last = stream.history[-1]
    assert last.position == pytest.approx(run.truth[-10, 1], abs=1e-3)
    assert abs(last.velocity) < 0.3 and last.temperature is None


def test_measured_noise_serves_as_well(run):
    end = Stream().push(rows_of(run.recording(1, **LOUD)))
    b = end.parameters["B"]
    assert b.status == "converged" and abs(b.value - 600) < 4 * b.stddev
    assert b.stddev == pytest.approx(10 * 0.09, rel=0.3)


def test_gaps_duplicates_and_late_rows_do_no_harm(run):
    rows = list(rows_of(run.recording(0)))
    rng = np.random.default_rng(0)
    broken = []
    for k, (time, row) in enumerate(rows):
        if 2000 <= k < 2200 or k in (3000, 3001, 3500):
            continue
        broken.append((time, row))
        if k % 50 == 7:
            broken.append((time, {**row, "x": 1.0}))  # the same stamp again: the first stands
        if k % 90 == 11:
            broken[-1] = (time, {n: v for n, v in row.items() if rng.random() < 0.8})
    made = Stream()
    end = made.push(broken)
    assert end.parameters["B"].value == pytest.approx(600, rel=0.01)
    assert end.parameters["beta_e"].value == pytest.approx(BETA, rel=0.02)
    assert end.model.status == "consistent" and not made.told("changed")


def test_after_a_long_gap_parameters_stay_and_states_start_anew(run):
    rows = list(rows_of(run.recording(0)))
    made = Stream()
    before = made.push(rows[:3000])
    end = made.push((time + 30.0, row) for time, row in rows[3000:])
    gap, = made.told("no data for 30.0")
    assert gap.time_s == pytest.approx(33.0, abs=0.01)
    for name, truth in (("B", 600.0), ("beta_e", BETA)):
        a, b = before.parameters[name], end.parameters[name]
        assert b.status == "converged" and b.stddev < a.stddev
        assert abs(b.value - truth) < 4.5 * b.stddev
    assert end.time_s == pytest.approx(35.999, abs=0.01)
    assert end.model.status == "consistent" and not made.told("changed")


@pytest.mark.parametrize("lacking", [(), ("p1", "p2")])
@pytest.mark.parametrize("joined", [400, 1500, 2500])
def test_who_joins_a_steady_motion_claims_no_modulus_before_a_reversal(joined, lacking):
    """Half a second at constant speed told 4e9 +- 1e8 Pa to a filter that started from the prior,
    for 6e8; B is there at once."""
    run = simulated(TRIANGLE, 8.0)
    made = Stream()
    made.push(rows_of(without(run.recording(3), *lacking).part(joined, 8000)))
    for seen in made.history:
        modulus = seen.parameters["beta_e"]
        assert (modulus.status in ("no_data", "not_excited")
                or abs(modulus.value - BETA) < 4.0 * modulus.stddev + 0.01 * BETA), seen.time_s
        assert seen.model.status != "mismatch" and not made.told("changed")
    assert made.history[-1].parameters["beta_e"].status == "converged"


@pytest.mark.parametrize("late, words", [
    (("p1",), "p1 arrived after the start"), (("x_d", "omega"), "omega and x_d arrived after")])
def test_channels_that_come_late_are_taken_up(run, late, words):
    rows = list(rows_of(run.recording(0).part(0, 3500)))
    made = Stream(**FIXED)
    made.push([(t, {n: v for n, v in row.items() if k >= 500 or n not in late})
               for k, (t, row) in enumerate(rows)])
    assert len(made.told("arrived after the start")) == 1 and made.told(words)
    assert {p.status for p in made.history[-1].parameters.values()} == {"converged"}


def test_reset_forgets_and_says_why(run):
    rows = list(rows_of(run.recording(0)))
    made = Stream()
    made.push(rows[:2000])
    made.live.reset("stamps jumped back by 2.000 s")
    fresh = made.look()
    assert {p.status for p in fresh.parameters.values()} == {"no_data"}
    assert made.told("estimates reset: stamps jumped back by 2.000 s")
    end = made.push(rows[:2000])
    assert end.parameters["B"].value == pytest.approx(600, rel=0.01)
    assert end.parameters["beta_e"].value == pytest.approx(BETA, rel=0.02)


def test_a_ramp_of_b_is_followed_without_a_false_change_of_the_modulus():
    fault = {"b": {"parameter": "viscous_damping", "start": 2.0, "duration": 3.0,
                   "value": 1400.0}}
    made = Stream()
    end = made.push(rows_of(simulated(SINE, 7.5, faults=fault).recording(0)))
    assert end.parameters["B"].value == pytest.approx(1400, rel=0.01)
    assert end.parameters["beta_e"].value == pytest.approx(BETA, rel=0.02)
    assert made.told("B changed") and not made.told("βe changed")
    for snapshot in made.history[5:]:
        truth = 600 + 800 * np.clip((snapshot.time_s - 2) / 3, 0, 1)
        assert snapshot.parameters["B"].value == pytest.approx(truth, abs=70)
        assert snapshot.parameters["beta_e"].value == pytest.approx(BETA, rel=0.05)


def test_air_that_enters_is_followed_while_b_stays():
    fault = {"air": {"parameter": "bulk_modulus", "start": 2.0, "value": 3e8}}
    made = Stream()
    end = made.push(rows_of(simulated(SINE, 5.0, faults=fault).recording(0)))
    assert end.parameters["beta_e"].value == pytest.approx(3e8, rel=0.02)
    assert end.parameters["B"].value == pytest.approx(600, rel=0.01)
    assert made.told("βe changed") and not made.told("B changed")


@pytest.mark.parametrize("sample_time", [2e-3, 5e-4])
def test_another_rate_than_configured(sample_time):
    recording = simulated(SINE, 3.0, rig={"sample_time": sample_time}).recording(0)
    made = Stream()
    end = made.push(rows_of(recording))
    assert made.told(f"rows come every {sample_time * 1e3:g} ms, not every 1 ms")
    assert end.parameters["B"].value == pytest.approx(600, rel=0.01)
    assert end.parameters["beta_e"].value == pytest.approx(BETA, rel=0.02)


@pytest.mark.parametrize("missing, name, words", [
    (("p1",), "B", "stage one needs the channels p1 and p2, or force"),
    (("x_d", "omega"), "beta_e", "stage two needs the channel x_d")])
def test_a_missing_channel_is_named(run, missing, name, words):
    end = Stream().push(rows_of(without(run.recording(0).part(0, 2500), *missing)))
    parameter = end.parameters[name]
    assert parameter.status == "no_data" and words in parameter.message
    assert math.isnan(parameter.value)
    other = end.parameters["beta_e" if name == "B" else "B"]
    assert other.status == "converged"


def test_without_the_command_the_pump_speed_is_the_input(run):
    end = Stream().push(rows_of(without(run.recording(0).part(0, 3000), "x_d")))
    assert end.parameters["beta_e"].value == pytest.approx(BETA, rel=0.02)


def test_temperature_passes_through_and_rows_of_nothing_do_no_harm(run):
    recording = with_channels(run.recording(0).part(0, 1000), temperature=np.full(1000, 41.5))
    made = Stream()
    made.push([(k * 1e-3, {}) for k in range(400)])
    assert {p.status for p in made.history[-1].parameters.values()} == {"no_data"}
    end = made.push(rows_of(recording, start=0.4))
    assert end.temperature == 41.5


def test_dry_friction_is_a_mismatch_live_as_well():
    run = simulated(TRIANGLE, 6.0, effects={"coulomb_friction": {"F_c": 10.0}})
    end = Stream().push(rows_of(run.recording(0)))
    assert end.model.status == "mismatch"
    assert end.parameters["B"].value > 750


def test_the_state_is_told_with_its_own_time(run, stream):
    """The rows that wait for their neighbours are not yet in it: 10 ms, up to 2 mm here."""
    measured = run.recording(0).channels["x"]
    for seen in stream.history[-20:]:
        at = round(seen.state_time_s / run.config.rig.sample_time)
        assert 0 < seen.time_s - seen.state_time_s < 0.05
        assert abs(measured[at] - seen.position) < 1e-5


def test_a_long_gap_among_the_first_rows_starts_the_record_behind_it(run):
    rows = list(rows_of(run.recording(0)))
    made = Stream(**FIXED)
    made.push(rows[:100])
    made.push([(time + 2.0, row) for time, row in rows[100:3100]])
    assert made.history[-1].parameters["B"].status == "converged"
    assert made.history[-1].parameters["B"].value == pytest.approx(600.0, rel=0.01)


def test_an_estimator_with_another_model_catches_up_while_rows_come():
    friction = {"coulomb_friction": {"F_c": 40.0}}
    columns = simulated(MULTISINE, 8.0, effects=friction).recording(0).channels
    times = 1e-3 * np.arange(8000)

    def batch(start):
        return times[start:start + 100], {name: values[start:start + 100]
                                          for name, values in columns.items()}

    running = LiveEstimator(settings(**FIXED))
    for start in range(0, 6000, 100):
        running.push_rows(*batch(start))
    assert running.snapshot().model.mismatches
    coming = Candidate(LiveEstimator(settings(effects=friction, **FIXED)), running.past(1.0))
    assert coming.first_s == 1.0 and not coming.advance(0.0)
    coming.withdraw("omega", 5.0)  # a channel that no stage needs
    for start in range(6000, 8000, 100):
        running.push_rows(*batch(start))
        coming.push(*batch(start))
        coming.advance(0.02)
    assert coming.advance(60.0)
    found = coming.estimator.snapshot()
    assert found.time_s == running.snapshot().time_s and not found.model.mismatches
    assert found.parameters["B"].value == pytest.approx(600, rel=0.01)
    buffer = coming.estimator._grid.buffer
    assert buffer.end - buffer.first == 7000  # no row is lost
    assert np.isnan(buffer.column("omega", 4000, 5000)).all()
    assert np.isfinite(buffer.column("omega", 3900, 4000)).all()
    assert not LiveEstimator(settings()).past(0.0)


def test_actuators_of_one_process_look_over_their_buffers_in_turn(run):
    """Ten that began together otherwise wait for ten runs of stage two at once."""
    now = [0.0]
    turns = Turns(lambda: now[0])
    streams = [Stream(**FIXED) for _ in range(3)]
    for stream in streams:
        stream.live = LiveEstimator(settings(**FIXED), turns)
    channels = run.recording(0).channels
    times = 1e-3 * np.arange(6000)
    for start in range(0, 6000, 100):
        now[0] = times[start]
        for stream in streams:
            stream.live.push_rows(times[start:start + 100], {
                name: values[start:start + 100] for name, values in channels.items()})
            stream.look()
    first = [stream.told("runs with B")[0].time_s for stream in streams]
    assert np.diff(first).min() >= APART_S - 0.1 - 1e-9  # rows come every 0.1 s
    assert len(set(first)) == 3
    for stream in streams:
        assert stream.look().parameters["beta_e"].value == pytest.approx(6e8, rel=0.01)
