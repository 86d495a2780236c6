"""One machine from several recordings: known simulated truth, and a real one on two days."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from machine_tools import machine_of, stranger, stranger_settings
from rig_tools import D_P, K_POS, MULTISINE, REST, real, simulated
from rig_tools import settings as rig_settings

from eha_monitor.balances.alone import alone
from eha_monitor.balances.answer import Asked, first_answer
from eha_monitor.balances.candidates import Scale, candidates_of, stop, taken_up
from eha_monitor.balances.changed import against
from eha_monitor.balances.discrepancy import learned
from eha_monitor.balances.judge import judge
from eha_monitor.balances.least_squares import random_effects
from eha_monitor.balances.machine import load, save
from eha_monitor.balances.measured import course_of
from eha_monitor.balances.policy import POLICY
from eha_monitor.balances.table import tables_of
from eha_monitor.balances.together import Recordings, pooled, without
from eha_monitor.balances.warmth import healthy_at
from eha_monitor.commands.answers import diagnose as command
from eha_monitor.errors import InputError
from eha_monitor.mismatch.compared import compared
from eha_monitor.recordings.write import write_recording

LOADS = (338.0, 120.0, 560.0, 250.0)


@pytest.fixture(scope="module")
def settings(tmp_path_factory):
    return stranger_settings(tmp_path_factory.mktemp("rig"))


@pytest.fixture(scope="module")
def recordings():
    return [stranger(seed, rise=0.0, damping=(1500.0, 1500.0), load=one, seconds=16.0)
            for seed, one in enumerate(LOADS)]


@pytest.fixture(scope="module")
def machine(recordings, settings):
    return machine_of(recordings, settings)


def test_at_most_twenty_numbers_decide():
    assert len(POLICY.to_dict()) <= 20
    assert all(name in type(POLICY).__doc__ for name in POLICY.to_dict())


def test_a_stop_holds_at_rest_and_turns_over_its_reach():
    x = np.concatenate([np.linspace(0, 1, 101), np.full(50, 1.0), np.linspace(1, 0.5, 51)])
    z = stop(x, 0.1)
    assert z[100] == 1.0 and (z[100:150] == 1.0).all()
    assert z[150 + 11] == pytest.approx(-0.1, abs=0.11) and z[-1] == -1.0


def test_a_one_sided_load_is_met_again_after_its_slack():
    x = np.concatenate([np.linspace(0.2, 0, 201), np.linspace(0, 0.2, 201),
                        np.linspace(0.2, 0.1, 101)])
    load = taken_up(x, 0.05, 0.005)
    assert load[:201].max() == 0.0 and load[220] == 0.0 and load[400] == 1.0
    assert load[420:].max() == 0.0  # it lets go at once


def test_reduced_products_are_those_of_the_residuals():
    rng = np.random.default_rng(0)
    rows = rng.standard_normal((50, 6))
    out = rows[:, 4:]
    left = rows[:, :4] - out @ np.linalg.lstsq(out, rows[:, :4], rcond=None)[0]
    np.testing.assert_allclose(without(rows.T @ rows, [0, 1, 2, 3], [4, 5]), left.T @ left)


def test_errors_of_recordings_left_out_are_those_of_separate_fits(recordings, settings):
    courses = [course_of(one, settings) for one in recordings]
    candidates = tuple(c for c in candidates_of("force", Scale.of(courses), settings.rig)
                       if c.name in ("B", "F_0", "F_c"))
    tables = tables_of(courses, settings.rig, "force", candidates, POLICY)
    found = Recordings(tables).errors(["B", "F_c"])
    for i, table in enumerate(tables):
        used = [0, table.places["B"], table.places["F_c"]]
        others = [(t.rows[t.good][:, used] * np.sqrt(t.weight))
                  for j, t in enumerate(tables) if j != i]
        stacked = np.concatenate(others)
        w = np.linalg.lstsq(stacked[:, 1:], stacked[:, 0], rcond=None)[0]
        mine = table.rows[table.good][:, used]
        expected = np.sqrt(np.mean((mine[:, 0] - mine[:, 1:] @ w) ** 2)) / table.size
        assert found[i] == pytest.approx(expected, rel=1e-6)


def test_spread_between_recordings_is_found():
    rng = np.random.default_rng(5)
    noise = rng.uniform(0.5, 1.5, 400)
    each = 10.0 + 3.0 * rng.standard_normal(400) + noise * rng.standard_normal(400)
    value, between, stddev = pooled(each, noise, np.nan)
    assert between == pytest.approx(3.0, rel=0.15)
    assert abs(value - 10.0) < 3.0 * stddev and stddev == pytest.approx(3.2 / 20.0, rel=0.2)
    assert pooled(np.full(8, 2.0), np.full(8, 0.1), np.nan)[1] == 0.0


def test_random_effects_are_the_closed_form_of_a_balanced_design():
    each, sigma = np.random.default_rng(1).normal(5.0, 2.0, 12), 0.5
    products = np.column_stack([each, np.ones(12)])[:, None, :] / sigma**2
    value, between, covariance = random_effects(
        products, np.zeros(1), np.zeros(1), np.ones(1))
    assert value[0] == pytest.approx(each.mean(), rel=1e-9)
    assert between[0] == pytest.approx(np.sqrt(each.var(ddof=1) - sigma**2), rel=0.01)
    assert covariance[0, 0] == pytest.approx(each.var(ddof=1) / 12, rel=0.04)


def test_what_no_recording_tells_alone_all_of_them_do():
    # Each at one speed of its own: B and a load are one number there, and two over all of them.
    rng, speeds, sigma = np.random.default_rng(2), np.linspace(0.1, 0.3, 9), 0.1
    rows = np.column_stack([speeds, np.ones(9)])
    y = rows @ [300.0, 20.0] + sigma * rng.standard_normal(9)
    products = rows[:, :, None] * np.column_stack([y, rows])[:, None, :] / sigma**2
    value, _, covariance = random_effects(
        products, np.zeros(2), np.zeros(2), np.array([60.0, 4.0]))
    stddev, whole = np.sqrt(np.diag(covariance)), np.linalg.inv(products[:, :, 1:].sum(axis=0))
    assert value == pytest.approx([300.0, 20.0], abs=3.0 * stddev.max())
    assert stddev == pytest.approx(np.sqrt(np.diag(whole)), rel=0.6)
    assert covariance[0, 1] / stddev.prod() == pytest.approx(
        whole[0, 1] / np.sqrt(whole.diagonal().prod()), abs=0.05)


def test_a_number_that_differs_between_recordings_is_not_the_joint_fits():
    # As B with its oil: a shared B would make friction bend to hold the differences.
    rng, v = np.random.default_rng(3), np.linspace(-0.1, 0.1, 200)
    rows, bend = np.column_stack([v, np.sign(v)]), 40.0 * np.sign(v) * np.exp(-np.abs(v) / 0.03)
    own = 3000.0 + 200.0 * rng.standard_normal(8)
    y = [b * v + 80.0 * np.sign(v) + bend + 0.05 * rng.standard_normal(200) for b in own]
    products = np.array([rows.T @ np.column_stack([one, rows]) for one in y]) / 0.05**2
    alone = np.array([np.linalg.solve(one[:, 1:], one[:, 0]) for one in products])
    value, between, covariance = random_effects(products, np.ones(2), np.zeros(2),
                                                np.array([600.0, 16.0]))
    assert value == pytest.approx(alone.mean(axis=0), rel=1e-3)
    assert between[0] == pytest.approx(own.std(ddof=1), rel=0.02)
    assert covariance[0, 0] == pytest.approx(own.var(ddof=1) / 8, rel=0.04)


def test_gain_is_a_log_ratio_with_its_t():
    table = SimpleNamespace(candidates=(), gram=np.eye(1), weight=1.0, good=np.ones(9, bool),
                            moving=9)
    rest = SimpleNamespace(**vars(table) | {"moving": 0})
    mean, t = Recordings([table] * 3).gain(np.array([2.0, 2.0, 2.2]), np.array([1.0, 1.0, 1.0]))
    # A recording in which nothing moves has no say.
    assert Recordings([table, table, rest]).gain(
        np.array([2.0, 2.0, 1.0]), np.array([1.0, 1.0, 9.0]))[0] == pytest.approx(np.log(2.0))
    assert mean == pytest.approx(np.log([2.0, 2.0, 2.2]).mean())
    assert t == pytest.approx(mean * np.sqrt(3) / np.log([2.0, 2.0, 2.2]).std(ddof=1))


def test_a_machine_of_known_truth(machine):
    force = {p.name: p for p in machine["force"].parameters}
    assert machine["force"].named and machine["force"].named[0].terms[0].startswith("F_")
    assert force["B"].value == pytest.approx(1500.0, abs=3.0 * force["B"].stddev + 15.0)
    dry = next(p for name, p in force.items() if p.effect in (
        "coulomb_friction", "presliding_friction"))
    assert dry.value == pytest.approx(180.0, rel=0.03)
    loads = next(s for s in machine["force"].settings if s.name == "F_0")
    np.testing.assert_allclose(loads.value, LOADS, atol=4.0)
    assert loads.varies and machine.load_varied
    assert not machine.odd
    assert machine["force"].unexplained < 0.05


def test_a_recording_that_does_not_belong(recordings, settings):
    other = stranger(9, dry=270.0, rise=0.0, damping=(2500.0, 2500.0), seconds=16.0)
    found = machine_of([*recordings, replace(other, source="other")], settings)
    assert [one.source for one in found.odd] == ["other"]


def test_the_next_recording_is_judged(machine, settings, tmp_path):
    save(machine, tmp_path / "machine.json")
    kept = load(tmp_path / "machine.json", settings.rig)
    assert kept == machine
    like = stranger(20, rise=0.0, damping=(1500.0, 1500.0), load=400.0, seconds=16.0)
    judged = judge(kept, [course_of(like, settings)], settings)
    assert judged.belongs and judged.settings["F_0"][0] == pytest.approx(400.0, abs=4.0)
    worn = stranger(21, dry=260.0, rise=0.0, damping=(1500.0, 1500.0), seconds=16.0)
    found = judge(kept, [course_of(worn, settings)], settings)
    assert not found.belongs
    assert found.changed[0].candidate.effect in ("coulomb_friction", "presliding_friction")
    assert found.changed[0].here == pytest.approx(260.0, rel=0.03)
    assert found.explained and found.balances[0].after < 0.5 * found.balances[0].error


def test_a_damping_that_alone_has_changed_has_a_place():
    healthy = simulated(MULTISINE, 6.0)
    known = machine_of([replace(healthy.recording(seed), source=f"{seed}") for seed in range(3)],
                       healthy.config)
    worn = simulated(MULTISINE, 6.0, rig={"viscous_damping": 800.0}).recording(9)
    found = against(known, [worn], healthy.config, known.sources)
    assert found.verdict == "mismatch" and [one.what for one in found.changes] == ["B"]
    assert found.location.balance["force"] == 1.0
    assert found.changes[0].now.value == pytest.approx(800, rel=0.01)


def test_a_leakage_is_told_as_it_is_whatever_the_config_holds():
    healthy, told = simulated(MULTISINE, 6.0), []
    worn = simulated(MULTISINE, 6.0, effects={"cross_port_leakage": {"L": 2e-12}}).recording(9)
    for leakage in (healthy.config.rig.leakage, 4.0 * healthy.config.rig.leakage):
        config = simulated(MULTISINE, 6.0, rig={"leakage": leakage}).config
        known = machine_of([replace(healthy.recording(seed), source=f"{seed}")
                            for seed in range(3)], config)
        change = next(one for one in against(known, [worn], config, known.sources).changes
                      if one.what == "cross_port_leakage")
        assert change.now.value - change.reference.value == pytest.approx(2e-12, rel=0.03)
        assert change.statement.startswith("leakage across the piston is")
        told.append(change.reference.value)
    assert told[0] > 0.0 and told[1] == pytest.approx(told[0], rel=0.05)


def test_a_damping_that_the_warmth_would_cover_is_compared_at_one_temperature(settings):
    law = settings.viscosity

    def warm(seed, temperature, damping=1500.0, measured=True):
        b = damping * np.exp(-law.coefficient * (temperature - law.reference_temperature))
        found = stranger(seed, rise=0.0, damping=(b, b), seconds=16.0)
        if measured:
            found.channels["temperature"] = np.full(len(found), temperature)
        return found

    for measured in (True, False):
        healthy = [warm(seed, degrees, measured=measured)
                   for seed, degrees in enumerate((32.0, 40.0, 48.0, 56.0))]
        known = machine_of(healthy, settings)
        hot = against(known, [warm(10, 60.0, measured=measured)], settings, known.sources)
        worn = against(known, [warm(11, 45.0, 2300.0, measured)], settings, known.sources)
        assert hot.verdict == "consistent"
        assert [one.what for one in worn.changes] == (["B"] if measured else [])
        if measured:
            b = 1500.0 * np.exp(-law.coefficient * (45.0 - law.reference_temperature))
            assert worn.changes[0].reference.value == pytest.approx(b, rel=0.05)


def test_a_machine_is_compared_by_the_config_that_it_was_made_with(recordings, settings, tmp_path):
    """Beside the config of a diagnosis its lag was that of both, 7.99 ms for 4: a change."""
    known = machine_of(recordings, settings)
    save(known, tmp_path / "machine.json")
    known = load(tmp_path / "machine.json", settings.rig)
    other = settings.model_copy(update={
        "effects": {"coulomb_friction": {"F_c": 150.0, "v_e": 1e-3}},
        "rig": settings.rig.model_copy(update={"mass": 1.1 * settings.rig.mass})})
    here = stranger(20, rise=0.0, damping=(1500.0, 1500.0), seconds=16.0)
    by_own, by_other = (against(known, [here], one, known.sources) for one in (settings, other))
    assert by_own.verdict == by_other.verdict == "consistent"
    assert by_own.message == by_other.message


@pytest.mark.parametrize("lowest", [[], [5e5, 5.1e5, 5e5, 5e5], None])
def test_a_machine_of_an_older_version_is_read(machine, settings, tmp_path, lowest):
    """Its lowest pressures were of both chambers as one; an empty list where none was known."""
    save(machine, tmp_path / "machine.json")
    data = json.loads((tmp_path / "machine.json").read_text())
    del data["lowest"], data["effects"], data["numbers"], data["scale"]["relaxed"]
    data |= {} if lowest is None else {"lowest": lowest}
    (tmp_path / "machine.json").write_text(json.dumps(data))
    known = load(tmp_path / "machine.json", settings.rig)
    assert known.lowest == ((), ()) and known.scale.relaxed == machine.scale.origin
    assert known.as_made(settings) is settings


def test_cold_oil_of_another_law_is_no_worn_machine(settings):
    """27 degrees beside 36 to 46: B was called changed, though the temperature was measured."""
    steeper = 1.3 * settings.viscosity.coefficient  # than the config's, which is nobody's oil

    def warm(seed, temperature, worn=1.0):
        b = worn * 1500.0 * np.exp(-steeper * (temperature - 40.0))
        found = stranger(seed, rise=0.0, damping=(b, b), seconds=16.0)
        found.channels["temperature"] = np.full(len(found), temperature)
        return found

    known = machine_of([warm(seed, degrees) for seed, degrees in enumerate(
        (36.5, 39.0, 41.0, 43.5, 46.0))], settings)
    cold, worn = (against(known, [warm(10 + i, 27.0, grown)], settings, known.sources)
                  for i, grown in enumerate((1.0, 1.5)))
    assert cold.verdict == "consistent" and [one.what for one in worn.changes] == ["B"]
    b = 1500.0 * np.exp(13.0 * steeper)
    assert cold.before["B"].value == pytest.approx(b, rel=0.05)
    assert healthy_at(known, np.nan) is None
    alike = replace(known, viscosity=(1.0,) * 5)  # where they say nothing of the law, it is 30 %
    at = healthy_at(alike, np.exp(0.5))
    assert at.law == pytest.approx(0.15) and at.stddev > 0.15 * at.value


def test_a_leakage_that_the_warmth_would_cover_is_compared_at_one_temperature():
    """A cylinder that leaked three times as much was "nothing has changed" beside 37 to 46 C."""
    def warm(seed, temperature, worn=1.0):
        more = worn * np.exp(0.03 * (temperature - 40.0))
        found = simulated(MULTISINE, 12.0, rig={"leakage": 4e-12 * more}).recording(seed)
        found.channels["temperature"] = np.full(len(found), temperature)
        return found

    config = rig_settings(rig={"leakage": 4e-12})
    known = machine_of([warm(seed, degrees) for seed, degrees in enumerate(
        (36.5, 39.0, 41.0, 43.5, 46.0))], config)
    hot, worn = (against(known, [warm(10 + i, degrees, grown)], config, known.sources)
                 for i, (degrees, grown) in enumerate(((55.0, 1.0), (38.0, 1.5))))
    assert hot.verdict == "consistent"
    (change,) = worn.changes
    assert (change.what, change.balance) == ("cross_port_leakage", "flow")
    assert "at the temperature of its oil" in change.statement


def test_a_pump_of_another_size_is_said_to_be_of_another_machine():
    run = simulated(MULTISINE, 12.0)
    known = machine_of([run.recording(seed) for seed in range(4)], run.config)
    other = simulated(MULTISINE, 12.0, rig={
        "pump_displacement": 2.5 * D_P, "position_gain": K_POS / 2.5}).recording(9)
    found = against(known, [other], run.config, known.sources)
    assert any("whether it is a recording of this machine" in line for line in found.health)
    again = against(known, [run.recording(9)], run.config, known.sources)
    assert not any("of this machine" in line for line in again.health)


def test_the_balances_compare_first_whatever_the_config_holds():
    healthy, effect = simulated(MULTISINE, 6.0), {"quadratic_friction": {"a_1": 1.0}}
    worn = simulated(MULTISINE, 6.0, rig={"viscous_damping": 800.0}).recording(9)
    found = compared([worn], [healthy.recording(seed) for seed in range(4)],
                     healthy.config.model_copy(update={"effects": effect}))
    assert [one.what for one in found.changes] == ["B"]
    assert found.machine is not None and "position" not in found.signals  # no filter was asked


def test_a_reference_that_stands_is_named_and_left_out():
    healthy, rest = simulated(MULTISINE, 6.0), simulated(REST, 6.0)
    standing = replace(rest.recording(5), source="stands")
    moving = [replace(healthy.recording(seed), source=f"moves_{seed}") for seed in range(4)]
    worn = simulated(MULTISINE, 6.0, rig={"viscous_damping": 800.0}).recording(9)
    found = compared([worn], [moving[0], standing, *moving[1:]], healthy.config)
    (said,) = [line for line in found.advice if "stands" in line]
    assert "reference left out: stands: nothing moves in it" in said
    assert [one.what for one in found.changes] == ["B"]
    assert found.references == tuple(one.source for one in moving)
    assert not any("left out" in line for line in compared([worn], moving, healthy.config).advice)


def test_bad_machines_are_refused_in_one_line(settings, tmp_path):
    for text in ("{", '{"schema": "other"}', "[]", '{"schema": "eha_monitor/balances/1"}'):
        path = tmp_path / "bad.json"
        path.write_text(text)
        with pytest.raises(InputError, match="expected a machine") as said:
            load(path, settings.rig)
        assert "line 1" not in str(said.value) and str(path) in str(said.value)


@pytest.mark.parametrize("key", ["mass", "pump_displacement"])
def test_a_machine_of_another_size_is_refused_by_its_file(machine, settings, tmp_path, key):
    own = {"mass": 55.0, "pump_displacement": 8e-7}
    save(replace(machine, mass=own["mass"], displacement=own["pump_displacement"]),
         tmp_path / "machine.json")
    rig = settings.rig.model_copy(update=own | {key: 2.2 * own[key]})
    with pytest.raises(InputError, match=rf"machine\.json: a machine made with a .*"
                                         rf"{key.split('_')[-1]} of .*, expected that of"):
        load(tmp_path / "machine.json", rig)


def test_a_machine_of_other_areas_is_refused_by_its_file(machine, settings, tmp_path):
    save(machine, tmp_path / "machine.json")
    rig = settings.rig.model_copy(update={"area_1": 1.5 * settings.rig.area_1})
    with pytest.raises(InputError, match=r"machine\.json: a machine with areas of .*, expected"):
        load(tmp_path / "machine.json", rig)


def test_a_machine_that_does_not_say_its_areas_is_made_again(machine, settings, tmp_path):
    path = tmp_path / "machine.json"
    save(machine, path)
    old = json.loads(path.read_text())
    del old["areas"]  # as files were before they held them
    path.write_text(json.dumps(old))
    with pytest.raises(InputError) as problem:
        load(path, settings.rig)
    said = str(problem.value)
    assert f"{path}: a machine of an older version" in said and "make it again" in said
    assert f"--machine {path}" in said and machine.sources[0] in said and "\n" not in said


def test_what_repeats_is_learned_and_noise_is_not():
    rng = np.random.default_rng(2)
    signals = [rng.standard_normal((400, 3)) for _ in range(6)]
    good = [np.ones(400, dtype=bool)] * 6
    repeats = learned(signals, [np.sin(2.0 * z[:, 0]) * z[:, 1] for z in signals], good,
                      [1.0] * 6)
    noise = learned(signals, [rng.standard_normal(400) for _ in signals], good, [1.0] * 6)
    assert repeats.removed > 0.8 and noise.removed < 0.05


def test_one_recording_alone(recordings, settings):
    course = course_of(recordings[0], settings)
    (table,) = tables_of([course], settings.rig, "force", candidates_of(
        "force", Scale.of([course]), settings.rig, ()), POLICY)
    found = alone(table, POLICY)
    dry = [name for name in found.names if name.effect in (
        "coulomb_friction", "presliding_friction")]
    assert len(dry) == 1 and dry[0].probability <= POLICY.certain
    assert dry[0].value == pytest.approx(180.0, rel=0.05)
    assert found.error < 0.5 * found.nominal + 0.05
    assert table.effective < table.n
    assert POLICY.probability(1.0, np.inf) == pytest.approx(POLICY.certain, abs=0.01)


def test_the_command_writes_and_reads_a_machine(recordings, settings, tmp_path, monkeypatch):
    from click.testing import CliRunner

    config = tmp_path / "rig.yaml"
    stranger_settings(tmp_path)
    bags = [str(write_recording(tmp_path / f"run_{i}", one, settings))
            for i, one in enumerate(recordings)]
    file, answer = tmp_path / "machine.json", tmp_path / "answer.json"
    save(machine_of(recordings, settings), file)
    done = CliRunner().invoke(command, [bags[1], "--config", str(config), "--machine", str(file),
                                        "--json", str(answer)], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    tree = json.loads(answer.read_text())
    assert tree["verdict"] == "consistent"
    assert tree["machine"]["recordings"] == len(bags)
    again = CliRunner().invoke(command, [bags[1], "--config", str(config), "--reference",
                                         str(file)], catch_exceptions=False)
    assert again.output.splitlines()[1] == done.output.splitlines()[1]
    both = CliRunner().invoke(command, [bags[1], "--config", str(config), "--reference",
                                        str(file), "--reference", bags[0]])
    assert "machine.json alone" in str(both.exception)
    with pytest.raises(InputError, match="expected one recording"):
        import eha_monitor as em

        em.diagnose(bags, config, machine=file)


def test_friction_that_two_laws_share_is_told_as_one(settings):
    """100 N and 17 N that grow with pressure, of areas to 2 %: each alone was unsure of itself."""
    coarse = settings.rig.tolerance.model_copy(update={"area_1": 0.02, "area_2": 0.02})
    config = settings.model_copy(update={
        "rig": settings.rig.model_copy(update={"tolerance": coarse})})
    found = first_answer([
        stranger(seed, dry=100.0, rise=0.0, damping=(1500.0, 1500.0), load=load, seconds=16.0,
                 grows=1e-5) for seed, load in enumerate((300.0, 380.0, 500.0, 420.0))],
        config, Asked(None, None, (), ("load",)))
    (dry,) = [one for one in found.effects if "F_c" in one.parameters]
    assert dry.name == "coulomb_friction" and dry.parameters.keys() == {"F_c"}
    assert dry.parameters["F_c"].value == pytest.approx(117.0, abs=3.0)
    assert dry.parameters["F_c"].stddev < 10.0


def test_a_real_machine_on_two_days():
    files = [f"ivliev_eha_days/day_{day}_load_{load}_amplitude_4.csv.gz"
             for day in (18, 21) for load in (1, 2, 3, 4, 5)]
    recordings, settings = real("ivliev_eha", *files)
    first, second = (machine_of(part, settings, ("load",))
                     for part in (recordings[:5], recordings[5:]))
    for one in (first, second):  # the seals', and the loading cylinder's
        assert {"pressure_friction", "one_sided_load"} <= one["force"].effects
        assert one["force"].unexplained < 0.15 and one["flow"].unexplained < 0.25
    pumps = [next(p for p in one["flow"].parameters if p.name == "D_p") for one in (first, second)]
    assert pumps[0].value == pytest.approx(pumps[1].value, rel=0.05)
