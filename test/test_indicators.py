"""Indicators of health: their laws against closed forms, the plant and published values, their ±
against Monte Carlo, and what is said where something is missing.
"""

import json
import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from test_reports import Page

from eha_monitor.cli import main
from eha_monitor.errors import InputError
from eha_monitor.estimation.pipeline import estimate
from eha_monitor.indicators.assemble import Evidence, evidence, evidence_of_estimate, indicators
from eha_monitor.indicators.indicator import (
    AVAILABLE,
    NAMES,
    Indicator,
    limits_of_indicator,
    passed,
    propagated,
)
from eha_monitor.indicators.laws import (
    SHEARED,
    dry_friction,
    free_air,
    leakage_flow,
    moved,
    viscosity_ratio,
    volumetric_efficiency,
    walther,
)
from eha_monitor.live.diagnosing import comparison_findings
from eha_monitor.mismatch.diagnosis import (
    Change,
    Diagnosis,
    Fitted,
    Location,
    NamedEffect,
    Value,
)
from eha_monitor.physics.balances import rates
from eha_monitor.physics.effects.oil import compliance
from eha_monitor.physics.parameters import theta_of
from eha_monitor.physics.signals import N_CONTRIBUTIONS
from eha_monitor.physics.simulator import Simulator
from eha_monitor.recordings.recording import Recording
from eha_monitor.reports.page import FirstScreen, with_limits
from eha_monitor.settings import Settings, settings_from_tree

ROOT = Path(__file__).parents[1]
RATED = {"rated_pressure": 14e6, "rated_speed": 300.0, "air_free_modulus": 1.5e9}


def settings_with(health: dict | None = None, **sections) -> Settings:
    return settings_from_tree({"health": RATED if health is None else health, **sections}, "test")


def evidence_of(values: dict, stddevs: dict | None = None, **more) -> Evidence:
    spread = [(stddevs or {}).get(name, 0.0) for name in values]
    return Evidence(values, np.diag(np.square(spread)), **more)


def of(found: Evidence, settings: Settings, name: str):
    return next(one for one in indicators(found, settings) if one.name == name)


# ---- the oil ------------------------------------------------------------------------------------

def test_viscosity_goes_through_the_data_sheet_and_published_points():
    assert walther(46.0, 6.8, 40.0) == pytest.approx(46.0)
    assert walther(46.0, 6.8, 100.0) == pytest.approx(6.8)
    # A published worked example of ASTM D341: 32 at 40 °C and 5.4 at 100 °C is 8.5 at 80 °C.
    assert walther(32.0, 5.4, 80.0) == pytest.approx(8.5, abs=0.05)
    # Read off a maker's chart, so to a tenth: ISO VG 46 has 80 at 30 °C and 12 at 75 °C.
    assert walther(46.0, 6.8, 30.0) == pytest.approx(80.0, rel=0.1)
    assert walther(46.0, 6.8, 75.0) == pytest.approx(12.0, rel=0.15)


def test_viscosity_ratio_is_that_of_the_law_that_the_config_gives():
    assert viscosity_ratio(60.0, 40.0, 0.03) == pytest.approx(math.exp(0.6))
    ratio = viscosity_ratio(100.0, 40.0, 0.03, 46.0, 6.8)
    assert ratio == pytest.approx(46.0 / 6.8 / (1 - 7e-4 * 60))  # the density falls as well
    assert viscosity_ratio(40.0, 100.0, 0.03, 46.0, 6.8) == pytest.approx(1 / ratio)
    assert math.isfinite(viscosity_ratio(1e6, 40.0, 0.03, 46.0, 6.8))


# ---- the laws -----------------------------------------------------------------------------------

