"""The filter of the diagnosis and its likelihood against independent ones."""

from dataclasses import replace

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from mismatch_tools import nominal_fit
from rig_tools import (
    BETA,
    C_T,
    D_P,
    K_POS,
    MULTISINE,
    V0,
    A,
    B,
    M,
    settings,
    simulated,
    with_channels,
    without,
)
from scipy.linalg import expm, solve_discrete_are
from test_filters_effects import CASES, recording_of

from eha_monitor.mismatch.data.experiment import experiment_of
from eha_monitor.mismatch.data.inputs import cut
from eha_monitor.mismatch.likelihood.fit import (
    covariance_of,
    filtered,
    innovations,
    log_likelihood_of,
    prior_exponent,
    start_of,
    whitener,
    with_unknowns,
)
from eha_monitor.mismatch.likelihood.gains import (
    CORRELATION,
    Unknowns,
    expected_covariance,
    gains_of,
    linear_of,
    smallest_unknowns,
)
from eha_monitor.mismatch.likelihood.innovations import N_FILTERED, riccati
from eha_monitor.mismatch.name.nominal import lack_of
from eha_monitor.mismatch.name.refit import unfitted
from eha_monitor.mismatch.name.starts import expected_likelihood, limits_of, possible
from eha_monitor.mismatch.show.model import robust
from eha_monitor.physics.contributions import circuit_of
from eha_monitor.physics.plant import N_OUTPUTS, Y_OMEGA

MAKEUP, CHARGE, DT = 1e-13, 2e6, 1e-3
UNKNOWNS = Unknowns(3.0, 2e-6, 0.5)
KEPT = [i for i in range(N_FILTERED) if i != Y_OMEGA]  # without a lag the speed is no state


@pytest.fixture(scope="module")
def run():
    return simulated(MULTISINE, 4.0)


@pytest.fixture(scope="module")
def experiment(run):
    return experiment_of([run.recording(1)], settings())


# ---- gains ------------------------------------------------------------------------------------


@given(seed=st.integers(0, 10**6), radius=st.floats(0.3, 0.97), count=st.integers(1, N_OUTPUTS))
@hypothesis_settings(max_examples=30)
def test_gains_end_at_the_algebraic_riccati_equation(seed, radius, count):
    rng = np.random.default_rng(seed)
    a = rng.standard_normal((N_FILTERED, N_FILTERED))
    a *= radius / np.abs(np.linalg.eigvals(a)).max()
    h = rng.standard_normal((N_OUTPUTS, N_FILTERED))
    q, r = rng.uniform(0.1, 1.0, N_FILTERED), rng.uniform(0.1, 1.0, N_OUTPUTS)
    used = np.arange(N_OUTPUTS) < count
    gains = np.zeros((3000, N_FILTERED, N_OUTPUTS))
    last = riccati(a, h, q, r, np.eye(N_FILTERED), used, gains)
    hs = h[used]
    p = solve_discrete_are(a.T, hs.T, np.diag(q), np.diag(r[used]))
    steady = p @ hs.T @ np.linalg.inv(hs @ p @ hs.T + np.diag(r[used]))
    assert last < 3000 and not gains[last - 1][:, ~used].any()
    assert gains[last - 1][:, used] == pytest.approx(steady, rel=1e-4, abs=1e-6)


def linear_plant(b=B, beta=BETA):
    """x', v', p1', p2' with force, flow and speed unknown, 1, x_d and its slope: (10, 10)."""
    stiff, leak = beta / V0, 0.5 * (C_T - MAKEUP)
    a = np.zeros((10, 10))
    x, v, p1, p2, force, flow, speed, one, x_d, slope = range(10)
    a[x, v] = 1.0
    a[v, [v, p1, p2, force]] = -b / M, A / M, -A / M, -1.0 / M
    for p, other, sign in ((p1, p2, 1.0), (p2, p1, -1.0)):
        a[p, [x_d, x, speed]] = sign * D_P * np.array([K_POS, -K_POS, 1.0]) * stiff
        a[p, [v, flow]] = -sign * A * stiff, sign * stiff
        a[p, [p, other]] = (-leak - MAKEUP) * stiff, leak * stiff
        a[p, one] = MAKEUP * CHARGE * stiff
    a[x_d, slope] = 1.0
    return a


