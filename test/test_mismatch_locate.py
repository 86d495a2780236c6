"""Where model and recording disagree, and the curve of what is missing."""

import numpy as np
import pytest
from mismatch_tools import fitted
from scipy.linalg import solve_discrete_are

from eha_monitor.balances import places
from eha_monitor.balances.places import after_reversal
from eha_monitor.mismatch.likelihood.along import (
    DOUBLINGS,
    covariance_before,
    gain_of,
    smooth_back,
)
from eha_monitor.mismatch.likelihood.fit import filtered, log_likelihood_of, with_unknowns
from eha_monitor.mismatch.likelihood.gains import CORRELATION, Unknowns, linear_of
from eha_monitor.mismatch.locate.location import (
    larger_model,
    latent_curves,
    location_of,
    parts_of,
    rival_innovations,
    rivals_of,
)
from eha_monitor.mismatch.locate.terms import Missing, missing_terms
from eha_monitor.mismatch.name.starts import limits_of
from eha_monitor.physics import signals as s


def curves_in(case, after):
    return latent_curves(case.experiment, missing_terms(case.experiment, case.before, after))


def curve_of(curves, against, balance="force"):
    return next(c for c in curves if c.against == against and c.balance == balance)


def test_a_state_that_nothing_shows_has_the_covariance_of_a_long_record():
    """A position that stands in its play is in no reading: a random walk of 2^DOUBLINGS steps."""
    a, h = np.diag([1.0, 0.9]), np.array([[0.0, 1.0]])
    q, r = np.array([1e-14, 0.5]), np.array([0.04])
    found = covariance_before(a, h, q, r, np.array([1e-3, 1.0]))
    assert found[0, 0] == pytest.approx(2**DOUBLINGS * 1e-14)
    seen = solve_discrete_are(a[1:, 1:], h[:, 1:].T, np.diag(q[1:]), np.diag(r))
    assert found[1, 1] == pytest.approx(seen[0, 0])


def test_a_model_that_runs_away_has_a_covariance_all_the_same():
    """Steps too long for its damping: Runge-Kutta multiplies the speed by 1e21 in a sample."""
    a = np.array([[1.0, 1e-3, 0.0], [0.0, -1e21, 1e3], [0.0, 0.0, 0.9]])
    h = np.array([[1.0, 0.0, 0.0]])
    found = covariance_before(a, h, np.array([1e-14, 1e-12, 0.5]), np.array([1e-12]),
                              np.array([1e-6, 1e-2, 10.0]))
    assert np.isfinite(found).all() and (np.diag(found) > 0.0).all()
    assert np.isfinite(gain_of(found, h, np.array([1e-12]))[0]).all()


def test_smoother_is_the_least_squares_solution_of_the_whole_record():
    """All states of all samples at once, by the normal equations, no filter in it."""
    rng = np.random.default_rng(2)
    a = np.array([[1.0, 0.1, 0.0], [-0.2, 0.9, 0.1], [0.0, 0.0, 0.8]])
    h = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.3]])
    q, r, n = np.array([1e-3, 2e-2, 0.5]), np.array([0.04, 0.3]), 60
    p = solve_discrete_are(a.T, h.T, np.diag(q), np.diag(r))
    assert covariance_before(a, h, q, r, np.ones(3)) == pytest.approx(p, rel=1e-6)
    z = rng.normal(size=(n, 2)).cumsum(axis=0)

    gain, inverse = gain_of(p, h, r)
    x, states, e = np.zeros(3), np.zeros((n, 3)), np.zeros((n, 2))
    for k in range(n):
        e[k] = z[k] - h @ x
        states[k] = x + gain @ e[k]
        x = a @ states[k]
    c = np.eye(3) - gain @ h
    smooth_back(states, e, a, c, np.ascontiguousarray(h.T @ inverse), c @ p)

    rows, right = [np.zeros((3, 3 * n))], [np.zeros(3)]
    rows[0][:, :3] = np.linalg.inv(np.linalg.cholesky(p))
    for k in range(n):
        row = np.zeros((2, 3 * n))
        row[:, 3 * k : 3 * k + 3] = h / np.sqrt(r)[:, None]
        rows.append(row)
        right.append(z[k] / np.sqrt(r))
        if k + 1 < n:
            row = np.zeros((3, 3 * n))
            row[:, 3 * k : 3 * k + 3] = -a / np.sqrt(q)[:, None]
            row[:, 3 * k + 3 : 3 * k + 6] = np.diag(1 / np.sqrt(q))
            rows.append(row)
            right.append(np.zeros(3))
    wanted = np.linalg.lstsq(np.vstack(rows), np.concatenate(right), rcond=None)[0]
    assert states == pytest.approx(wanted.reshape(n, 3), abs=1e-8)