def test_leakage_is_the_flow_with_which_the_plant_stands_still():
    """The plant's own balances: with the rod blocked and that flow, no pressure changes."""
    settings = Settings()
    theta, _ = theta_of(settings.rig, {})
    pressure = 7e6
    flow = leakage_flow({"leakage": settings.rig.leakage}, pressure)
    middle = settings.rig.charge_pressure
    _, up, down = rates(0.0, middle + pressure / 2, middle - pressure / 2,
                        flow / settings.rig.pump_displacement, 0.0, theta,
                        np.zeros(N_CONTRIBUTIONS))
    _, alone, _ = rates(0.0, middle + pressure / 2, middle - pressure / 2, 0.0, 0.0, theta,
                        np.zeros(N_CONTRIBUTIONS))
    assert abs(up) < 1e-9 * abs(alone)
    assert abs(down) < 1e-9 * abs(alone)


def test_leakage_of_every_kind_adds_up_and_only_the_laminar_part_has_viscosity():
    found = {"leakage": 4e-13, "cross_port_leakage.L": 3e-13, "turbulent_leakage.c": 2e-9,
             "turbulent_leakage.dp_0": 1e4, "leakage_offset.Q_0": 1e-7,
             "leakage_offset.dp_e": 1e4}
    assert leakage_flow(found, 9e6, 0.5) == pytest.approx(
        0.5 * 5e-13 * 9e6 + 2e-9 * 3e3 + 1e-7, rel=1e-6)


def test_efficiency_is_one_less_what_is_lost():
    found = {"leakage": 4e-13, "pump_flow_gain.k": -0.02, "pump_volumetric_loss.k": 2e-9}
    assert volumetric_efficiency(found, 2e-7, 300.0, 1e7) == pytest.approx(
        0.98 * 0.98 - 2e-13 * 1e7 / 6e-5)


def test_air_is_that_of_the_mixture():
    """Isothermal air at one pressure: Wood's mixture in closed form; and the plant's own law."""
    p, air_free, alpha = 2e6, 1.5e9, 0.01
    wood = 1.0 / (1 / air_free + alpha * 101325.0 / p**2)
    assert free_air(wood, air_free, 1.0, np.array([p])) == pytest.approx(alpha)
    spread = np.array([1e6, 2e6, 4e6])
    softer = 1 / air_free + np.mean([compliance(one, alpha, 1.3) for one in spread])
    assert free_air(1 / softer, air_free, 1.3, spread) == pytest.approx(alpha)
    # Compressed to ten atmospheres the same air fills a tenth (isothermal) of the volume.
    assert moved(0.05, 1013250.0, 1.0) == pytest.approx(0.005)


def test_friction_is_that_of_the_worse_direction_at_speed():
    assert dry_friction({"stribeck_friction.F_c": 30.0, "stribeck_friction.F_d": 12.0}, 0) == 30
    assert dry_friction({"asymmetric_friction.F_c": 30.0, "asymmetric_friction.dF": -5.0}, 0) == 35
    assert dry_friction({"pressure_friction.mu": 1e-5}, 4e6) == pytest.approx(40.0)


# ---- their uncertainty --------------------------------------------------------------------------

def test_standard_deviations_are_those_of_monte_carlo():
    """Each law with each of its uncertain numbers drawn; correlated ones together."""
    rng = np.random.default_rng(5)
    settings = settings_with({**RATED, "oil_temperature": 52.0}, viscosity={
        "grade": 46, "at_100": 6.8})
    values = {"B": 600.0, "beta_e": 4e8, "leakage": 5e-13, "cross_port_leakage.L": 2e-12}
    spread = np.array([5.0, 6e6, 2e-13, 1.5e-13])
    correlation = np.eye(4)
    correlation[2, 3] = correlation[3, 2] = -0.8
    covariance = correlation * np.outer(spread, spread)
    pressures = rng.uniform(1e6, 4e6, 60)
    found = Evidence(values, covariance, pressures=pressures, temperature=52.0)
    told = {one.name: one for one in indicators(found, settings)}
    drawn = dict(zip(values, rng.multivariate_normal(list(values.values()), covariance, 20_000).T,
                     strict=True))
    warmth = rng.normal(52.0, 2.0, 20_000)
    ratio = np.array([viscosity_ratio(one, 40.0, 0.03, 46.0, 6.8) for one in warmth])
    laminar = 0.5 * drawn["leakage"] + drawn["cross_port_leakage.L"]
    flow = laminar * 14e6 / ratio
    oil = rng.normal(1.5e9, 1.5e8, 20_000)
    exponent = rng.uniform(1.0, 1.4, 20_000)
    factor = np.array([free_air(1e9, 2e9, n, pressures) for n in exponent]) / (1 / 1e9 - 1 / 2e9)
    sheared = rng.normal(1.0, SHEARED, 20_000)
    samples = {"leakage": 6e7 * flow, "damping": drawn["B"] * ratio**sheared,
               "pump_efficiency": 100 * (1 - flow / (settings.rig.pump_displacement * 300.0)),
               "free_air": 100 * factor * (1 / drawn["beta_e"] - 1 / oil)}
    for name, sample in samples.items():
        assert told[name].status == "available", name
        assert told[name].stddev == pytest.approx(np.std(sample), rel=0.08), name
        assert told[name].value == pytest.approx(np.mean(sample), rel=0.03), name
    # What all recordings share is no noise from one to the next: the modulus, the exponent.
    noise = np.std(100 * np.median(factor) * (1 / drawn["beta_e"] - 1 / 1.5e9))
    assert told["free_air"].noise == pytest.approx(noise, rel=0.1)
    assert told["leakage"].noise == told["leakage"].stddev


