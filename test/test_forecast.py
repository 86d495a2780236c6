"""The time to a limit: the filter bank and the passage against independent oracles, then what is
said of growth, rest, repairs and of series that are too short or odd.
"""

import math

import numpy as np
import pytest
from scipy.stats import invgauss, multivariate_normal
from test_archive_trend import DAY, START, row

from eha_monitor.archive import history as forecast
from eha_monitor.archive.history import (
    BEYOND,
    NO_LIMIT,
    NOT_YET,
    STEADY,
    TOLD,
    Bank,
    Series,
    Tracker,
    clock_of,
    first_passage,
    history,
    outlook,
    z_of,
)
from eha_monitor.reports.archive_report import history_block, horizon, outlook_words
from eha_monitor.settings import settings_from_tree

TIMES = START + DAY * np.arange(60.0)


def growing(onset=0.0, tau=100.0, shape=1.0, diffusion=0.1, var_g=0.04, way=1.0, level=0.0,
            var_l=0.49):
    """Return a bank with one hypothesis that grows."""
    return Bank.of(1, grows=True, grown=True, level=level, gain=1.0, var_l=var_l, var_g=var_g,
                   onset=onset, tau=tau, shape=shape, diffusion=diffusion, way=way, noise=2)


@pytest.mark.parametrize("shape", [0.5, 1.0, 3.0, -3.5])
def test_evidence_is_that_of_the_joint_normal_distribution(shape, monkeypatch):
    """One hypothesis over ten values: the filter against the whole covariance at once."""
    monkeypatch.setattr(forecast, "OUTLIER", 1e-200)
    rng = np.random.default_rng(4)
    tracker = Tracker(unit=1.0, scale=0.02, bank=growing(shape=shape))
    times = np.sort(rng.uniform(1.0, 90.0, 10))
    values = rng.normal(0.3, 0.2, 10)
    for time, value in zip(times, values, strict=True):
        tracker._advance(time)
        tracker._correct(value, 0.01)
    z = times / 100.0
    clock = z**shape if shape > 0 else np.expm1(-shape * z) / math.expm1(-shape)
    noise = (0.02 * forecast.NOISES[2]) ** 2 + 0.01**2
    covariance = (0.49 + 0.04 * np.outer(clock, clock) + 0.01 * np.minimum.outer(clock, clock)
                  + noise * np.eye(10))
    whole = multivariate_normal(clock, covariance).logpdf(values) + 5.0 * math.log(2 * math.pi)
    assert tracker.bank.weight[0] == pytest.approx(whole, rel=1e-9)


def test_an_outlier_moves_a_level_less_than_any_value_near_it():
    tracker = Tracker(unit=1.0, scale=0.02, bank=growing(level=0.3, var_l=1e-4))
    tracker._advance(1.0)
    tracker._correct(0.9, 0.0)
    assert abs(tracker.bank.level[0] - 0.31) < 0.01


@pytest.mark.parametrize("shape", forecast.SHAPES)
def test_transformed_time_goes_back(shape):
    z = np.array([0.0, 0.2, 1.0, 1.7])
    assert z_of(clock_of(z, np.full(4, shape)), np.full(4, shape)) == pytest.approx(z)
    assert clock_of(np.array([1.0]), np.array([shape]))[0] == pytest.approx(1.0)


def test_first_passage_is_inverse_gaussian_and_that_of_simulated_walks():
    """A known level and drift: against scipy's distribution, and against walks step by step."""
    diffusion, way, tau = 0.3, 0.6, 50.0
    bank = growing(tau=tau, diffusion=diffusion, var_g=0.0, level=0.4, var_l=0.0)
    found = first_passage(Tracker(1.0, 0.02, bank=bank, time=0.0), np.ones(1),
                          np.random.default_rng(1))
    exact = invgauss(mu=diffusion**2 / way, scale=(way / diffusion) ** 2)
    rng = np.random.default_rng(2)
    step = 1e-3
    walks = np.cumsum(rng.normal(step, diffusion * math.sqrt(step), (400, 6000)), axis=1)
    passed = np.where((walks >= way).any(axis=1), (walks >= way).argmax(axis=1) * step, np.inf)
    for share in (0.05, 0.25, 0.5, 0.75, 0.95):
        assert np.quantile(found, share) == pytest.approx(tau * exact.ppf(share), rel=0.06)
        assert np.quantile(passed, share) == pytest.approx(exact.ppf(share), rel=0.2)


def told(values, limit=1.0, above=True, stddev=0.01, times=None):
    series = Series(limit, above)
    for time, value in zip(TIMES if times is None else times, values, strict=False):
        series.add(float(time), float(value), stddev)
    return series.forecast()