def test_a_rival_beside_the_filter_is_worth_what_the_whole_filter_says():
    """An unknown force in the linear second pass against the plant run with it."""
    case = fitted("coulomb_friction", motion="rich")
    experiment = case.experiment
    small = limits_of(experiment)[0]
    null = with_unknowns(experiment, case.before, small)
    m = linear_of(experiment, null.theta, null.active, small)
    e, _ = filtered(experiment, experiment.stretches[0], null.theta, null.active, null.gains)
    rival = next(r for r in rivals_of(experiment, m) if r.name == "force")
    a, h, gains = larger_model(m, experiment.used, experiment.dt, rival, 1000.0 * small.force,
                               CORRELATION)
    out = np.full_like(e, np.nan)
    rival_innovations(e, experiment.columns, m.a @ null.gains, a, h, gains, out)
    counted = experiment.stretches[0].counted
    quick = log_likelihood_of(out[counted][:, experiment.columns])
    whole = with_unknowns(experiment, case.before, Unknowns(1000.0 * small.force, small.flow,
                                                            small.speed))
    gain = whole.log_likelihood - null.log_likelihood
    assert gain > 1e4
    assert quick - log_likelihood_of(null.e) == pytest.approx(gain, rel=2e-3)


def test_coulomb_friction_shows_as_forty_newtons_either_way():
    case = fitted("coulomb_friction", motion="rich")
    curves = curves_in(case, case.after)
    assert {c.against for c in curves} == {"time", "velocity", "position",
                                           "pressure_difference", "pump_speed"}
    curve = curve_of(curves, "velocity")
    assert (curve.unit, curve.against_unit) == ("N", "m/s")
    sliding = np.abs(curve.x) > 5e-3
    assert sliding.sum() > 20
    for values in (curve.measured, curve.modelled):
        assert values[sliding] == pytest.approx(40.0 * np.sign(curve.x[sliding]), rel=0.1)
    time = curve_of(curves, "time")
    assert 0.0 <= time.x[0] < 0.3
    assert 23.7 < time.x[-1] <= 24.0
    assert np.corrcoef(time.measured, time.modelled)[0, 1] > 0.99


def test_the_missing_force_turns_when_the_motion_does():
    """A filter alone would be late; the smoothed force lines up with the model to a sample."""
    case = fitted("coulomb_friction", motion="rich")
    term, = missing_terms(case.experiment, case.before, case.after)
    measured, modelled = term.measured[0][500:-500], term.modelled[0]
    scores = {lag: float(np.corrcoef(measured, modelled[500 + lag : len(modelled) - 500 + lag]
                                     )[0, 1]) for lag in range(-5, 6)}
    assert abs(max(scores, key=scores.get)) <= 1


def test_coulomb_friction_is_located_at_the_reversals():
    case = fitted("coulomb_friction", motion="rich")
    for after, named in ((case.after, case.evidence), (None, {})):
        where = location_of(case.experiment, case.before, after or case.before, named)
        assert where.balance["force"] > 0.95
        assert sum(where.balance.values()) == pytest.approx(1.0)
        assert where.regime == "velocity_reversal"
        assert 1 <= len(where.intervals_s) <= 8
        for start, stop in where.intervals_s:
            assert 0.0 <= start < stop <= 24.0
            here = case.recording.get("x")[max(0, int(1e3 * start) - 100) : int(1e3 * stop)]
            v = np.diff(here[::10])
            assert v.min() < 0 < v.max()  # it turns there