def test_propagation_is_exact_for_what_is_linear():
    covariance = np.array([[4.0, 1.0], [1.0, 9.0]])
    value, stddev = propagated(lambda v: 2 * v["a"] - v["b"], {"a": 1.0, "b": 5.0}, covariance)
    assert value == -3.0
    assert stddev == pytest.approx(math.sqrt(16 - 4 + 9))


# ---- what is missing ----------------------------------------------------------------------------

def test_a_missing_key_is_named_and_nothing_is_guessed():
    found = evidence_of({"B": 600.0, "beta_e": 4e8, "leakage": 5e-13}, {"B": 1.0})
    told = {one.name: one for one in indicators(found, Settings())}
    assert list(told) == list(NAMES)
    assert told["leakage"].missing == ("health.rated_pressure",)
    assert told["pump_efficiency"].missing == ("health.rated_pressure", "health.rated_speed")
    assert told["free_air"].missing == ("health.air_free_modulus",)
    assert all(told[name].tree(Settings())["value"] is None for name in ("leakage", "free_air"))
    assert told["damping"].status == "available"
    assert "unknown temperature" in told["damping"].message


def test_air_cannot_be_told_without_pressure_or_above_the_air_free_modulus():
    settings = settings_with()
    no_pressure = of(evidence_of({"beta_e": 4e8}), settings, "free_air")
    assert (no_pressure.status, no_pressure.shown) == ("cannot_be_told", "—")
    assert "p1 and p2" in no_pressure.message
    stiff = of(evidence_of({"beta_e": 1.6e9}, {"beta_e": 1e6}, pressures=np.array([2e6])),
               settings, "free_air")
    assert stiff.status == "cannot_be_told"
    assert "not clearly below" in stiff.message
    assert stiff.tree(settings)["value"] is None
    assert stiff.tree(settings)["below"] > 0


def test_friction_is_told_by_a_diagnosis_only_and_none_is_no_zero():
    settings = settings_with()
    assert "diagnose" in of(evidence_of({}), settings, "friction").message
    none = of(evidence_of({}, diagnosed=True, channels=("x",)), settings, "friction")
    assert (none.status, none.tree(settings)["value"]) == ("none_named", None)
    assumed = of(evidence_of({}, diagnosed=True, assumed={"coulomb_friction": {"F_c": 50.0}}),
                 settings, "friction")
    assert "not measured" in assumed.message
    lost = of(evidence_of({}, diagnosed=True, settled=False, channels=("x",)), settings,
              "friction")
    assert "does not fit" in lost.message
    share = of(evidence_of({"coulomb_friction.F_c": 70.7}, {"coulomb_friction.F_c": 7.07},
                           diagnosed=True), settings, "friction_share")
    assert share.value == pytest.approx(1.0)  # of 14 MPa times 5.05 cm²
    assert share.stddev == pytest.approx(0.1)