def test_linearised_plant_is_the_exponential_of_its_matrix(experiment):
    m = linear_of(experiment, experiment.theta, experiment.active, UNKNOWNS)
    exact = expm(linear_plant() * DT)[:7, :7]
    decay = np.exp(-DT / CORRELATION)
    exact[4:] *= decay
    scale = np.sqrt(m.start[KEPT])
    assert m.a[np.ix_(KEPT, KEPT)] * scale / scale[:, None] == pytest.approx(
        exact * scale / scale[:, None], rel=1e-3, abs=1e-3)
    assert m.q[KEPT[4:]] == pytest.approx(
        np.array([3.0, 2e-6, 0.5]) ** 2 * (1 - decay**2), rel=1e-12)
    h = np.zeros((N_OUTPUTS, N_FILTERED))
    h[[0, 1, 2, 3], [0, 1, 2, 3]] = 1.0
    h[4, [0, 7]] = -K_POS, 1.0
    assert m.h == pytest.approx(h, abs=1e-9 * K_POS)


def test_innovations_are_those_of_an_independent_kalman_filter(run):
    """The nominal plant is linear: filterpy's filter with the exact matrices, from any start."""
    experiment = experiment_of([run.recording(1)], settings(), hold_out=False)
    theta, active = experiment.theta, experiment.active
    stretch, m = experiment.stretches[0], linear_of(experiment, theta, active, UNKNOWNS)
    e, states = filtered(experiment, stretch, theta, active,
                         gains_of(experiment, theta, active, UNKNOWNS), states=True)

    decay = np.exp(-DT / CORRELATION)
    step = expm(linear_plant() * DT)
    step[4:7] *= decay
    used = experiment.columns
    h = np.zeros((N_OUTPUTS, 7))
    h[[0, 2, 3], [0, 2, 3]] = 1.0
    h[4, [0, 6]] = -K_POS, 1.0
    kalman = KalmanFilter(dim_x=7, dim_z=len(used))
    kalman.F, kalman.H = step[:7, :7], h[used]
    kalman.Q, kalman.R = np.diag(m.q[KEPT]), np.diag(experiment.noise[used] ** 2)
    kalman.P = np.diag(m.start[KEPT])
    kalman.x = start_of(experiment, stretch, circuit_of(
        experiment.theta, experiment.active))[KEPT][:, None]
    x_d = stretch.u[:, 0]
    expected, found = np.zeros((1500, len(used))), np.zeros((1500, 7))
    for k in range(1500):
        offset = np.where(used == 4, K_POS * x_d[k], 0.0)
        kalman.update(stretch.z[k, used] - offset)
        expected[k], found[k] = kalman.y[:, 0], kalman.x[:, 0]
        driven = np.array([1.0, x_d[k], (x_d[k + 1] - x_d[k]) / DT])
        kalman.predict()
        kalman.x += step[:7, 7:] @ driven[:, None]
    sigma = experiment.noise[used]
    assert np.abs((e[:1500, used] - expected) / sigma).max() < 2e-2
    assert np.abs((e[500:1500, used] - expected[500:]) / sigma).std() < 5e-3
    spread = np.sqrt(np.diag(kalman.P))
    assert np.abs((states[500:1500][:, KEPT] - found[500:]) / spread).max() < 0.05


def test_free_run_corrects_nothing_and_a_missing_channel_changes_nothing(run, experiment):
    theta, active, stretch = experiment.theta, experiment.active, experiment.stretches[0]
    gains = gains_of(experiment, theta, active, UNKNOWNS)
    e, states = filtered(experiment, stretch, theta, active, gains, states=True,
                         free=np.ones(len(stretch), bool))
    known = replace(stretch, loose=None)  # where the input is not, pressures are taken as read
    alone, same = filtered(experiment, known, theta, active, np.zeros_like(gains), states=True)
    assert np.array_equal(states, same) and np.array_equal(e, alone, equal_nan=True)
    lacking = experiment_of([without(run.recording(1), "p2", "omega")], settings())
    z = experiment.stretches[0].z.copy()
    z[:20, [3, 4]] = np.nan  # there the start would be seen in them
    whole = replace(lacking, stretches=(replace(lacking.stretches[0], z=z),))
    gains = gains_of(lacking, theta, active, UNKNOWNS)
    assert np.array_equal(innovations(lacking, theta, active, gains),
                          innovations(whole, theta, active, gains))


# ---- likelihood -------------------------------------------------------------------------------