@pytest.mark.parametrize("effect,balance", [
    ("quadratic_friction", "force"), ("sticking_place", "force"), ("turbulent_leakage", "flow"),
    ("external_leakage", "flow"), ("pump_ripple", "flow"), ("drive_lag", "drive"),
    ("drive_gain", "drive"), ("position_scale", "sensor"), ("pressure_offset", "sensor"),
])
def test_the_balance_is_found_without_a_name(effect, balance):
    """What is hidden is in the catalogue or not; here no name is given, only the latent rivals."""
    case = fitted(effect, told=False, motion="rich" if "offset" in effect else "short")
    where = location_of(case.experiment, case.before, case.before, {})
    assert max(where.balance, key=where.balance.get) == balance
    assert where.balance[balance] > 0.8


def test_named_effects_share_by_their_evidence_and_sensors_have_a_curve():
    case = fitted("pressure_offset", motion="rich")
    where = location_of(case.experiment, case.before, case.after,
                        {"pressure_offset": 300.0, "coulomb_friction": 100.0})
    assert where.balance == {"force": 0.25, "flow": 0.0, "drive": 0.0, "sensor": 0.75}
    assert where.regime == "always"
    assert where.intervals_s == ((0.0, 24.0),)
    curve = curve_of(curves_in(case, case.after), "velocity",
                     "sensor")
    assert curve.unit == "Pa"
    assert np.median(curve.measured) == pytest.approx(4e4, rel=0.05)
    assert np.median(curve.modelled) == pytest.approx(4e4, rel=0.05)


@pytest.mark.parametrize("effect,unit,against,size", [
    ("drive_lag", "rad/s", "pump_speed", None), ("turbulent_leakage", "m³/s",
                                                "pressure_difference", None),
    ("external_leakage", "m³/s", "position", None),
    ("position_scale", "m", "position", 0.03),
])
def test_measured_follows_modelled_where_the_name_is_right(effect, unit, against, size):
    case = fitted(effect, motion="rich" if effect == "external_leakage" else "short")
    curves = [c for c in curves_in(case, case.after)
              if c.against == against]
    curve, = curves
    assert curve.unit == unit
    scale = np.sqrt(np.mean(curve.modelled**2))
    assert np.sqrt(np.mean((curve.measured - curve.modelled) ** 2)) < 0.25 * scale
    if size:
        assert np.polyfit(curve.x, curve.measured, 1)[0] == pytest.approx(size, rel=0.05)


def test_regime_of_terms_made_by_hand():
    experiment = fitted("coulomb_friction", motion="rich").experiment
    stretch = experiment.stretches[0]
    n = len(stretch)
    t = np.arange(n) * experiment.dt
    track = np.zeros((n, s.N_SIGNALS))
    track[:, s.X], track[:, s.V] = -np.cos(2 * t), 2 * np.sin(2 * t)
    track[:, s.P1] = np.random.default_rng(0).normal(0.0, 1e5, n)

    def regime(values):
        return places.regime_of("force", parts_of(experiment, Missing(
            "force", "N", (track,), (values,))))[0]

    assert regime(np.full(n, 40.0)) == "always"
    assert regime(40.0 * np.sign(track[:, s.V])) == "velocity_reversal"
    assert regime(track[:, s.V] * np.abs(track[:, s.V]) ** 3) == "high_speed"
    assert regime(np.where(track[:, s.X] > 0.97, 50.0, 0.0)) == "near_limit"
    assert regime(np.where(track[:, s.P1] > 1.3e5, 50.0, 0.0)) == "high_pressure"


def test_reversals_and_jitter_at_rest():
    dt = 1e-3
    t = np.arange(4000) * dt
    v = np.sin(2 * np.pi * 0.5 * t)
    v[:600] = 1e-4 * np.random.default_rng(1).normal(size=600)
    mask = after_reversal(v, 1.0, dt)
    assert not mask[:500].any()
    turned = np.flatnonzero(np.diff(mask.astype(int)) > 0) * dt
    assert turned[-3:] == pytest.approx([1.0, 2.0, 3.0], abs=0.02)


def test_without_a_name_every_unknown_has_its_curve():
    case = fitted("sticking_place", told=False)
    curves = curves_in(case, None)
    assert {c.balance for c in curves} == {"force", "flow", "drive"}
    assert all((c.modelled == 0.0).all() for c in curves)
    assert np.abs(curve_of(curves, "position").measured).max() > 10.0