def test_a_diagnosis_gives_its_joint_covariance():
    """C_T/2 and L make one conductance: what is known of the sum is what counts."""
    from eha_monitor.indicators.assemble import evidence_of_diagnosis

    leak, more = 5e-13, 2e-12
    covariance = np.array([[4e-25, -2e-25], [-2e-25, 1.01e-25]])
    effect = NamedEffect("cross_port_leakage", "flow", "", {
        "L": Value(more, math.sqrt(1.01e-25), "m^3/(s·Pa)")}, 10.0)
    lag = NamedEffect("drive_lag", "drive", "", {"tau": Value(5e-3, 2e-4, "s")}, 10.0)
    found = Diagnosis(
        ("a",), "mismatch", "", Location({}, "", ()), (effect, lag), {}, {}, "held_out", {},
        fitted=Fitted(("rig.leakage", "cross_port_leakage.L", "drive_lag.tau",
                       "coulomb_friction.F_c"), np.array([leak, more, 5e-3, 9.0]),
                      np.block([[covariance, np.zeros((2, 2))],
                                [np.zeros((2, 2)), np.diag([1e-10, 1.0])]])))
    evidence = evidence_of_diagnosis(found, [], settings_with())
    flow = of(evidence, settings_with(), "leakage")
    assert flow.value == pytest.approx(6e7 * (leak / 2 + more) * 14e6)
    assert flow.stddev == pytest.approx(6e7 * 14e6 * math.sqrt(1e-25 - 2e-25 + 1.01e-25))
    lag = of(evidence, settings_with(), "drive_lag")
    assert lag.shown == "5.00 ± 0.20 ms"  # the answer's own, which is larger than the fit's
    assert "coulomb_friction.F_c" not in evidence.values  # the answer does not name it


def test_a_leakage_that_a_comparison_finds_is_the_indicator():
    """It had been 98.4 +- 2.9 in the sentence, and "not identified" in the table below."""
    from eha_monitor.indicators.assemble import evidence_of_diagnosis

    unit = "m³/(s·Pa)"
    leak = Change("cross_port_leakage", "L", "flow", Value(4e-13, 4e-14, unit),
                  Value(1.6e-12, 5e-14, unit), unit, "")
    found = Diagnosis(("a",), "mismatch", "", Location({}, "", ()), (), {}, {}, "held_out", {},
                      references=("b",), changes=(leak,))
    flow = of(evidence_of_diagnosis(found, [], settings_with()), settings_with(), "leakage")
    assert flow.value == pytest.approx(6e7 * 1.6e-12 * 14e6)
    assert flow.stddev == pytest.approx(6e7 * 5e-14 * 14e6)


def test_a_law_that_took_the_place_of_the_configs_counts_once_and_others_add():
    """The drive's lag of the config stands beside a command that is late; its friction is gone."""
    from eha_monitor.indicators.assemble import evidence_of_diagnosis

    given = {"coulomb_friction": {"F_c": 50.0}, "drive_lag": {"tau": 3e-3}}
    settings = settings_with(effects=given)
    sizes = {"presliding_friction": {"F_c": Value(49.0, 0.4, "N")},
             "command_delay": {"T": Value(2e-4, 3e-5, "s")}}
    found = Diagnosis(
        ("a",), "mismatch", "", Location({}, "", ()), tuple(
            NamedEffect(name, "", "", values, 10.0) for name, values in sizes.items()),
        {}, {}, "held_out", {}, config_effects={
            "drive_lag": {"tau": 3e-3}, "presliding_friction": {"F_c": 49.0},
            "command_delay": {"T": 2e-4}},
        fitted=Fitted(("presliding_friction.F_c", "command_delay.T"), np.array([49.0, 2e-4]),
                      np.diag([0.16, 9e-10])))
    evidence = evidence_of_diagnosis(found, [], settings)
    assert of(evidence, settings, "friction").value == pytest.approx(49.0)
    assert of(evidence, settings, "drive_lag").value == pytest.approx(3.2)  # ms


