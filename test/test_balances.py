"""The likelihood by balances: one answer for one recording, two, and against healthy ones."""

from dataclasses import replace

import numpy as np
import pytest
from machine_tools import healthy_machine, stranger, stranger_settings
from mismatch_tools import recorded
from rig_tools import MULTISINE, simulated
from rig_tools import settings as rig_settings
from scipy.signal import lfilter
from test_filters_effects import CASES, recording_of

from eha_monitor.balances.alone import alone
from eha_monitor.balances.answer import Asked, _agreeing_words, answered
from eha_monitor.balances.baseline import baseline
from eha_monitor.balances.candidates import (
    BALANCES,
    BASE,
    BENT_DAMPING,
    FIRST_VIEW,
    LINEAR,
    PLAIN,
    PUMP,
    WATCHED,
    Scale,
    candidates_of,
)
from eha_monitor.balances.changed import against, softened
from eha_monitor.balances.course import BOTH, IN_TURN, oil_of
from eha_monitor.balances.least_squares import unexcluded
from eha_monitor.balances.machine import machine_from
from eha_monitor.balances.measured import course_of, course_within
from eha_monitor.balances.oil import compressibility
from eha_monitor.balances.policy import POLICY
from eha_monitor.balances.scatter import amplitudes_of
from eha_monitor.balances.table import pooled_table, tables_of
from eha_monitor.balances.together import of_one_machine
from eha_monitor.concealed.cases import Case
from eha_monitor.mismatch.beside_balances import agrees_closely, drifts
from eha_monitor.mismatch.diagnose import diagnose
from eha_monitor.mismatch.diagnosis import (
    Diagnosis,
    Location,
    RigFinding,
    SignalFit,
    Value,
    beside_config,
)
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.quantity import quantity
from eha_monitor.recordings import columns
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings import settings_from_tree
from eha_monitor.settings.hypothesis import hypothesis_of
from eha_monitor.settings.rig import Rig

CALM = {"rise": 0.0, "damping": (1500.0, 1500.0)}


@pytest.fixture(scope="module")
def settings(tmp_path_factory):
    return stranger_settings(tmp_path_factory.mktemp("rig"))


@pytest.fixture(scope="module")
def one(settings):
    return answered([stranger(0, **CALM)], settings)


def with_effects(settings, **effects):
    return settings_from_tree({**settings.model_dump(), "effects": effects}, "test")


# What no column of a balance can be, and why.
WITHOUT_COLUMN = {
    "anti_cavitation": "a threshold that a pressure hardly ever passes",
    "relief_valve": "a threshold that a pressure hardly ever passes",
    "line_dynamics": "it rings above the band",
    "pump_flow_gain": "the displacement of the pump, D_p",
    "command_delay": "in the band it is a lag of the drive", "feedback_delay": "and so is that"}


def test_each_effect_has_a_column_or_a_reason(settings):
    """Least squares may overrule the filter: what they have no law for they call another name."""
    course = course_of(stranger(0, **CALM), settings)
    present = {one.effect for balance in BALANCES for one in candidates_of(
        balance, replace(Scale.of([course]), tops=(100.0,), contacts=((0.1, 1.0),)), settings.rig)}
    needed = {name for name, effect in CATALOGUE.items() if effect.balance != "sensor"}
    assert needed - present == set(WITHOUT_COLUMN), (
        "balances/candidates.py, or a reason here (docs/effects.md, An entry of the catalogue)")


def test_a_number_that_is_moved_within_its_tolerance_is_in_the_answer():
    """Of a leakage known to a factor of three, ten times as much is no mismatch, and is said."""
    found = Value(1.6e-11, 4e-13, "m³/(s·Pa)")
    statement = beside_config("leakage", 1e-12, found)
    assert statement.endswith("(C_T, twice the flow over the pressure difference)")
    moved = RigFinding("leakage", 1e-12, found, np.nan, statement)
    said = _agreeing_words([], Rig(), [moved], POLICY)
    assert "if leakage is 960 ± 24 ml/(min·MPa), where it has 60 ml/(min·MPa)" in said
    assert "if" not in _agreeing_words([], Rig(), [], POLICY)


def test_what_is_asked_of_terms_by_name_is_asked_of_terms_that_there_are(settings):
    course = course_of(stranger(0, **CALM), settings)
    names = {one.name for balance in BALANCES
             for one in candidates_of(balance, Scale.of([course]), settings.rig)}
    assert names >= {*FIRST_VIEW, BENT_DAMPING, *LINEAR, *BASE, *PUMP, *PLAIN, *WATCHED}


def test_one_recording_names_what_is_there(one):
    named = {effect.name: effect for effect in one.effects}
    dry = named.get("coulomb_friction") or named["presliding_friction"]
    assert one.verdict == "mismatch" and "constant_load" in named
    assert dry.parameters["F_c"].value == pytest.approx(180.0, rel=0.05)
    assert named["constant_load"].parameters["F_0"].value == pytest.approx(338.0, abs=6.0)
    assert abs(one.after["B"].value - 1500.0) < 2.0 * one.after["B"].stddev
    assert one.before["B"].value > 1.2 * one.after["B"].value and one.health
    assert all(effect.probability <= POLICY.certain for effect in one.effects)
    assert dry.effective_samples > 1.0 and dry.stability >= POLICY.stable
    force = one.signals["force"]
    assert force.after_rms < 0.2 * force.before_rms and force.noise_rms < force.after_rms * 2.0
    assert one.location.balance["force"] == pytest.approx(1.0)
    assert one.curves and one.overlays[0].signal == "force"