def test_an_unknown_course_of_the_demand_is_no_error_of_a_sensor(run):
    """A pressure taken from its sensor is taken with the error that the model gives the sensor."""
    config = settings(effects={"pressure_offset": {"b_1": 2.5e4, "b_2": 0.0}})
    recording = run.recording(1)
    wrong = with_channels(recording, p1=recording.channels["p1"] + 2.5e4)
    ends = []
    for one, known in ((recording, settings()), (wrong, config)):
        built = experiment_of([one], known)
        stretch = replace(built.stretches[0], loose=np.full(len(recording), 0.4))
        gains = gains_of(built, built.theta, built.active, UNKNOWNS)
        ends.append(filtered(built, stretch, built.theta, built.active, gains, True)[1][-1])
    assert ends[1][:4] == pytest.approx(ends[0][:4], rel=1e-3, abs=1e-4)


def test_a_sensor_has_drifted_since_the_recording_began_not_since_the_window():
    """p_s = p + d t: of a window from 2 s on, the model with d leaves what was there without."""
    recording = simulated(MULTISINE, 4.0).recording(1)
    drift = 4e4 * np.arange(len(recording)) * DT
    drifted = with_channels(recording, p1=recording.channels["p1"] + drift)
    left = []
    for one, known in ((recording, settings()),
                       (drifted, settings(effects={"pressure_drift": {"d_1": 4e4, "d_2": 0.0}}))):
        built = experiment_of([one], known)
        window = cut(built.stretches[0], 2000, 4000, DT)
        gains = gains_of(built, built.theta, built.active, UNKNOWNS)
        left.append(filtered(built, window, built.theta, built.active, gains)[0][500:, [0, 2, 3]])
    scale = left[0].std(axis=0)
    np.testing.assert_allclose(left[1] / scale, left[0] / scale, atol=1e-3)


@pytest.mark.parametrize("case", sorted(CASES.keys() - {"none", "stribeck_friction"}))
def test_the_true_model_leaves_a_recording_in_windows_nothing(case):
    """What a filter forgets where a window begins, it would find as missing in every recording.

    A Stribeck drop over a seal that yields by 3 um is more, by the simulator's own 10 steps.
    Without an effect 0.6 to 8 are lacking.
    """
    recording, effects = recording_of(case)
    assert lack_in_windows(recording, effects) < 0.06


@pytest.mark.parametrize("case", ["position_scale", "pressure_drift", "pressure_offset",
                                  "pressure_scale"])
def test_sensors_that_the_config_knows_to_err_drive_a_forced_model_right(case):
    """Nothing but the sensors' force is there: what is lacking is its noise, in every case."""
    channels = ("x", "p1", "p2")
    right = lack_in_windows(*recording_of("none", channels))
    assert lack_in_windows(*recording_of(case, channels)) == pytest.approx(right, abs=0.05)


def test_a_pump_speed_that_is_measured_is_late_already():
    channels = ("x", "omega", "p1", "p2")
    assert lack_in_windows(*recording_of("command_delay", channels)) < 0.06


def lack_in_windows(recording, effects):
    """Return what the true model lacks of a recording in windows of 3 s, log units a sample."""
    built = experiment_of([recording], settings(effects=effects))
    windows = tuple(cut(one, at, at + 3000, DT) for one in built.stretches
                    for at in range(0, len(one), 3000))
    built = replace(built, stretches=windows)
    return lack_of(built, with_unknowns(built, unfitted(built), limits_of(built)[0]))


def test_what_a_record_covers_does_not_grow_with_the_noise():
    """Of 24 000 readings the largest is four deviations of noise beyond any pressure there was."""
    found = []
    for pressure in (10.0, 2e4):
        recording = simulated(MULTISINE, 4.0, noise={"pressure": pressure}).recording(1)
        found.append(experiment_of([recording], settings()).ranges)
    quiet, loud = found
    np.testing.assert_allclose(loud.pressure_difference, quiet.pressure_difference,
                               rtol=0.15, atol=1.5e4)
    np.testing.assert_allclose(loud.lowest_pressure, quiet.lowest_pressure, atol=1.5e4)


def test_a_run_that_went_astray_can_be_whitened():
    """All channels follow one curve: their covariance has rank one but for rounding."""
    curve = np.exp(0.05 * np.arange(400.0))
    e = np.outer(curve, [1e-7, 2e3, -2e3, 0.3])
    w = whitener(covariance_of(e))
    assert np.isfinite(w).all()
    rng = np.random.default_rng(1)
    good = covariance_of(rng.standard_normal((500, 4)) * [1e-6, 2e3, 1e3, 0.1])
    assert whitener(good) @ good @ whitener(good).T == pytest.approx(np.eye(4), abs=1e-9)