@pytest.mark.parametrize(("tree", "words"), [
    ({"viscosity": {"grade": 46}}, "grade and at_100 together"),
    ({"viscosity": {"grade": 6.8, "at_100": 46}}, "at_100 below grade"),
    ({"health": {"rated_pressure": "14 kg"}}, "health.rated_pressure: expected a number in Pa"),
    ({"health": {"rated_pressure": 140}}, "expected at least 100000 in Pa, got 140"),  # bar
    ({"health": {"rated_speed": 3000}}, "expected at most 2500 in rad/s, got 3000"),  # rpm
    ({"health": {"air_free_modulus": 600}}, "expected at least 1e.07 in Pa, got 600"),  # MPa
    ({"health": {"polytropic_exponent": 2}}, "at most 1.67"),
    ({"health": {"air_limit": 2}}, "unknown key, did you mean 'free_air_limit'"),
    ({"health": {"free_air_limit": 2}}, "at most 1"),
])
def test_what_is_written_wrong_is_refused_in_one_line(tree, words):
    with pytest.raises(InputError, match=words):
        settings_from_tree(tree, "rig.yaml")


def test_limits_come_in_the_unit_that_is_shown():
    settings = settings_with({**RATED, "leakage_limit": "50 mL/min", "free_air_limit": "2 %",
                              "friction_limit": 0.05, "pump_efficiency_limit": "85 %",
                              "drive_lag_limit": "20 ms"})
    assert limits_of_indicator("leakage", settings) == (None, pytest.approx(50.0))
    assert limits_of_indicator("free_air", settings) == (None, pytest.approx(2.0))
    assert limits_of_indicator("friction", settings) == (None, pytest.approx(353.5))
    assert limits_of_indicator("pump_efficiency", settings) == (pytest.approx(85.0), None)
    assert limits_of_indicator("drive_lag", settings) == (None, pytest.approx(20.0))
    assert limits_of_indicator("B", settings) == (150.0, 1500.0)
    assert limits_of_indicator("free_air", Settings()) == (None, None)


def test_temperature_and_pressure_of_a_recording():
    n = 3000
    warmth = np.full(n, np.nan)
    warmth[::7] = 47.0
    shown = Recording(1e-3, {"x": np.zeros(n), "p1": np.full(n, 3e6), "p2": np.full(n, 1e6),
                             "temperature": warmth})
    found = evidence([shown], settings_with(), {}, np.zeros((0, 0)), {})
    assert (found.temperature, found.measured) == (47.0, True)
    assert np.mean(found.pressures) == pytest.approx(2e6)
    silent = Recording(1e-3, {"x": np.zeros(n)})
    config = settings_with({**RATED, "oil_temperature": 33.0})
    found = evidence([silent], config, {}, np.zeros((0, 0)), {})
    assert (found.temperature, found.measured) == (33.0, False)
    assert not len(found.pressures)


# ---- from end to end ----------------------------------------------------------------------------

def test_estimate_tells_the_air_of_the_bundled_bag(tmp_path, capsys):
    """The truth is 6 % of air with n = 1.4 in oil of 600 MPa, and C_T of the config."""
    config = tmp_path / "rig.yaml"
    config.write_text("health: {rated_pressure: 14 MPa, rated_speed: 3000 rpm, "
                      "air_free_modulus: 600 MPa, air_free_tolerance: 0.01, "
                      "polytropic_exponent: 1.4, free_air_limit: 2 %}\n")
    answer, report = tmp_path / "a.json", tmp_path / "a.html"
    assert main(["estimate", str(ROOT / "bags/air_ingress"), "--config", str(config), "--json",
                 str(answer), "--report", str(report)]) == 0
    told = {one["name"]: one for one in json.loads(answer.read_text())["indicators"]}
    air = told["free_air"]
    assert air["value"] == pytest.approx(6.0, abs=3 * air["stddev"])
    assert air["stddev"] < 0.2
    truth = 0.5 * Settings().rig.leakage * 14e6 * 6e7
    assert told["leakage"]["value"] == pytest.approx(truth, abs=3 * told["leakage"]["stddev"])
    full = 6e7 * Settings().rig.pump_displacement * 3000 * 2 * math.pi / 60
    assert told["pump_efficiency"]["value"] == pytest.approx(
        100 * (1 - truth / full), abs=3 * told["pump_efficiency"]["stddev"])
    out = capsys.readouterr().out
    assert "mL/min" in out
    assert "run `diagnose` for dry friction and drive lag" in out
    page = Page(report.read_text(encoding="utf-8"))
    assert "indicators" in page.ids
    assert any(value == pytest.approx(air["value"]) for value in page.values)
    assert "below 2 %" in page.text