@pytest.mark.parametrize("case", sorted(CASES))
def test_what_the_config_knows_is_not_named_again(case):
    """With an effect of the catalogue in the config nothing is missing, and B is right."""
    recording, effects = recording_of(case)
    found = answered([recording], rig_settings(effects=effects))
    assert found.verdict == "consistent" and not found.effects
    assert abs(found.after["B"].value - 600.0) < 3.0 * found.after["B"].stddev


def test_a_drift_of_a_long_recording_counts_from_its_beginning(monkeypatch):
    """Only samples of a long recording are taken: their times are those of the recording."""
    recording, effects = recording_of("pressure_drift")
    known = rig_settings(effects=effects)
    whole = course_of(recording, known)
    monkeypatch.setattr(columns, "IN_MEMORY", 8400)  # two stretches, with a gap between
    parts = course_of(recording, known)
    assert len(parts) < len(whole)
    late = slice(-300, -50)  # the last two seconds
    assert parts.p1[late].mean() - parts.p2[late].mean() == pytest.approx(
        whole.p1[late].mean() - whole.p2[late].mean(), abs=300.0)


def test_effects_of_the_config_count_as_known(settings):
    known = with_effects(settings, coulomb_friction={"F_c": 180.0, "v_e": 2e-4},
                         constant_load={"F_0": 338.0})
    found = answered([stranger(0, **CALM)], known)
    assert found.verdict == "consistent" and not found.effects
    assert found.after["B"].value == pytest.approx(1500.0, rel=0.05)


def test_an_effect_that_is_excluded_is_not_named(settings):
    found = answered([stranger(0, **CALM)], settings, Asked(without=("coulomb_friction",)))
    assert "coulomb_friction" not in {effect.name for effect in found.effects}


def test_the_fit_is_shown_on_another_recording(settings):
    found = answered([stranger(0, **CALM)], settings, Asked(held_out=stranger(
        7, load=120.0, **CALM)))
    force = found.signals["force"]
    assert found.data == "held_out_bag" and force.after_rms < 0.5 * force.before_rms


def test_two_recordings_have_loads_of_their_own(settings):
    found = answered([stranger(k, load=load, **CALM) for k, load in enumerate((100.0, 500.0))],
                     settings)
    load = next(effect for effect in found.effects if effect.name == "constant_load")
    assert load.parameters["F_0"].value == pytest.approx(300.0, abs=10.0)
    assert "100" in load.statement or "99" in load.statement or "101" in load.statement


def test_a_hypothesis_is_one_more_column(settings):
    recording = stranger(0, **CALM)
    x = recording.channels["x"]
    bump = 900.0 * np.exp(-(((x - 0.2) / 0.02) ** 2))
    worn = replace(recording, channels={**recording.channels, "p1": recording.channels["p1"]
                                        + bump / settings.rig.area_1})
    suspected = hypothesis_of({
        "name": "worn_spot", "adds": "force", "expression": "F*exp(-((x - 0.2)/0.02)**2)",
        "parameters": {"F": {"start": 100.0, "lower": 0.0, "upper": 5000.0, "unit": "N"}}}, "it")
    found = answered([worn], settings, Asked(hypothesis=suspected))
    named = {effect.name: effect for effect in found.effects}
    assert named["worn_spot"].parameters["F"].value == pytest.approx(900.0, rel=0.1)


def test_what_has_changed_against_few_and_many(settings):
    healthy = [stranger(k, **CALM) for k in range(5)]
    worn = stranger(11, dry=290.0, **CALM)
    for count in (1, 5):
        machine = healthy_machine(healthy[:count], settings)
        sources = tuple(recording.source for recording in healthy[:count])
        same = against(machine, [stranger(12, **CALM)], settings, sources)
        assert same.verdict == "consistent" and not same.changes
    found = against(machine, [worn], settings, sources)
    assert found.verdict == "mismatch"
    assert found.changes[0].what in ("coulomb_friction", "presliding_friction")
    assert found.changes[0].now.value == pytest.approx(290.0, rel=0.05)
    assert found.changes[0].reference.value == pytest.approx(180.0, rel=0.05)


def test_amplitudes_are_those_of_least_squares(settings):
    course = course_of(stranger(0, **CALM), settings)
    (table,) = tables_of([course], settings.rig, "force", candidates_of(
        "force", Scale.of([course]), settings.rig), POLICY)
    errors = {"B": np.array([30.0, 0.0]), "F_c": np.array([2.0, 5.0])}
    found, off = (amplitudes_of(table, weights, ["F_0"], ["B", "F_c", "k"], errors=errors)
                  for weights in ({"B": 1200.0}, {"B": 1230.0, "F_c": 2.0}))
    assert off.value == pytest.approx(found.value - found.common[:, 0], rel=1e-6)
    rows = table.rows[table.good]
    for i, name in enumerate(found.names):
        columns = rows[:, [table.places[name], table.places["F_0"]]]
        y = rows[:, 0] - 1200.0 * rows[:, table.places["B"]]
        expected = np.linalg.lstsq(columns, y, rcond=None)[0][0]
        assert found.value[i] == pytest.approx(expected, rel=1e-6)


def test_pooled_tables_have_one_load_for_each(settings):
    courses = [course_of(stranger(k, load=load, **CALM), settings)
               for k, load in enumerate((100.0, 500.0))]
    tables = tables_of(courses, settings.rig, "force", candidates_of(
        "force", Scale.of(courses), settings.rig), POLICY)
    whole = pooled_table(tables)
    left = whole.mixture(whole.gram, ["B", "F_c", "F_0 1", "F_0 2"])
    assert -left[whole.places["F_0 1"]] == pytest.approx(100.0, abs=5.0)
    assert -left[whole.places["F_0 2"]] == pytest.approx(500.0, abs=5.0)


