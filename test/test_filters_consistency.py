"""The verdict on innovations: quiet on white ones, loud on others; status of a parameter."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import lfilter

from eha_monitor.estimation.consistency import (
    Window,
    judge,
    stage_verdict,
    variance_ratios,
    while_changing,
)
from eha_monitor.estimation.results import ONE, ParameterEstimate, judge_parameter, no_data
from eha_monitor.estimation.supervision import (
    BLOCK,
    INFORMATION,
    SCORE,
    honest_factor,
    look,
    new_supervision,
    score_ratio,
)

DT = 1e-3


def verdict(e, sigma=1e-6, **more):
    window = Window(DT, **{name: more.pop(name) for name in ("quantum", "start", "seconds")
                           if name in more})
    return judge(sigma * e, np.full(len(e), sigma), window, "stage one", "something is missing",
                 **more)


def test_white_innovations_are_almost_never_blamed():
    rng = np.random.default_rng(0)
    blamed = 0
    for k in range(300):
        result = verdict(rng.standard_normal(400 + 97 * (k % 200)))
        blamed += not result.consistent
        assert result.nis == pytest.approx(1.0, abs=0.35)
    assert blamed <= 1


def test_slightly_wrong_noise_levels_are_forgiven_and_grossly_wrong_ones_are_not():
    rng = np.random.default_rng(1)
    for scale, consistent in ((0.3, True), (1.0, True), (1.1, True), (1.5, False), (3.0, False)):
        results = [verdict(scale * rng.standard_normal(8000)).consistent for _ in range(10)]
        assert all(found == consistent for found in results), scale


@pytest.mark.parametrize("make", [
    lambda w: lfilter([1], [1, -0.95], w) * np.sqrt(1 - 0.95**2),  # coloured, of right size
    lambda w: w + 0.3,  # an offset of a third of a sigma
    lambda w: w + 0.4 * np.sin(2 * np.pi * 0.7 * DT * np.arange(len(w))),
    lambda w: w + np.where(np.arange(len(w)) % 1000 < 20, 4.0, 0.0),  # bumps at reversals
    lambda w: np.where((np.arange(len(w)) > 4000) & (np.arange(len(w)) < 4110), 8 * w, w),
], ids=["coloured", "offset", "slow wave", "bumps", "one burst"])
def test_other_innovations_are_blamed(make):
    rng = np.random.default_rng(2)
    results = [verdict(make(rng.standard_normal(16_000))) for _ in range(10)]
    assert not any(result.consistent for result in results)
    assert all("something is missing" in result.message and "\n" not in result.message
               for result in results)


def test_the_verdict_is_said_in_times_the_noise_and_huge_ones_alike():
    """NIS, innovations and 10^68 are for no technician."""
    e = np.random.default_rng(5).standard_normal(8000)
    wrong, absurd = verdict(e + 100.0).message, verdict(e * 1e60).message
    assert "times the noise" in wrong and "more than 10000 times the noise" in absurd
    for said in (wrong, absurd, verdict(e).message):
        assert not {"NIS", "innovations", "white"} & set(said.replace(",", " ").split()), said


def test_the_worst_place_is_named():
    e = np.random.default_rng(3).standard_normal(20_000)
    e[12_300:12_400] *= 8
    result = verdict(e)
    assert result.peak_time_s == pytest.approx(12.35, abs=0.11)
    assert verdict(e, start=100.0).peak_time_s == pytest.approx(112.35, abs=0.11)


def test_gaps_are_left_out_and_too_few_are_not_judged():
    e = np.random.default_rng(4).standard_normal(3000)
    e[500:2500] = np.nan
    assert verdict(e).samples == 1000 and verdict(e).consistent
    assert verdict(e[:690]) is not None and verdict(np.full(5000, np.nan)) is None
    assert verdict(e[:199]) is None


def test_variance_ratios_are_those_of_block_sums():
    e = np.random.default_rng(5).standard_normal(1000)
    lengths, ratios = variance_ratios(e)
    assert list(lengths) == [1, 2, 4, 8, 16, 32, 64]
    for m, ratio in zip(lengths, ratios, strict=True):
        sums = [e[i * m : (i + 1) * m].sum() for i in range(1000 // m)]
        assert ratio == pytest.approx(np.mean(np.square(sums)) / m)


def test_errors_below_the_resolution_are_forgiven():
    rng = np.random.default_rng(6)
    slow = 0.4 * np.sin(2 * np.pi * 0.7 * DT * np.arange(16_000))
    e = rng.standard_normal(16_000) + slow
    assert not verdict(e, sigma=1e-6).consistent
    assert verdict(e, sigma=1e-6, quantum=1e-5).consistent


def test_samples_of_a_seen_change_are_left_out():
    e = np.random.default_rng(7).standard_normal(20_000)
    e[9_500:9_900] += 6.0
    change = np.array([[9_999.0, 600.0, 900.0, 400.0]])
    assert not verdict(e).consistent
    assert verdict(e, changes=change).consistent
    ((first, last),) = while_changing(20_000, change)
    assert first <= 9_500 and last >= 9_900 and last - first < 2_000
    # A parameter that hops all the time excuses nothing.
    hopping = np.array([[k, 600.0 + 50 * (-1) ** i, 600.0, 200.0]
                        for i, k in enumerate(range(500, 20_000, 1000))])
    assert not while_changing(20_000, hopping)


# ---- supervision -----------------------------------------------------------------------------


def watch_scores(scores, information, variance=1e-8, value=1.0):
    """Feed block scores; return the block at which a change is seen, and its size."""
    w = new_supervision()
    for k, score in enumerate(scores):
        w[SCORE], w[INFORMATION] = score, information
        delta, told, samples = look(w, value, variance, 1.0)
        if told > 0:
            return k, delta, samples, w
    return None, 0.0, 0, w


def test_no_change_is_seen_where_there_is_none():
    rng = np.random.default_rng(8)
    seen = 0
    for _ in range(50):
        k, *_rest, w = watch_scores(1e3 * rng.standard_normal(400), 1e6)
        seen += k is not None
        assert score_ratio(w) == pytest.approx(1.0, abs=0.35)
        assert honest_factor(w) == 1.0
    assert seen == 0


def test_a_change_is_seen_with_its_size():
    rng = np.random.default_rng(9)
    for change in (0.02, -0.02):
        scores = 1e3 * rng.standard_normal(100)  # information 1e6: sigma of a block 1e-3
        scores[60:] += 1e6 * change
        k, delta, samples, _ = watch_scores(scores, 1e6)
        assert k == 60 and samples == BLOCK
        assert delta == pytest.approx(change, abs=0.004)
    small = 1e3 * rng.standard_normal(400)
    small[100:] += 1e6 * 0.003  # three sigma a block: seen over several
    k, delta, samples, _ = watch_scores(small, 1e6)
    assert 100 < k < 130 and samples > BLOCK
    assert delta == pytest.approx(0.003, abs=0.0015)


def test_noise_that_is_louder_than_assumed_widens_sigma_instead():
    rng = np.random.default_rng(10)
    k, *_rest, w = watch_scores(2.5e3 * rng.standard_normal(100), 1e6)
    assert k is None
    assert honest_factor(w) == pytest.approx(2.5, rel=0.25)


def test_a_frozen_watch_sees_nothing():
    w = new_supervision(frozen=True)
    for _ in range(50):
        w[SCORE], w[INFORMATION] = 1e9, 1e6
        assert look(w, 1.0, 1e-8, 1.0)[1] == 0.0


# ---- status ------------------------------------------------------------------------------------


@given(value=st.floats(), stddev=st.floats(0) | st.just(float("nan")))
def test_status_is_never_a_number_made_of_nothing(value, stddev):
    found = judge_parameter("B", value, stddev, "N·s/m", 500.0, 1000.0)
    assert found.status in ("converged", "not_excited", "diverged")
    assert "\n" not in found.message and found.message
    assert np.isnan(found.value) == (found.status == "diverged")
    if found.status == "converged":
        assert found.stddev <= 0.1 * abs(found.value) and found.stddev <= 500.0


@pytest.mark.parametrize("value, stddev, status", [
    (600.0, 1.0, "converged"), (600.0, 59.0, "converged"), (600.0, 61.0, "not_excited"),
    (6000.0, 501.0, "not_excited"),  # 8 %, but half of the prior's sigma is not yet gained
    (-1.0, 0.1, "diverged"), (-0.2, 0.1, "not_excited"), (0.0, 1.0, "not_excited"),
    (2e5, 1.0, "diverged"), (float("nan"), 1.0, "diverged"), (600.0, float("inf"), "diverged")])
def test_status(value, stddev, status):
    assert judge_parameter("B", value, stddev, "N·s/m", 500.0, 1000.0).status == status


def test_no_data_has_no_number():
    found = no_data("B", "N·s/m", "no pressures")
    assert np.isnan(found.value) and np.isnan(found.stddev)
    assert (found.status, found.message) == ("no_data", "no pressures")


def test_a_status_says_in_units_and_per_cent_what_the_motion_told():
    """Not "5.99998e+08 ± 3e+04 Pa, 7.4 nats gained on the prior"."""
    found = judge_parameter("beta_e", 5.99998e8, 3e4, "Pa", 5e8, 1e9)
    assert found.message == "βe = 600.0 ± 0.2 MPa, identified to ± 0.03 %"
    assert (found.value, found.stddev) == (5.99998e8, 3e4)  # the JSON has every digit
    weak = judge_parameter("B", 540.0, 90.0, "N·s/m", 500.0, 100.0)
    assert weak.status == "not_excited" and weak.message == (
        "too little motion to identify B: 540 ± 90 N·s/m, prior 500 ± 100 N·s/m")
    lost = judge_parameter("beta_e", -5e8, 1e6, "Pa", 5e8, 1e9)
    assert "βe went to −500 MPa, which is not physical" in lost.message


def test_a_damping_that_becomes_negative_dates_the_mismatch_to_what_showed_it():
    e = np.random.default_rng(0).standard_normal(8_000)
    parameter = ParameterEstimate("B", 600.0, 1.0, "N·s/m", "converged")
    changes = np.array([[5_000.0, 600.0, -400.0, 200.0], [5_600.0, -400.0, 600.0, 300.0]])
    found = stage_verdict(ONE, parameter, e, np.ones(len(e)), Window(1e-3, start=20.0), changes)
    assert not found.consistent and found.first_time_s == pytest.approx(24.8)
    assert "no friction drives" in found.message
    assert stage_verdict(ONE, parameter, e, np.ones(len(e)), Window(1e-3), changes[:0]).consistent


def test_what_knows_less_than_the_prior_shows_no_change():
    """A leap of 1e9 priors in the compliance left a covariance that was no longer positive."""
    for information, seen in ((1e-6, False), (1e4, True)):
        w = new_supervision(False)
        w[SCORE], w[INFORMATION] = 1e3 * information**0.5, information
        assert (look(w, 1.0, 1e-3, 4.0)[1] > 0.0) is seen
