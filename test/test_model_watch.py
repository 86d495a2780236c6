"""When a mismatch begins and ends, what it taints, and when a value is on trial."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from eha_monitor.estimation.consistency import Window, judge, normal_deviate
from eha_monitor.estimation.model_watch import (
    CHANCE_S,
    FITTING_S,
    LONGEST_FITTING_S,
    LONGEST_TRIAL_S,
    TRIAL_S,
    StageWatch,
    Trial,
    tainted_by,
)
from eha_monitor.estimation.results import (
    Beside,
    Consistency,
    Mismatch,
    ParameterEstimate,
    Taint,
)


def verdict(consistent=False, decisive=True, first=3.0):
    return Consistency(10_000, 2.0, 50.0, 0.5, 4.0, consistent, "a sentence", first, decisive)


def standing(stage="one", since=3.0):
    return Mismatch(stage, "somewhere", since, 2.0, 50.0, 4.0, "a sentence")


def test_a_decisive_window_begins_a_mismatch_where_it_first_showed():
    watch = StageWatch("one")
    assert not watch.update(4.0, verdict(consistent=True))
    assert watch.update(5.0, verdict())
    found = watch.standing
    assert (found.since_s, found.worst_time_s, found.nis) == (3.0, 4.0, 2.0)
    assert "force" in found.balance and found.message == "a sentence"
    assert not watch.update(6.0, verdict(first=5.5))  # it has begun before
    assert watch.standing.since_s == 3.0


def test_what_chance_could_bring_must_stand_for_longer_than_a_window():
    watch = StageWatch("two")
    times = np.arange(0.0, 2 * CHANCE_S, 0.5)
    begun = [t for t in times if watch.update(t, verdict(decisive=False))]
    assert begun == [CHANCE_S + 0.5]
    watch = StageWatch("two")
    for t in times:
        assert not watch.update(t, verdict(consistent=t % 10 == 0, decisive=False))


def clear(watch, start):
    """Feed fitting windows from ``start`` on; return how long it takes."""
    for k in range(200):
        if watch.test(start + 0.5 * k, True):
            return 0.5 * k
    return None


def test_it_ends_when_windows_have_fitted_for_a_while():
    watch = StageWatch("one")
    watch.update(5.0, verdict())
    assert not watch.test(6.0, True) and not watch.test(7.0, False)  # starts anew
    assert not watch.test(8.0, None)  # at rest: nothing is shown, nothing ends
    assert clear(watch, 9.0) == FITTING_S
    assert watch.standing is None and not watch.test(20.0, True)


def test_one_that_comes_back_soon_takes_longer_to_end():
    watch, time, took = StageWatch("one"), 0.0, []
    for _ in range(8):
        watch.update(time, verdict(first=time))
        took.append(clear(watch, time))
        time += took[-1] + 5.0
    assert took[:4] == [FITTING_S, 2 * FITTING_S, 4 * FITTING_S, 8 * FITTING_S]
    assert max(took) == LONGEST_FITTING_S
    time += 500.0
    watch.update(time, verdict(first=time))
    assert clear(watch, time) == FITTING_S


def test_a_new_mismatch_does_not_begin_before_the_last_one_ended():
    watch = StageWatch("one")
    watch.update(5.0, verdict())
    clear(watch, 6.0)
    watch.update(9.0, verdict(first=4.0))
    assert watch.standing.since_s == 8.0
    watch = StageWatch("one")
    watch.update(5.0, verdict(first=math.nan))
    assert watch.standing.since_s == 5.0


def test_a_parameter_that_was_on_trial_dates_it_back():
    watch = StageWatch("one")
    watch.update(7.0, verdict(first=6.1), Taint("it has moved", 4.2, testing=True))
    assert watch.standing.since_s == 4.2


@given(st.lists(st.sampled_from(["bad", "doubtful", "good", None]), max_size=100),
       st.lists(st.sampled_from([True, False, None]), max_size=100))
def test_any_sequence_keeps_its_order(verdicts, fits):
    watch, ended = StageWatch("one"), -math.inf
    for k, (word, fit) in enumerate(zip(verdicts, fits, strict=False)):
        made = word and verdict(word == "good", word == "bad", first=k - 1.0)
        before = watch.standing
        began = watch.update(float(k), made)
        assert began == (before is None and watch.standing is not None)
        if watch.standing:
            assert ended <= watch.standing.since_s <= k
        if watch.test(float(k), fit):
            assert fit is True and watch.standing is None
            ended = k


@pytest.mark.parametrize("stages, expected", [
    ((), ()), (("one",), ("B", "beta_e")), (("two",), ("beta_e",)),
    (("two", "one"), ("B", "beta_e")), (("joint",), ("B", "beta_e"))])
def test_what_is_tainted(stages, expected):
    """Stage two holds the force balance as well."""
    found = tainted_by([standing(stage) for stage in stages])
    assert tuple(sorted(found)) == expected
    assert not any(taint.testing or taint.instead for taint in found.values())


def test_only_what_least_squares_determine_stands_instead():
    known = ParameterEstimate("B", 600.0, 3.0, "N·s/m", "converged")
    vague = ParameterEstimate("beta_e", 6e8, 3e8, "Pa", "not_excited")
    found = tainted_by([standing("one")], {"B": known, "beta_e": vague},
                       [Beside(5.0, {"B": known, "beta_e": vague})], 5.0)
    assert found["B"].instead == known and found["beta_e"].instead is None


@pytest.mark.parametrize(("value", "doubted"), [(620.0, False), (680.0, True)])
def test_a_stage_that_fits_is_in_doubt_where_least_squares_contradict_it(value, doubted):
    other = {"B": ParameterEstimate("B", 600.0, 3.0, "N·s/m", "converged")}
    own = {"B": ParameterEstimate("B", value, 1.0, "N·s/m", "converged")}
    looks = [Beside(5.0, other)]
    assert ("B" in tainted_by([standing("two")], own, looks, 5.0)) == doubted
    assert "B" not in tainted_by([], own, looks, 5.0)


def test_a_value_that_jumps_is_on_trial_and_a_slow_drift_is_not():
    trial = Trial("N·s/m")
    at = [k * 0.1 for k in range(100)]
    seen = [trial.update(t, 600.0 if t < 5 else 1200.0) is not None for t in at]
    assert seen.index(False) == round(TRIAL_S / 0.1)  # the first value is new itself
    assert seen[50] and not seen[49] and not seen[50 + round(TRIAL_S / 0.1) + 1]
    trial.update(10.0, 1200.0)
    assert trial.update(10.1, 1300.0).reason.startswith(
        "it has moved from 1200 N·s/m to 1300 N·s/m")
    assert trial.update(10.2, None) is None
    drift = Trial("N·s/m")
    drift.update(0.0, 600.0)
    late = [drift.update(t, 600.0 * math.exp(0.001 * t)) for t in np.arange(5.0, 40.0, 0.1)]
    assert not any(late)


def test_what_is_only_new_dates_no_mismatch():
    trial = Trial("N·s/m")
    for k in range(30):
        trial.update(0.1 * k, 600.0 if k < 20 else 1200.0)
        assert (trial.moved is None) == (k < 20)
    assert trial.moved.since_s == pytest.approx(2.0)


def test_a_new_value_that_settles_within_its_deviation_has_not_moved():
    trial = Trial("N·s/m")
    for k in range(30):
        trial.update(0.1 * k, 600.0 + 200.0 * 0.5**k, 150.0 * 0.5**k)
        assert trial.moved is None
    assert trial.update(3.0, 660.0, 1.0) is not None and trial.moved is not None


def test_a_trial_is_of_the_last_moments_however_long_the_value_goes_on_moving():
    trial = Trial("N·s/m")
    for k in range(300):
        taint = trial.update(0.1 * k, 600.0 * (1.0 + (k // 10 % 2)))
        assert 0.1 * k - taint.since_s <= LONGEST_TRIAL_S + 1e-9


@given(st.lists(st.floats(0.01, 0.3), min_size=1, max_size=200))
def test_the_rate_of_looking_does_not_matter_to_a_trial(steps):
    """A value that jumps at one time is on trial for as long at ten looks a second as at any."""
    times = np.cumsum(steps)
    jump = times[len(times) // 2]
    trial = Trial("N·s/m")
    for time in times:
        on = trial.update(time, 1200.0 if time >= jump else 600.0) is not None
        new = time - times[0] < TRIAL_S - 1e-6
        moved = time >= jump and any(time - TRIAL_S + 1e-6 <= t < jump for t in times)
        assert on == (new or moved)


def test_chance_over_days_is_told_from_what_no_chance_explains():
    rng = np.random.default_rng(0)
    # The largest of so many ratios passes six naive standard deviations, but not these.
    ratios = np.mean(rng.standard_normal((200_000, 9)) ** 2, axis=1)
    assert ((ratios - 1.0) / np.sqrt(2 / 9)).max() > 6.0
    deviates = normal_deviate(ratios, np.full(len(ratios), 9))
    assert deviates.max() < 5.5 and np.std(deviates) == pytest.approx(1.0, abs=0.03)


def test_a_parameter_that_drifts_excuses_its_lag_and_hopping_does_not():
    e = np.random.default_rng(1).standard_normal(10_000)
    e += 0.4 * np.sin(2 * np.pi * 1e-3 * np.arange(10_000))  # what a lag leaves
    rows = np.arange(500.0, 10_000.0, 500.0)
    drift = np.column_stack([rows, 600.0 + rows, 650.0 + rows, np.full(len(rows), 400.0)])
    hops = drift.copy()
    hops[:, 1], hops[:, 2] = 600.0 + rows % 1000.0, 1100.0 - rows % 1000.0

    def found(changes):
        return judge(1e-6 * e, np.full(len(e), 1e-6), Window(1e-3, seconds=10.0), "stage one", "x",
                     changes).consistent

    assert not found(None) and found(drift) and not found(hops)