@given(seed=st.integers(0, 10**6), n=st.integers(20, 300), scale=st.floats(1e-6, 1e6))
@hypothesis_settings(max_examples=40)
def test_likelihood_is_that_of_gaussians_with_their_own_covariance(seed, n, scale):
    """-(N/2) log det S is the Gaussian log density at its best covariance, constants left out."""
    from scipy.stats import multivariate_normal

    rng = np.random.default_rng(seed)
    e = rng.standard_normal((n, 3)) @ (scale * rng.standard_normal((3, 3)) + 3 * scale * np.eye(3))
    s = e.T @ e / n
    density = multivariate_normal(np.zeros(3), s, allow_singular=True).logpdf(e).sum()
    constants = -0.5 * n * 3 * (np.log(2 * np.pi) + 1.0)
    assert log_likelihood_of(e) == pytest.approx(density - constants, rel=1e-6, abs=1e-4)


def test_likelihood_counts_a_slow_channel_as_often_as_it_was_measured():
    rng = np.random.default_rng(0)
    e = rng.standard_normal((100000, 2)) * [2.0, 5.0]
    e[np.arange(100000) % 4 > 0, 1] = np.nan
    expected = -100000 * np.log(2.0) - 25000 * np.log(5.0)
    assert log_likelihood_of(e) == pytest.approx(expected, rel=3e-3)
    assert log_likelihood_of(np.zeros((10, 2))) == -np.inf
    assert log_likelihood_of(np.full((10, 1), 1e30)) == -np.inf


# ---- fit --------------------------------------------------------------------------------------


@pytest.mark.slow  # a statistic of 14 fits; that each is a maximum is tested below
def test_fit_is_unbiased_and_its_deviation_is_the_scatter_over_seeds(run):
    fits = [nominal_fit(experiment_of([run.recording(seed)], settings(
        stage_one={"prior": 900.0}, stage_two={"prior": 9e8}))) for seed in range(14)]
    for name, truth in (("B", B), ("beta_e", BETA)):
        values = np.array([fit.value(name) for fit in fits])
        stddev = np.array([fit.stddev(name) for fit in fits])
        assert values == pytest.approx(truth, rel=0.05)
        z = (values - truth) / stddev
        assert 0.25 < np.mean(z**2) < 2.6, name  # chi squared of 14: 99.9 %
        assert abs(z.mean()) < 3.3 / np.sqrt(len(z)), name
    assert all(fit.converged for fit in fits)


def test_refined_likelihood_is_a_maximum(experiment):
    fit = nominal_fit(experiment)
    for f in fit.free:
        for sign in (-1, 1):
            theta = fit.theta.copy()
            theta[f.place] = f.outward(f.inward(theta[f.place]) + sign * 3 * np.sqrt(
                fit.covariance[fit.free.index(f), fit.free.index(f)]))
            e = innovations(experiment, theta, fit.active, fit.gains)
            reached = log_likelihood_of(e) + prior_exponent(fit.free, theta)
            assert reached < fit.log_likelihood + 0.05, f.name


def test_unknowns_never_spoil_a_clean_record(experiment):
    """With none the model is right already: with large ones the likelihood is lower."""
    fit = nominal_fit(experiment)
    large = with_unknowns(experiment, fit, Unknowns(50.0, 1e-5, 5.0))
    assert large.log_likelihood < fit.log_likelihood


@pytest.mark.parametrize("factor", [1.0, 300.0])
def test_a_filter_expects_the_innovations_that_it_has(experiment, factor):
    fit = nominal_fit(experiment)
    small = smallest_unknowns(experiment)
    unknowns = replace(small, force=factor * small.force)
    fit = with_unknowns(experiment, fit, unknowns)
    expected = np.diag(expected_covariance(experiment, fit.theta, fit.active, unknowns,
                                           fit.gains))
    had = np.diag(fit.s) / expected
    if factor == 1.0:
        assert had == pytest.approx(1.0, abs=0.1)
    else:  # it is prepared for an unknown force that is not there
        assert had.max() < 1.02 and had.min() < 0.9


