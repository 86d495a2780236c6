"""The oracle of a trial: told the effects, but of the rig no more than the config's tolerances."""

from dataclasses import replace

import pytest
from mismatch_tools import recorded

from eha_monitor.concealed.cases import Case, truth_of
from eha_monitor.mismatch.data.experiment import experiment_of
from eha_monitor.mismatch.name.columns import rig_free
from eha_monitor.mismatch.policy import POLICY
from eha_monitor.prove.oracle import RigNumbers, oracle
from eha_monitor.settings.rig import Tolerance

MASS = 20.0  # kg, of the paper's rig
SURE = 20.0  # log units: what counts as detectable


def asked(case: Case, tolerances: dict | None = None) -> dict:
    """Return the oracle's answer for a case, with the tolerances of a config."""
    recording, settings = recorded(case)
    tolerance = settings.rig.tolerance.model_copy(update=tolerances or {})
    rig = settings.rig.model_copy(update={"tolerance": tolerance})
    return oracle([recording], settings.model_copy(update={"rig": rig}), truth_of(case))


def short(*effects: tuple[str, float], **options) -> Case:
    """Return a case of 6 s."""
    return Case("test", effects, motion="short", seed=3, **options)


def test_an_effect_within_a_tolerance_cannot_be_seen():
    """0.6 kg more, where the mass is known to 1 kg: only who knows the mass sees it."""
    more = 0.6 * Tolerance().mass * MASS
    case = short(("added_mass", 1.0), options={"added_mass": {"dM": more}}, noise=0.5)
    exact = dict.fromkeys(set(Tolerance.model_fields) - {"leakage", "makeup_conductance"}, 1e-5)
    assert asked(case)["log_evidence"]["added_mass"] < 2.0
    assert asked(case, exact)["log_evidence"]["added_mass"] > 10.0 * SURE


def test_what_no_tolerance_explains_keeps_its_evidence():
    """Friction, and a leakage of which the config says a hundredth."""
    case = short(("coulomb_friction", 1.0), nominal={"C_T": 1.2e-13},
                 rig={"C_T": 1e-11}, noise=3.0)
    found = asked(case)
    assert set(found["log_evidence"]) == {"coulomb_friction"}
    assert found["log_evidence"]["coulomb_friction"] > 10.0 * SURE
    assert found["rig_evidence"]["leakage"] > 10.0 * SURE
    assert found["signals"]["position"]["after_rms"] < found["signals"]["position"]["before_rms"]


def test_a_twin_stays_at_the_config_s_and_what_is_wrong_has_a_wide_prior():
    recording, settings = recorded(short())
    experiment = experiment_of([recording], settings)
    within = {f.name: f for f in rig_free(experiment)}
    free = {f.name: f for f in RigNumbers(experiment, frozenset({"volume"})).free(
        ("added_mass", "coulomb_friction"))}
    assert set(within) - set(free) == {"rig.mass"}
    for key in ("rig.volume_1", "rig.volume_2"):
        assert free[key].spread == pytest.approx(POLICY.wrong * within[key].spread)
    assert free["rig.leakage"] == within["rig.leakage"]
    assert "rig.mass" in {f.name for f in RigNumbers(experiment).free(())}


def test_an_effect_outside_the_catalogue_is_none_of_the_oracle_s():
    found = asked(replace(short(), effects=(("pump_ripple", 1.0),)))
    assert found["log_evidence"] == {} and found["rig_evidence"] == {}