def test_what_is_always_there_is_as_sure_as_its_own_size(settings):
    """No half says whether it is there: leakage beyond the config's was told with 2 %."""
    course = course_of(stranger(0, **CALM), settings)
    (table,) = tables_of([course], settings.rig, "force", candidates_of(
        "force", Scale.of([course]), settings.rig), POLICY)
    found = [name for name in alone(table, POLICY).names
             if next(c for c in table.candidates if c.name == name.term).always]
    assert {name.term for name in found} == {"B", "F_0"}
    for name in found:
        apart = abs(name.value) / name.stddev
        assert (name.probability > 0.9) == (apart > POLICY.varied + 2.0), name


def test_nothing_is_said_of_a_recording_at_rest(settings):
    still = stranger(0, **CALM)
    still = replace(still, channels={**still.channels, "x": np.full(len(still), 0.2) + 1e-6
                                     * np.random.default_rng(0).standard_normal(len(still))})
    assert answered([still], settings).verdict == "insufficient_data"


def test_what_friction_holds_at_rest_is_no_law_of_motion(settings):
    course = course_of(stranger(3, dwells=6, rise=0.0), settings)
    found = answered([stranger(3, dwells=6, rise=0.0)], settings)
    (dry,) = [effect for effect in found.effects if "F_c" in effect.parameters]
    assert dry.parameters["F_c"].value == pytest.approx(180.0, rel=0.05)
    assert found.after["B"].value == pytest.approx(1390.0, rel=0.08)  # 1500 falling to 1275
    assert found.signals["force"].after_rms < 0.05 * found.signals["force"].signal_rms
    assert 0.3 < course.counted("force").sum() / course.good.sum() < 0.7
    assert (course.counted("flow") == course.good).all()


def test_the_first_view_knows_the_spring_of_the_config(settings):
    recording = stranger(4, spring=4000.0)
    known = with_effects(settings, spring_load={"k": 4000.0, "x_0": 0.2})
    blind, seeing = baseline(recording, settings).force, baseline(recording, known).force
    assert seeing["F_c"].value == pytest.approx(185.0, abs=12.0)
    assert seeing.unseen_share < 0.06 < blind.unseen_share


def test_a_load_in_which_the_healthy_agree_may_change(settings):
    healthy = healthy_machine([stranger(seed) for seed in range(4)], settings)
    found = against(healthy, [stranger(7, load=438.0)], settings, ("healthy",) * 4)
    (change,) = found.changes
    assert change.what == "constant_load"
    assert change.now.value == pytest.approx(438.0, abs=6.0)
    assert change.reference.value == pytest.approx(338.0, abs=4.0)
    assert "pressure_offset" in change.indistinguishable_from
    assert against(healthy, [stranger(8)], settings, ("healthy",) * 4).verdict == "consistent"


def test_areas_that_are_off_are_off_in_the_healthy_recordings_as_well(settings):
    """A tenth of both areas is 30 N and more of any load, and nothing of a difference of loads."""
    rig = settings.rig.model_copy(update={"tolerance": settings.rig.tolerance.model_copy(
        update={"area_1": 0.1, "area_2": 0.1})})
    loose = settings.model_copy(update={"rig": rig})
    healthy = healthy_machine([stranger(seed) for seed in range(4)], loose)
    (change,) = against(healthy, [stranger(7, load=438.0)], loose, ("healthy",) * 4).changes
    assert change.what == "constant_load" and change.now.stddev > 30.0
    assert against(healthy, [stranger(8)], loose, ("healthy",) * 4).verdict == "consistent"
    load = next(one for one in healthy["force"].settings if one.name == "F_0")
    assert (load.own_stddev < 0.3 * np.array(load.stddev)).all()


def test_a_spring_beside_a_load_is_told_as_the_force_at_nil(settings):
    """4000 (x - 0.2) + 338 N is -462 N at x = 0; where a spring relaxes no recording tells."""
    found = answered([stranger(5, spring=4000.0)], settings)
    named = {effect.name: effect for effect in found.effects}
    spring, load = named["spring_load"].parameters, named["constant_load"].parameters["F_0"]
    assert found.config_effects["spring_load"]["x_0"] == 0.0
    assert spring["k"].value == pytest.approx(4000.0, rel=0.1)
    assert load.value == pytest.approx(-462.0, abs=3.0 * load.stddev)
    assert named["constant_load"].size == quantity(abs(load.value), "N", 3)


def test_a_spring_that_the_config_has_too_stiff_is_told_as_it_is(settings):
    """Only a stiffer one could be told: 4 % too much was a load over the stroke, 20 of 21."""
    one = stranger(0, **CALM)
    held = {"spring_load": {"k": 10e3, "x_0": 0.2}}
    recordings = [pulled(stranger(seed, **CALM), 8e3, 0.2, settings) for seed in (0, 1, 2)]
    found = answered(recordings[:1], with_effects(settings, **held))
    (spring,) = [effect for effect in found.effects if effect.name == "spring_load"]
    value = spring.parameters["k"]
    assert abs(value.value - 8e3) < 3.0 * value.stddev < 1e3
    assert "x = 200 mm; the config has 10 kN/m" in spring.statement
    assert "position_load" not in {effect.name for effect in found.effects}
    changed = against(healthy_machine(recordings, with_effects(settings, **held)),
                      [pulled(one, 10e3, 0.2, settings)], with_effects(settings, **held), ())
    (spring,) = [one for one in changed.changes if one.what == "spring_load"]
    assert abs(spring.reference.value - 8e3) < 200.0 and abs(spring.now.value - 10e3) < 200.0


