"""The first view of every recording: ten lines of least squares, against known truth."""


import numpy as np
import pytest
from machine_tools import stranger, stranger_settings
from rig_tools import real
from scipy.optimize import lsq_linear

from eha_monitor.balances.baseline import baseline
from eha_monitor.balances.least_squares import independent, inverse_of, signed_solution
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings import load_settings


@pytest.mark.parametrize("seed", range(5))
def test_signed_least_squares_agree_with_scipy(seed):
    rng = np.random.default_rng(seed)
    columns = rng.standard_normal((40, 7)) @ rng.standard_normal((7, 7))
    y = rng.standard_normal(40)
    signs = rng.integers(-1, 2, 7)
    expected = lsq_linear(columns, y, (np.where(signs > 0, 0.0, -np.inf),
                                       np.where(signs < 0, 0.0, np.inf)), tol=1e-13).x
    found = signed_solution(columns.T @ columns, columns.T @ y, signs)
    np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())


def test_a_direction_without_data_is_not_determined():
    one = np.ones(30)
    columns = np.column_stack([one, one, np.arange(30.0)])
    variance = np.diag(inverse_of(columns.T @ columns))
    assert np.isinf(variance[:2]).all() and np.isfinite(variance[2])


def test_samples_that_count_as_one_are_those_of_the_autoregression():
    rng, a = np.random.default_rng(3), 0.8
    r = np.zeros(40_000)
    for k in range(1, len(r)):
        r[k] = a * r[k - 1] + rng.standard_normal()
    assert independent(r) == pytest.approx((1 + a) / (1 - a), rel=0.15)
    assert independent(rng.standard_normal(40_000)) == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("trouble", [{}, {"late": 0.004}, {"dead": True}, {"stop": True}], ids=str)
def test_a_strangers_rig(trouble, tmp_path):
    settings = stranger_settings(tmp_path)
    for seed in (0, 1, 2):
        force = baseline(stranger(seed, **trouble), settings).force
        assert force["F_0"].value == pytest.approx(338.0, abs=4.0)
        assert 180.0 <= force["F_c"].value <= 195.0  # Coulomb, and a little of the Stribeck rise
        assert 1200.0 <= force["B"].value <= 1400.0  # it falls from 1500 to 1275
        assert force.unseen_share < 0.06


def test_deviations_hold_where_the_law_is_exact(tmp_path):
    settings, z = stranger_settings(tmp_path), []
    for seed in range(12):
        force = baseline(stranger(seed, rise=0.0, damping=(1500.0, 1500.0)), settings).force
        z += [(force[name].value - truth) / force[name].stddev
              for name, truth in (("B", 1500.0), ("F_c", 180.0), ("F_0", 338.0))]
    assert np.mean(np.abs(z) < 2.0) >= 0.85


def test_one_direction_does_not_tell_load_from_friction(tmp_path):
    t = np.arange(0.0, 6.0, 1e-3)
    recording = Recording(1e-3, {"x": 0.01 * t + 0.002 * np.sin(t) * t / 6,
                                 "force": np.full(len(t), 50.0) + 1e3 * (0.01 + 0.002 * t / 6)})
    force = baseline(recording, stranger_settings(tmp_path)).force
    assert not force["F_c"].determined and not force["F_0"].determined


def test_flow_of_a_pump(tmp_path):
    rng = np.random.default_rng(1)
    t = np.arange(0.0, 20.0, 1e-3)
    v = 0.05 * np.sin(2.0 * t) + 0.02 * np.sin(7.0 * t)
    x = np.cumsum(v) * 1e-3
    difference = 1.5e6 * np.tanh(v / 1e-3) + 2e6 * np.sin(0.6 * t)
    area, pump, leak, compliance = 5e-4, 1.7e-7, 3e-12, 6e-14
    omega = (area * v + leak * difference + compliance * 0.5 * np.gradient(difference, t)) / pump
    recording = Recording(1e-3, {
        "x": x + 1e-6 * rng.standard_normal(len(t)), "omega": omega,
        "p1": 2e6 + 0.5 * difference + 500 * rng.standard_normal(len(t)),
        "p2": 2e6 - 0.5 * difference + 500 * rng.standard_normal(len(t))})
    path = tmp_path / "pump.yaml"
    path.write_text("/**:\n  ros__parameters:\n    rig: {area_1: 5.0e-4, area_2: 5.0e-4}\n")
    flow = baseline(recording, load_settings(path)).flow
    for name, truth in (("D_p", pump), ("C_L", leak), ("C_h", compliance)):
        assert flow[name].value == pytest.approx(truth, rel=0.02)


def test_what_cannot_be_compared_is_said(tmp_path):
    rest = Recording(1e-3, {"x": np.zeros(5000), "force": np.ones(5000)}, source="rest")
    found = baseline(rest, stranger_settings(tmp_path))
    assert found.force is None and "motion" in found.missing["force"]
    nothing = baseline(Recording(1e-3, {"x": np.zeros(5000)}), stranger_settings(tmp_path))
    assert "force" in nothing.missing["force"]
    assert nothing.to_dict()["force"] is None


def test_screw_drive_agrees_with_the_published_friction():
    (recording,), settings = real("emps", "emps/DATA_EMPS.mat")
    force = baseline(recording, settings).force
    for name, published in (("B", 203.5), ("F_c", 20.39), ("M", 95.11)):
        assert abs(force[name].value - published) < 2.0 * force[name].stddev
        assert force[name].value == pytest.approx(published, rel=0.08)


def test_pump_of_the_real_actuator_on_two_days():
    files = [f"ivliev_eha_days/day_{day}_load_3_amplitude_4.csv.gz" for day in (18, 21)]
    recordings, settings = real("ivliev_eha", *files)
    for recording in recordings:  # 1.33 cm³ a revolution: design/one_machine.md
        assert baseline(recording, settings).flow["D_p"].value == pytest.approx(2.12e-7, rel=0.02)