@pytest.mark.parametrize("power", [1.0, 2.0])
def test_growth_is_told_with_an_interval_that_holds_the_end(power):
    rng = np.random.default_rng(8)
    values = 20.0 + 80.0 * (np.arange(60) / 80.0) ** power + rng.normal(0, 1.0, 60)
    found = told(values, 100.0, stddev=0.5)
    assert found.status == TOLD
    assert found.early < START + 80.0 * DAY < found.late
    assert found.late - found.early < 60.0 * DAY
    falls = told(-values, -100.0, above=False, stddev=0.5)
    assert (falls.early, falls.late) == (found.early, found.late)  # the same, mirrored


def test_a_constant_value_has_no_growth_whatever_its_noise():
    rng = np.random.default_rng(9)
    for noise in (0.0, 0.001, 0.05):
        assert told(0.2 + noise * rng.standard_normal(60)).status in (STEADY, NOT_YET)
    wild = 0.2 + 0.01 * rng.standard_normal(60)
    wild[[10, 30, 50]] += 0.5
    assert told(wild).status in (STEADY, NOT_YET)


def test_a_repair_is_a_step_and_the_trend_starts_anew_there():
    rng = np.random.default_rng(10)
    values = np.concatenate([0.1 + 0.02 * np.arange(35), 0.1 + 0.02 * np.arange(25)])
    seen = values + 0.01 * rng.standard_normal(60)
    found = told(seen)
    assert found.jumps == (TIMES[35],)
    assert found.status == TOLD
    assert found.early < TIMES[35] + 45.0 * DAY < found.late
    rows = [row(day, value, 0.01) for day, value in enumerate(seen)]
    line = history(rows, "B", "estimate", "now", limits(high_error=1.0)).line
    assert line.count == 25
    assert line.slope * DAY == pytest.approx(0.02, rel=0.05)


def test_what_cannot_be_told_is_not_told():
    assert told([0.1, 0.2, 0.3]).status == NOT_YET
    beyond = told(np.linspace(0.2, 1.2, 60))
    assert beyond.status == BEYOND
    assert told(np.full(60, 1.5)).status == BEYOND  # it began there
    assert told(np.full(60, 0.3), stddev=0.0).status in (STEADY, NOT_YET)
    assert told(np.zeros(60)).status in (STEADY, NOT_YET)
    assert told(np.linspace(0.2, 0.5, 60), times=np.full(60, START)).status != ""  # one moment


def test_without_a_limit_steps_alone_are_looked_for():
    rng = np.random.default_rng(11)
    values = np.where(np.arange(60) < 30, 5.0, 3.0) + 0.05 * rng.standard_normal(60)
    found = outlook(TIMES, values, np.full(60, 0.05), (None, None))
    assert [one.status for one in found.forecasts] == [NO_LIMIT]
    assert found.jumps == (TIMES[30],)
    assert outlook(np.empty(0), np.empty(0), np.empty(0), (None, 1.0)).forecasts[0].status == (
        NOT_YET)
    broken = outlook(TIMES, np.where(np.arange(60) == 3, np.nan, values), np.full(60, np.nan),
                     (None, 9.0))
    assert broken.forecasts[0].status in (STEADY, NOT_YET)


def limits(**thresholds):
    none = dict.fromkeys(("low_error", "low_warn", "high_warn", "high_error"))
    return settings_from_tree({"thresholds": {"viscous_damping": none | thresholds},
                               "health": {"leakage_limit": "300 mL/min"}}, "test")


def test_words_and_picture_say_when():
    rng = np.random.default_rng(12)
    rows = [row(day, 600.0, leakage_mL_min=40.0 + 3.0 * day + rng.normal(0, 2),
                leakage_mL_min_noise=1.0) for day in range(60)]
    settings = limits()
    found = history(rows, "leakage", "estimate", "now", settings)
    words = outlook_words(found)
    assert "reaches 300 mL/min between 20" in words
    assert "90 % interval" in words
    end = START + (300.0 - 40.0) / 3.0 * DAY
    assert found.outlook.forecasts[0].early < end < found.outlook.forecasts[0].late
    assert found.time[-1] < horizon(found) <= found.time[-1] + 60.0 * DAY
    block = history_block(found, settings)
    assert block.title == "Internal leakage"
    assert "reaches 300 mL/min" in block.pictures[0].alt
    quiet = history(rows[:5], "leakage", "estimate", "now", settings)
    assert "cannot be predicted yet" in outlook_words(quiet)
    steady = history(rows, "B", "estimate", "now", limits(high_error=1500.0))
    assert "no growth" in outlook_words(steady)