def test_a_spring_within_its_tolerance_is_told_and_not_named(settings):
    one = pulled(stranger(0, **CALM), 8e3, 0.2, settings)
    config = with_effects(settings, spring_load={"k": 9e3, "x_0": 0.2},
                          constant_load={"F_0": 338.0}, coulomb_friction={"F_c": 180.0})
    found = answered([one], config)
    assert found.verdict == "consistent" and "spring_load.k is 79" in found.message
    narrow = config.model_copy(update={"rig": config.rig.model_copy(update={
        "tolerance": config.rig.tolerance.model_copy(update={"effects": 0.01})})})
    assert [one.name for one in answered([one], narrow).effects] == ["spring_load"]


def pulled(one, k, x_0, settings):
    """Return a recording with a spring on the rod."""
    force = k * (one.channels["x"] - x_0)
    return replace(one, channels={
        **one.channels, "p1": one.channels["p1"] + force / settings.rig.area_1})


def test_loads_that_differ_are_compared_with_their_scatter(settings):
    """A platform carries 300 to 380 N in health; before, no load was then ever a change."""
    healthy = healthy_machine([stranger(seed, load=300.0 + 20.0 * seed) for seed in range(5)],
                              settings)
    found = against(healthy, [stranger(7, load=800.0)], settings, ("healthy",) * 5)
    (change,) = found.changes
    assert change.what == "constant_load"
    assert change.now.value == pytest.approx(800.0, abs=10.0)
    assert change.reference.value == pytest.approx(340.0, abs=5.0)
    same = against(healthy, [stranger(8, load=350.0)], settings, ("healthy",) * 5)
    assert same.verdict == "consistent"


def test_dry_friction_of_any_shape_is_told_as_a_force(settings):
    """The machine may hold its friction bent or with a Stribeck rise: what it has is a force."""
    healthy = healthy_machine([stranger(seed, rise=120.0) for seed in range(5)], settings)
    found = against(healthy, [stranger(7, dry=270.0, rise=120.0)], settings, ("healthy",) * 5)
    change = next(one for one in found.changes if one.symbol == "F_c")
    rise = change.now.value - change.reference.value
    assert rise == pytest.approx(90.0, rel=0.15)
    assert 180.0 < change.reference.value < 250.0  # with what of the rise the motion shows


@pytest.mark.parametrize("positive", [False, True])
def test_what_a_column_may_add_is_integrated(positive):
    """Beside a quadrature over its weight: moments, evidence, and how far the others go."""
    rng = np.random.default_rng(3)
    columns, column = rng.standard_normal((40, 2)), rng.standard_normal(40)
    y = columns @ [2.0, -1.0] + 0.3 * column + 0.8 * rng.standard_normal(40)
    noise = 5.0

    def least(weight):
        """Parameters and squares that are left with a given weight."""
        found = np.linalg.lstsq(columns, y - weight * column, rcond=None)[0]
        return found, float(np.sum((y - weight * column - columns @ found) ** 2))

    bare, without = least(0.0)
    moves, mean, variance, log = unexcluded(columns, column, y - columns @ bare, noise, positive)
    np.testing.assert_allclose(bare + moves, least(1.0)[0], rtol=1e-9)
    weights = np.linspace(0.0 if positive else -8.0, 8.0, 4001)
    density = np.exp([0.5 * (without - least(w)[1]) / noise - 0.5 * w**2 for w in weights])
    density *= (2.0 if positive else 1.0) / np.sqrt(2.0 * np.pi)
    total = np.trapezoid(density, weights)
    by_hand = np.trapezoid(density * weights, weights) / total
    assert log == pytest.approx(np.log(total), abs=1e-4)
    assert mean == pytest.approx(by_hand, rel=1e-4)
    assert variance == pytest.approx(
        np.trapezoid(density * (weights - by_hand) ** 2, weights) / total, rel=1e-3)


def test_a_fall_with_speed_that_no_speed_shows_is_in_the_deviations(settings):
    """Below the Stribeck speed the friction is that of rest, and damping its slope: nobody knows.

    The forces are the test's own: 180 N of Coulomb friction, 120 N more at rest that fall over
    10 mm/s as a Gaussian; the motion goes up to 70 mm/s, or to a tenth and a thirtieth of that.
    """
    widths = []
    for travel in (1.0, 0.1, 1.0 / 30.0):
        z, shares = [], []
        for seed in range(3):
            found = answered([stranger(seed, rise=120.0, damping=(1500.0, 1500.0),
                                       travel=travel)], settings)
            dry = next(one.parameters["F_c"] for one in found.effects if "F_c" in one.parameters)
            damping = found.after.get("B")
            z += [(dry.value - 180.0) / dry.stddev]
            z += [(damping.value - 1500.0) / damping.stddev] if damping else []
            shares.append(dry.stddev / dry.value)
        assert np.sqrt(np.mean(np.square(z))) < 2.0
        widths.append(float(np.median(shares)))
    assert widths[0] < 0.25 < widths[1] and 2.0 * widths[0] < widths[2]