def test_a_limit_is_passed_beyond_the_uncertainty_only():
    settings = settings_with({**RATED, "leakage_limit": "200 mL/min",
                              "pump_efficiency_limit": 0.94})
    for stddev, beyond in ((1e-15, True), (1e-13, False)):
        found = evidence_of({"leakage": 5e-13}, {"leakage": stddev})  # 210 mL/min
        assert passed(of(found, settings, "leakage"), settings) is beyond
        assert passed(of(found, settings, "pump_efficiency"), settings) is beyond


def test_air_is_that_of_the_joint_estimator_where_the_leakage_leads_stage_two_astray():
    """Five times the config's leakage: stage two does not fit, and the air is still known."""
    rig = {"leakage": 2.5e-12, "bulk_modulus": 4e8}
    motion = {"m": {"kind": "multisine", "duration": 4.0, "amplitude": 0.01, "frequency": 0.5,
                    "frequency_end": 15.0, "components": 12}}
    made = settings_from_tree({"rig": rig, "simulation": {"excitation": motion}}, "test")
    recording = Recording(1e-3, Simulator(made, seed=3).advance(4000))
    settings = settings_with({**RATED, "air_free_modulus": 6e8, "air_free_tolerance": 0.01,
                              "polytropic_exponent": 1.0})
    found = estimate(recording, settings)
    assert "beta_e" in found.model.tainted or found.stage_two.estimate.status != "converged"
    told = {one.name: one for one in indicators(evidence_of_estimate(found), settings)}
    truth = 100 * (1 / 4e8 - 1 / 6e8) * np.mean((recording.channels["p1"]) ** 2) / 101325.0
    assert not told["free_air"].doubtful
    assert told["free_air"].value == pytest.approx(truth, rel=0.1)
    assert told["leakage"].value == pytest.approx(0.5 * 2.5e-12 * 14e6 * 6e7, rel=0.05)


def test_the_monitor_says_which_indicator_is_beyond_its_limit():
    settings = settings_with({"leakage_limit": "8 mL/min"})
    leak, air = (Indicator(name, value, 1.0, 1.0, unit, AVAILABLE, "", "").tree(settings)
                 for name, value, unit in (("leakage", 16.0, "mL/min"), ("free_air", 2.0, "%")))
    assert (leak["limit"], leak["beyond_limit"]) == (pytest.approx(8.0), True)
    assert (air["limit"], air["beyond_limit"]) == (None, False)
    compared = SimpleNamespace(verdict="consistent", tree={
        "message": "", "changes": [], "indicators": [leak, air]})
    _, one, other = comparison_findings(compared, "2026-12-01", 5)
    assert (one.level, other.level) == ("ERROR", "OK")
    assert one.message == "internal leakage 16.0 ± 1.0 mL/min, beyond its limit of 8 mL/min"


@pytest.mark.parametrize(("kind", "head", "leads"), [
    ("ok", "Healthy", "Alarm"), ("warn", "Mismatch", "Alarm and mismatch"),
    ("error", "Alarm", "Alarm")])
def test_a_page_leads_with_what_is_beyond_its_limit(kind, head, leads):
    settings = settings_with({"leakage_limit": "8 mL/min"})
    first = FirstScreen(kind, head, "the model fits.")
    high, low = (Indicator("leakage", value, 1.0, 1.0, "mL/min", AVAILABLE, "", "")
                 for value in (16.0, 7.0))
    found = with_limits(first, (high,), settings)
    assert (found.kind, found.head) == ("error", leads)
    assert found.message.startswith("internal leakage of 16.0 ± 1.0 mL/min is beyond its limit; ")
    assert with_limits(first, (low,), settings) == first