def test_expected_likelihood_is_that_of_the_sensors_noise(experiment):
    """A draw of pure sensor noise has it on average."""
    fit = nominal_fit(experiment)
    rng = np.random.default_rng(0)
    e = rng.standard_normal(fit.e.shape) * experiment.noise[experiment.columns]
    assert expected_likelihood(experiment, fit) == pytest.approx(
        log_likelihood_of(e), abs=5 * np.sqrt(e.size))


# ---- how sure ---------------------------------------------------------------------------------


def test_robust_deviation_is_never_the_smaller_one(experiment):
    fit = nominal_fit(experiment)
    safe = robust(experiment, fit)
    ratio = np.sqrt(np.diag(safe.covariance) / np.diag(fit.covariance))
    assert (ratio > 0.97).all()
    # The numbers of the rig known exactly, nothing but the parts' scatter is left.
    known = replace(experiment, settings=exactly(experiment.settings))
    ratio = np.sqrt(np.diag(robust(known, fit).covariance) / np.diag(fit.covariance))
    assert (ratio > 0.97).all() and ratio[0] < 2.0 and ratio[1] < 2.0


def exactly(settings):
    """Return a config whose numbers are known to a millionth, factors likewise."""
    rig = settings.rig
    return settings.model_copy(update={"rig": rig.model_copy(update={
        "tolerance": rig.tolerance.model_copy(update={
            key: 1.0 + 1e-6 if key in ("leakage", "makeup_conductance") else 1e-6
            for key in type(rig.tolerance).model_fields})})})


def test_b_is_no_better_known_than_the_area(experiment):
    """B goes as the force: half a per cent of the piston's area is half a per cent of B."""
    fit = nominal_fit(experiment)
    with_area, without = (robust(one, fit) for one in (experiment, replace(
        experiment, settings=exactly(experiment.settings))))
    added = np.sqrt(with_area.stddev("B") ** 2 - without.stddev("B") ** 2) / fit.value("B")
    assert added == pytest.approx(0.005, rel=0.3)


def test_robust_deviation_grows_where_the_model_is_wrong():
    rubbing = simulated(MULTISINE, 4.0, effects={"coulomb_friction": {"F_c": 20.0}})
    experiment = experiment_of([rubbing.recording(0)], settings())
    fit = nominal_fit(experiment)
    safe = robust(experiment, fit)
    assert safe.stddev("B") > 1.5 * fit.stddev("B")
    assert np.array_equal(safe.theta, fit.theta)
    assert np.linalg.eigvalsh(safe.covariance / np.sqrt(np.outer(
        np.diag(safe.covariance), np.diag(safe.covariance)))).min() > 0


def test_a_force_that_is_told_late_is_read_as_much_later(run):
    """p_s(k) = p(k - 3): with T = 3 dt the filter meets the force that it met before."""
    whole = without(run.recording(1), "omega", "x_d")
    late = with_channels(whole, p1=np.roll(whole.channels["p1"], 3),
                         p2=np.roll(whole.channels["p2"], 3))

    def errors(recording, **effects):
        experiment = experiment_of([recording], settings(effects=effects))
        theta, active = experiment.theta, experiment.active
        gains = gains_of(experiment, experiment_of([whole], settings()).theta, active,
                         smallest_unknowns(experiment))
        return innovations(experiment, theta, active, gains)[200:-50, 0]

    before, lagging = errors(whole), errors(late)
    assert (lagging - before).std() > 0.5 * before.std()
    found = errors(late, pressure_delay={"T": 3 * DT})
    np.testing.assert_allclose(found, before, atol=1e-3 * before.std())
    both = errors(whole, pressure_delay={"T": 2.4 * DT}, position_delay={"T": 2.4 * DT})
    np.testing.assert_allclose(both, before, atol=1e-9 * before.std())


def test_one_of_two_sensors_may_be_late_but_no_force_that_a_drive_tells(run):
    """On EMPS a position that was late beside the drive's force bent friction and damping."""
    by_pressures = without(run.recording(1), "omega", "x_d")
    force = settings().rig.area_1 * (by_pressures.channels["p1"] - by_pressures.channels["p2"])
    by_force = with_channels(by_pressures, p1=None, p2=None, force=force)
    for recording, able in ((by_pressures, True), (by_force, False)):
        experiment = experiment_of([recording], settings())
        assert possible("position_delay", experiment) is able
        assert possible("coulomb_friction", experiment)