@pytest.mark.parametrize("play", [0.0, 2.5e-4])
def test_behind_check_valves_the_filled_chamber_is_compressed(play):
    """Equal areas, the lower pressure held at the source's: known motion, flow by its equation.

    With play the sensor is dragged: what it misses at each reversal may be no soft oil.
    """
    area, volume, beta, pump = 1.3e-3, 2.2e-4, 1.1e9, 1e-6
    config = settings_from_tree({"rig": {
        "area_1": area, "area_2": area, "volume_1": volume, "volume_2": volume, "mass": 100.0,
        "pump_displacement": pump, "position_gain": None, "leakage": 0.0,
        "makeup_conductance": 0.0, "charge_pressure": 1.3e6}}, "a test")
    rng, t = np.random.default_rng(2), np.arange(0.0, 20.0, 1e-3)
    x = sum(a * np.sin(2.0 * np.pi * f * t + i) for i, (a, f) in enumerate(
        ((2e-2, 0.3), (4e-3, 1.1), (1e-3, 2.7), (4e-4, 4.3))))
    v = np.gradient(x, t)
    force = 100.0 * np.gradient(v, t) + 3500.0 * v + 200.0 * np.tanh(v / 1e-3)
    head = np.abs(force) / area
    p1, p2 = (1.3e6 + np.where(way * force > 0.0, head, 0.0) for way in (1.0, -1.0))
    oil = np.sign(force) * volume / beta * np.gradient(head, t)
    omega = (area * v + oil) / pump
    shown = x.copy()
    for i in range(1, len(x)):
        shown[i] = min(max(shown[i - 1], x[i] - 0.5 * play), x[i] + 0.5 * play)
    noise = {"x": 1e-6, "omega": 1e-2, "p1": 500.0, "p2": 500.0}
    recording = Recording(1e-3, {name: values + noise[name] * rng.standard_normal(len(t))
                                 for name, values in (("x", shown), ("omega", omega), ("p1", p1),
                                                      ("p2", p2))})
    found = compressibility(course_of(recording, config), config.rig)
    assert play or found.value == pytest.approx(1.0 / beta, rel=0.1)
    assert abs(found.value - 1.0 / beta) < 2.0 * found.stddev
    assert not play or not POLICY.sure(found.value, found.stddev)


@pytest.mark.parametrize("filled", [1, 2])
def test_oil_and_air_are_those_of_the_volume_where_the_piston_stands(filled):
    """A single rod whose chambers change over the stroke: the flow by its own equation."""
    areas, volumes, pump = (3e-3, 2e-3), (1.3e-4, 9.7e-4), 1.3e-6
    beta, alpha, n = 1.2e9, 8e-3, 1.4
    config = settings_from_tree({"rig": {
        "area_1": areas[0], "area_2": areas[1], "volume_1": volumes[0], "volume_2": volumes[1],
        "mass": 100.0, "pump_displacement": pump, "position_gain": None, "leakage": 0.0,
        "makeup_conductance": 0.0, "charge_pressure": 4e5},
        "effects": {"position_dependent_volume": {"A_v": areas[0], "r": areas[1] / areas[0]}}},
        "a test")
    t = np.arange(0.0, 20.0, 1e-3)
    x, v = 0.2 - 0.08 * np.cos(1.3 * t), 0.104 * np.sin(1.3 * t)
    p = 9e5 + 4e5 * np.sin(5.0 * t) + 1e5 * np.sin(11.0 * t)
    rate = 2e6 * np.cos(5.0 * t) + 1.1e6 * np.cos(11.0 * t)
    volume = volumes[0] + areas[0] * x if filled == 1 else volumes[1] - areas[1] * x
    taken = volume * rate * (1.0 / beta + alpha / (n * p) * (101325.0 / p) ** (1.0 / n))
    way, area = (1.0, areas[0]) if filled == 1 else (-1.0, areas[1])
    low = np.full(len(t), 2e5)
    course = course_of(Recording(1e-3, {
        "x": x, "omega": (area * v + way * taken) / pump,
        "p1": p if filled == 1 else low, "p2": low if filled == 1 else p}), config)
    every = candidates_of("flow", Scale.of([course]), config.rig)
    columns = np.stack([next(one for one in every if one.name == name).column(
        course, config.rig) for name in ("C_h", "alpha")], axis=1)
    left = areas[0] * course.v - pump * course.omega * areas[0] / area
    inner = slice(100, -100)  # the rates of the measured pressures are low-passed
    found, *_ = np.linalg.lstsq(columns[inner], left[inner], rcond=None)
    assert volumes[0] / found[0] == pytest.approx(beta, rel=0.03)
    assert found[1] == pytest.approx(alpha, rel=0.03)


def test_more_friction_at_another_damping_is_more_friction(settings):
    healthy = healthy_machine([stranger(seed, damping=(1500.0 + 60.0 * k,) * 2)
                               for seed, k in enumerate((-1, 0, 1, 0.5))], settings)
    found = against(healthy, [stranger(7, dry=270.0, damping=(1380.0, 1380.0))], settings,
                    ("healthy",) * 4)
    assert found.changes[0].what == "coulomb_friction"
    assert found.changes[0].now.value - found.changes[0].reference.value == pytest.approx(
        90.0, abs=9.0)


def test_a_reference_of_another_machine_is_left_out(settings):
    healthy = [stranger(seed) for seed in range(4)]
    mixed = healthy_machine([*healthy, stranger(9, damping=(4500.0, 4500.0), dry=500.0)], settings)
    assert len(mixed.sources) == 4 and [one.place for one in mixed.odd] == [4]
    worn = against(mixed, [stranger(7, dry=270.0)], settings, ("healthy",) * 5)
    assert worn.changes[0].what == "coulomb_friction"


def test_a_heavy_boom_is_a_load_although_what_varies_has_no_name():
    """A crane's jib: one slow stroke under a load that another boom moves; no pump, no volumes.

    The filter has no likelihood there, which must not end the diagnosis.
    """
    config = settings_from_tree({"rig": {
        "area_1": "176.7 cm^2", "area_2": "98.2 cm^2", "volume_1": None, "volume_2": None,
        "pump_displacement": None, "position_gain": None, "mass": 20.0, "sample_time": 0.01}},
        "a test")
    rng, t = np.random.default_rng(4), np.arange(0.0, 50.0, 0.01)
    stroke = np.clip((t - 4.0) / 40.0, 0.0, 1.0)
    x = 0.25 + 0.1 * (1.0 - np.cos(2.0 * np.pi * stroke))
    force = 36_000.0 + 2_000.0 * np.sin(0.21 * t) * np.cos(0.013 * t**1.5)
    p2 = 40e5 + 20e5 * stroke
    p1 = (force + 98.2e-4 * p2) / 176.7e-4
    noise = {"x": 2e-6, "x_d": 0.0, "p1": 2e3, "p2": 2e3}
    boom = Recording(0.01, {name: values + noise[name] * rng.standard_normal(len(t))
                            for name, values in (("x", x), ("x_d", x), ("p1", p1), ("p2", p2))})
    found = diagnose([boom], config)
    (load,) = found.effects
    assert load.name == "constant_load"
    assert load.parameters["F_0"].value == pytest.approx(36_000.0, rel=0.05)
    assert "has no name" in found.message


