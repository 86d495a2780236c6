"""The diagnosis of short records from the concealed plant, whose equations are not the fit's."""

import numpy as np
import pytest

from eha_monitor.concealed.cases import Case
from eha_monitor.concealed.generate import nominal_config, recording_of
from eha_monitor.concealed.motions import multisine, triangle
from eha_monitor.mismatch.diagnose import diagnose
from eha_monitor.mismatch.diagnosis import VERDICTS
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.load import settings_from_tree

TIME = np.arange(3500) * 1e-3
MOTION = np.where(TIME < 2.0, triangle(TIME, 2.0, 0.02),
                  multisine(TIME - 2.0, 1.5, 0.036, np.random.default_rng(0)))
DRY = {"coulomb_friction", "presliding_friction", "stribeck_friction", "pressure_friction",
       "asymmetric_friction"}


def case_of(*effects, demand=MOTION, **options) -> Case:
    return Case("test", tuple((name, 1.0) for name in effects), motion="short", seed=3,
                demand=demand, **options)


def diagnosed(case: Case, **options):
    channels, time = recording_of(case)
    settings = settings_from_tree(nominal_config(case), "nominal")
    found = diagnose([Recording(time[1] - time[0], channels, 0, "case")], settings,
                     calibrate=False, **options)
    assert found.verdict in VERDICTS and found.message
    total = sum(found.location.balance.values())
    assert total == pytest.approx(1.0) or (total == 0 and found.verdict in (
        "consistent", "insufficient_data"))
    return found


def test_clean_record_is_consistent():
    told = []
    found = diagnosed(case_of(), progress=lambda text, share: told.append((text, share)))
    assert found.verdict == "consistent" and found.effects == () and found.config_effects == {}
    assert found.after["B"].value == pytest.approx(600.0, rel=0.02)
    assert found.after["beta_e"].value == pytest.approx(6e8, rel=0.02)
    assert found.health == ()
    shares = [share for _, share in told]
    assert shares == sorted(shares) and shares[0] >= 0 and shares[-1] <= 1.0


def test_worn_clean_rig_is_consistent_and_its_wear_is_read():
    """What the monitor is there to find is no mismatch: B and beta_e differ from the config's."""
    found = diagnosed(case_of(rig={"B": 900.0, "beta_e": 4.5e8}))
    assert found.verdict == "consistent" and found.effects == ()
    assert found.after["B"].value == pytest.approx(900.0, rel=0.02)
    assert found.after["beta_e"].value == pytest.approx(4.5e8, rel=0.02)


def test_coulomb_friction_is_named_and_b_is_freed_of_it():
    found = diagnosed(case_of("coulomb_friction"))
    assert found.verdict == "mismatch" and found.explained > 0.9
    first, *more = found.effects
    assert not more
    assert first.name == "coulomb_friction" or (
        first.name in DRY and "coulomb_friction" in first.indistinguishable_from)
    assert set(first.indistinguishable_from) <= DRY
    assert found.location.balance["force"] > 0.6
    assert found.before["B"].value > 800.0
    assert found.after["B"].value == pytest.approx(600.0, rel=0.03)
    assert any("not wear" in sentence for sentence in found.health)
    assert found.signals["position"].after_rms < found.signals["position"].before_rms
    assert set(found.config_effects) == {first.name}


def test_pressure_offset_is_a_sensor_s_and_no_physics():
    found = diagnosed(case_of("pressure_offset", options={"pressure_offset": {"sensor": "p1"}}))
    assert found.verdict == "mismatch"
    assert "pressure_offset" in {name for effect in found.effects
                                 for name in (effect.name, *effect.indistinguishable_from)}
    assert {effect.balance for effect in found.effects} == {"sensor"}
    assert max(found.location.balance, key=found.location.balance.get) == "sensor"


def test_drive_lag_is_the_drive_s():
    found = diagnosed(case_of("drive_lag"))
    assert found.verdict == "mismatch" and [e.name for e in found.effects] == ["drive_lag"]
    assert found.location.balance["drive"] > 0.6
    lag = found.effects[0].parameters["tau"]
    assert lag.value > 0 and lag.stddev < 0.1 * lag.value


def test_what_no_entry_explains_is_said_to_be_unexplained_and_where_it_is():
    """A load that acts between two stops with a gap: no such entry in the catalogue."""
    found = diagnosed(case_of("gapped_load", demand=None))
    assert found.verdict == "unexplained"
    assert found.location.balance["force"] > 0.6
    assert found.config_effects == {} or found.explained < 0.75
    assert "no entry of the catalogue" in found.message
    assert any(curve.balance == "force" for curve in found.curves)


def test_standstill_is_insufficient_data():
    found = diagnosed(case_of(demand=np.zeros(1500)))
    assert found.verdict == "insufficient_data" and found.effects == ()
    assert "nothing can be told" in found.message
    assert found.before == {} and found.after == {}