def test_a_demand_that_rests_and_jumps_is_no_dead_sensor():
    """In steps a demand was taken for a sensor that drops out."""
    recording, settings = recorded(Case("steps", (), motion="rich", seed=7))
    course = course_of(recording, settings)
    left = (course.wanted - course.omega)[course.good]
    assert np.sqrt(np.mean(left**2)) < 0.001 * np.std(course.omega)


def test_what_is_unseen_is_left_out_of_a_fit_that_has_either_direction(settings):
    """Of every other pair of blocks all held one direction of a sine of 0.35 Hz: no friction."""
    course = course_of(stranger(3, **CALM), settings)
    table, = tables_of([course], settings.rig, "force", candidates_of(
        "force", Scale.of([course]), settings.rig), POLICY)
    names = [one.name for one in table.candidates if one.always]
    left, places = table.crosswise(names), [table.places[name] for name in names]
    fold = {number: i // 2 % 5 for i, number in enumerate(table.numbers.tolist())}
    of = np.array([fold.get(number, -1) for number in table.block.tolist()])
    for one in range(5):
        rest = table.rows[table.good & (of != one)]
        w = np.linalg.lstsq(rest[:, places], rest[:, 0], rcond=None)[0]
        there = table.good & (of == one)
        np.testing.assert_allclose(left[there], table.rows[there, 0] - table.rows[there][
            :, places] @ w, rtol=1e-6, atol=1e-6 * table.size)
    pairs = table.first_half[::2].tolist()
    assert pairs != [i % 2 == 0 for i in range(len(pairs))] and 0.3 < np.mean(pairs) < 0.7


def test_whose_oil_is_pressed_is_the_machines():
    """One recording may look like either: with the mean of both in one, a leak was an air."""
    config = settings_from_tree({"rig": {
        "area_1": 1.35e-3, "area_2": 1.35e-3, "volume_1": 3e-4, "volume_2": 3e-4}}, "a test")
    t = np.arange(0.0, 10.0, 2e-3)
    v = 0.04 * np.cos(2.0 * t)
    courses = [course_of(Recording(2e-3, {
        "x": 0.02 * np.sin(2.0 * t), "omega": 1e3 * v, "p1": 1e6 + 4e5 * np.sin(2.0 * t),
        "p2": 1e6 - share * 4e5 * np.sin(2.0 * t)}), config) for share in (0.3, 1.0, 0.4)]
    alone = [oil_of([course]) for course in courses]
    assert alone == [IN_TURN, BOTH, IN_TURN]
    assert {one.oil for one in of_one_machine(courses, config.rig)} == {IN_TURN}
    assert {one.oil for one in of_one_machine(courses[1:2], config.rig)} == {BOTH}


def test_a_number_within_its_tolerance_is_told(settings):
    """A pump that delivers 5 % less, known to 3 %: what it takes away was taken in silence."""
    area, volume, beta, pump = 1.3e-3, 2.2e-4, 1.1e9, 0.95e-6
    config = settings_from_tree({"rig": {
        "area_1": area, "area_2": area, "volume_1": volume, "volume_2": volume, "mass": 100.0,
        "pump_displacement": 1e-6, "position_gain": None, "leakage": 0.0,
        "makeup_conductance": 0.0, "charge_pressure": 1.3e6,
        "tolerance": {"pump_displacement": 0.03, "area_1": 0.005}}}, "a test")
    rng, t = np.random.default_rng(2), np.arange(0.0, 20.0, 1e-3)
    x = sum(a * np.sin(2.0 * np.pi * f * t + i) for i, (a, f) in enumerate(
        ((2e-2, 0.3), (4e-3, 1.1), (1e-3, 2.7))))
    v = np.gradient(x, t)
    force = 100.0 * np.gradient(v, t) + 3500.0 * v
    p1, p2 = 2e6 + 0.5 * force / area, 2e6 - 0.5 * force / area
    omega = (area * v + 0.5 * volume / beta * np.gradient(p1 - p2, t)) / pump
    noise = {"x": 1e-6, "omega": 1e-2, "p1": 500.0, "p2": 500.0}
    found = answered([Recording(1e-3, {
        name: values + noise[name] * rng.standard_normal(len(t)) for name, values in (
            ("x", x), ("omega", omega), ("p1", p1), ("p2", p2))})], config, Asked())
    (within,) = found.rig_within
    assert within.key == "pump_displacement" and "three of its tolerances" in within.statement
    assert abs(within.found.value - pump) < 2.0 * within.found.stddev


def test_a_force_that_keeps_one_value_is_no_balance(settings):
    """Both pressures frozen, or a rest within their last digit: the calculation broke down."""
    one = stranger(0, **CALM)
    frozen = {name: np.full(len(one), 2e6) for name in ("p1", "p2")}
    found = answered([replace(one, channels={**one.channels, **frozen})], settings)
    assert found.verdict == "insufficient_data" and "pressures keep one value" in found.message
    assert found.baselines[0].force is None


@pytest.mark.parametrize(("mass", "named"), [(58.0, False), (100.0, True)])
def test_a_wrong_mass_is_named_however_little_of_the_force_it_is(tmp_path, mass, named):
    """The config has 55 kg within 5 %, and a spring that is 99 % of the force."""
    config = stranger_settings(tmp_path).model_copy(update={
        "effects": {"spring_load": {"k": 3e4, "x_0": 0.2}}})
    recording = stranger(3, dry=0.0, rise=0.0, damping=(1500.0, 1500.0), load=0.0, mass=mass,
                         spring=3e4)
    found = answered([recording], config, Asked())
    assert found.signals["force"].before_rms < 0.1 * found.signals["force"].signal_rms
    assert [effect.name for effect in found.effects] == ["added_mass"] * named, found.message
    for effect in found.effects:
        size = effect.parameters["dM"]
        assert size.value == pytest.approx(mass - 55.0, abs=2.0 * size.stddev)
    assert found.after["B"].value == pytest.approx(1500.0, abs=2.0 * found.after["B"].stddev)
    assert agrees_closely(found) is not named


def test_damping_that_falls_beside_a_spring_is_in_the_sentence(tmp_path):
    """Of a force that is nearly all the spring's a share of 2 % had hidden it."""
    config = with_effects(stranger_settings(tmp_path), spring_load={"k": 3.03e4, "x_0": 0.2})
    recording = stranger(3, dry=0.0, rise=0.0, damping=(2000.0, 1000.0), load=0.0, mass=55.0,
                         spring=3e4)
    found = answered([recording], config, Asked())
    assert found.verdict == "consistent" and "viscous damping falls by" in found.message
    assert found.drift.value == pytest.approx(-1000.0, abs=3.0 * found.drift.stddev)
    assert drifts(found) and not agrees_closely(replace(found, verdict="mismatch"))
    steady = stranger(3, dry=0.0, rise=0.0, damping=(1500.0, 1500.0), load=0.0, mass=55.0,
                      spring=3e4)
    assert answered([steady], config, Asked()).drift is None


def test_pressures_that_come_late_are_beside_the_mass(tmp_path):
    """Late by 20 ms beside a spring: damping reads T k less, and what is surely known is wider."""
    config = with_effects(stranger_settings(tmp_path), spring_load={"k": 3e4, "x_0": 0.2})
    recording = stranger(3, dry=0.0, rise=0.0, damping=(1500.0, 1500.0), load=0.0, mass=55.0,
                         spring=3e4, late=0.02)
    found = answered([recording], config, Asked())
    b = found.after["B"]
    assert abs(b.value - 1500.0) < 3.0 * b.stddev, (b, found.message)


def test_a_balance_that_leaves_three_per_cent_is_no_close_agreement():
    none = Diagnosis((), "consistent", "", Location({}, "", ()), (), {}, {}, "held_out", {})
    left = {share: replace(none, signals={"force": SignalFit("N", share, share, 0.0,
                                                             signal_rms=1.0)})
            for share in (0.019, 0.03)}
    assert agrees_closely(left[0.019]) and not agrees_closely(left[0.03])
    assert not agrees_closely(replace(left[0.019], verdict="mismatch"))


def test_a_motion_that_is_too_quick_for_one_band_is_balanced_in_the_next():
    """Two sines of 2.9 and 5.3 Hz with M, B and dry friction by their equation."""
    area, t = 1.3e-3, np.arange(0.0, 12.0, 1e-3)
    x = 8e-3 * np.sin(2.0 * np.pi * 2.9 * t) + 5e-3 * np.sin(2.0 * np.pi * 5.3 * t + 1.0)
    v = np.gradient(x, t)
    force = 20.0 * np.gradient(v, t) + 900.0 * v + 120.0 * np.tanh(v / 1e-3)
    config = settings_from_tree({"rig": {"area_1": area, "area_2": area, "mass": 20.0}}, "a test")
    rng = np.random.default_rng(4)
    recording = Recording(1e-3, {
        "x": x + 2e-6 * rng.standard_normal(len(t)),
        **{name: 3e6 + side * 0.5 * force / area + 2e3 * rng.standard_normal(len(t))
           for name, side in (("p1", 1.0), ("p2", -1.0))}})
    assert "reverses 11 times a second" in course_within(recording, config, 5.0).still
    assert course_of(recording, config).band == 20.0
    fit = baseline(recording, config).force
    for name, true in (("B", 900.0), ("F_c", 120.0), ("M", 20.0)):
        assert abs(fit[name].value - true) < 2.0 * fit[name].stddev < 0.3 * true


def test_a_drive_that_hunts_shows_no_friction(settings):
    """A limit cycle of 25 Hz under slow strokes, beyond every band: no law, and no spring."""
    one = stranger(0, **CALM)
    t = np.arange(len(one)) * one.sample_time
    cycle = 4e-3 * np.sin(2.0 * np.pi * 25.0 * t)
    hunting = replace(one, channels={**one.channels, "x": 0.2 * one.channels["x"] + cycle})
    found = answered([hunting], settings)
    assert found.verdict == "insufficient_data" and "a drive that hunts?" in found.message
    assert "left out" in "".join(answered([one, hunting], settings).health)


def test_a_recording_of_few_samples_breaks_no_other(settings):
    """Two samples are fitted exactly: their weight was infinite, and the SVD did not converge."""
    courses = [course_of(stranger(seed, **CALM), settings) for seed in range(3)]
    moving = np.zeros_like(courses[2].moving)
    moving[np.flatnonzero(courses[2].moving)[0]:][:2 * courses[2].every] = True
    courses[2] = replace(courses[2], moving=moving)
    assert courses[2].compared(moving).sum() == 2 and "too little" in courses[2].still
    machine = machine_from(courses, settings.rig, (), (), POLICY)
    assert all(np.isfinite(p.value) for one in machine.balances for p in one.parameters)


def test_damping_beside_laws_that_fit_as_well_is_as_unsure(settings):
    """Dry friction and drag by the square, hidden together in gusts: B stands for all three."""
    apart = []
    for seed in range(5):
        course = course_of(stranger(seed, **CALM), settings)
        v, top, a = course.v, course.speed, np.exp(-2.0 * course.dt)
        force = 400.0 * (top * course.direction + v) + 700.0 / top * v * np.abs(v)
        gust = lfilter([np.sqrt(1.0 - a * a)], [1.0, -a],
                       np.random.default_rng(seed).standard_normal(len(v)))
        b = damping(force + 0.1 * force.std() * gust, course, settings)
        apart.append((b.value - 400.0) / b.stddev)
    assert np.sqrt(np.mean(np.square(apart))) < 1.3  # 1.9 with each law's own share left out


def test_what_falls_with_speed_keeps_what_it_falls_from(settings):
    """A Stribeck term and a dry one that cannot bear it, both in most halves: a traceback."""
    course = course_of(stranger(2, **CALM), settings)
    v, top = course.v, course.speed
    assert damping(course.force + 3000.0 / top * v * np.abs(v) - 2100.0 * v, course, settings)


def damping(force, course, settings):
    """Return B as the balance of a force alone says, with nothing of it known."""
    here = replace(course, force=force)
    (table,) = tables_of([here], settings.rig, "force", candidates_of(
        "force", Scale.of([here]), settings.rig), POLICY)
    return next(name for name in alone(table, POLICY).names if name.term == "B")


def test_a_long_recording_is_sampled_without_the_steps_between_its_stretches(
        settings, monkeypatch):
    """Beyond 2^18 samples a healthy rig had 41 % of its flow unexplained, beta_e a tenth."""
    recording = stranger(3, **CALM)
    whole = answered([recording], settings)
    monkeypatch.setattr("eha_monitor.recordings.columns.IN_MEMORY", len(recording) * 2 // 3)
    monkeypatch.setattr("eha_monitor.recordings.recording.STRETCH", len(recording) // 6)
    part = answered([recording], settings)
    for balance, fit in part.signals.items():
        assert fit.before_rms < 1.3 * whole.signals[balance].before_rms + fit.noise_rms
    for name in ("F_c", "F_0"):
        all_, some = (one.baselines[0].force[name].value for one in (whole, part))
        assert some == pytest.approx(all_, rel=0.03)


def test_what_softer_oil_takes_up_is_seen_against_the_rate_of_the_pressure():
    """Flow by its equation, of an oil half as stiff as the healthy one, and a speed 5 ms late."""
    area, volume, pump, soft = 1.3e-3, 2.2e-4, 1e-6, 1.0 / 5e8
    config = settings_from_tree({"rig": {
        "area_1": area, "area_2": area, "volume_1": volume, "volume_2": volume, "mass": 100.0,
        "pump_displacement": pump, "position_gain": None, "leakage": 0.0,
        "makeup_conductance": 0.0, "charge_pressure": 1.3e6}}, "a test")
    rng, t = np.random.default_rng(2), np.arange(0.0, 20.0, 1e-3)
    x = 2e-2 * np.sin(2.0 * np.pi * 0.3 * t) + 4e-3 * np.sin(2.0 * np.pi * 1.1 * t + 1.0)
    v = np.gradient(x, t)
    force = 100.0 * np.gradient(v, t) + 3500.0 * v + 200.0 * np.tanh(v / 1e-3)
    head = np.abs(force) / area
    p1, p2 = (1.3e6 + np.where(way * force > 0.0, head, 0.0) for way in (1.0, -1.0))
    flow = area * v + np.sign(force) * volume * soft * np.gradient(head, t)
    noise = {"x": 1e-6, "omega": 1e-2, "p1": 500.0, "p2": 500.0}
    recording = Recording(1e-3, {name: values + noise[name] * rng.standard_normal(len(t))
                                 for name, values in (
                                     ("x", x), ("omega", np.interp(t - 5e-3, t, flow) / pump),
                                     ("p1", p1), ("p2", p2))})
    courses = [course_of(recording, config)]
    term = compressibility(courses[0], config.rig)
    assert abs(term.value - soft) < min(2.0 * term.stddev, 0.15 * soft)
    curve, fit = softened(courses, config.rig, 0.5 * soft, term.value)
    assert fit.after_rms < 0.3 * fit.before_rms
    slope = np.polyfit(curve.x, curve.measured, 1)[0]
    assert slope == pytest.approx((0.5 * soft - term.value) * volume, rel=0.15, abs=0.0)
    assert np.allclose(curve.modelled, (0.5 * soft - term.value) * volume * curve.x, rtol=0.05,
                       atol=0.02 * np.abs(curve.modelled).max())


def test_an_effect_of_the_config_that_makes_a_flow_which_is_not_there_is_told():
    """A stranger's check valve: by the data sheet it opens above what a healthy day has."""
    run = simulated(MULTISINE, 12.0)

    def said(effects):
        found = answered([run.recording(0)], run.config.model_copy(update={"effects": effects}))
        return [line for line in found.health if "of the config makes" in line]

    charge = run.config.rig.charge_pressure
    (line,) = said({"anti_cavitation": {"k": 3e-9, "p_min": 0.99 * charge}})
    assert line.startswith("anti cavitation") and "leave it out of the config" in line
    assert not said({"anti_cavitation": {"k": 3e-9, "p_min": 0.2 * charge}})
    assert not said({"cross_port_leakage": {"L": 2e-11}})  # which least squares have as well
