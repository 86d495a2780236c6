"""The mean of both pressures against the make-up path: a leak to ambient, or a wrong source."""

import warnings

import numpy as np
import pytest
from strangers.draw import draw_rig
from strangers.generate import recorded, settings_of

from eha_monitor.balances.answer import answered

CHARGE = 1.2e6


@pytest.fixture(scope="module")
def rig():
    """A rig of another simulator with equal areas and case leaks that no sheet knows."""
    return draw_rig(1301, 3)


def found_with(rig, charge, **tolerance):
    settings = settings_of(rig)
    settings = settings.model_copy(update={"rig": settings.rig.model_copy(update={
        "charge_pressure": charge, "tolerance": settings.rig.tolerance.model_copy(
            update=tolerance)})})
    return answered([recorded(rig, rig.settings[0], 0, 8.0)], settings)


def test_a_low_mean_pressure_is_a_leak_to_ambient_as_large_as_it_must_be(rig):
    leak = next(e for e in found_with(rig, CHARGE, makeup_conductance=1.3).effects
                if e.name == "external_leakage")
    assert "charge_pressure" in leak.indistinguishable_from
    # G (p_c - p) = L (p - p_a), and the true G: the sheet's is known to its tolerance only.
    true, mean = rig.plant, found_mean(rig)
    closed = true.makeup * (CHARGE - mean) / (mean - 101325.0)
    value = leak.parameters["L_1"]
    assert value.value == pytest.approx(closed * rig.sheet.makeup / true.makeup, rel=0.05)
    assert abs(np.log(value.value / (0.5 * (true.case_leakage + true.case_leakage_2)))) < 1.1


def test_a_leak_whose_size_nobody_knows_is_not_named(rig):
    """A path that is known to a factor of 3, or 10: its size would be 6 ± 7, or 6 ± 15."""
    for factor in (3.0, 10.0):
        found = found_with(rig, CHARGE, makeup_conductance=factor)
        assert "external_leakage" not in {e.name for e in found.effects}
        (source,) = [one for one in found.rig_data if one.key == "charge_pressure"]
        assert source.found.value == pytest.approx(found_mean(rig), rel=0.05)
        assert "external_leakage" in source.indistinguishable_from and "below" in source.statement
        for effect in found.effects:  # and so of every other
            assert max(abs(v.value) / max(v.stddev, 1e-300) for v in effect.parameters.values()
                       ) > 3.0


def found_mean(rig):
    recording = recorded(rig, rig.settings[0], 0, 8.0)
    return 0.5 * float(np.mean(recording.channels["p1"] + recording.channels["p2"]))


def test_what_the_tolerance_of_the_source_covers_is_no_leak(rig):
    found = found_with(rig, 1.3 * found_mean(rig))
    assert "external_leakage" not in {e.name for e in found.effects}
    assert "charge_pressure" not in {one.key for one in found.rig_data}


def test_a_high_one_is_the_sources_pressure_where_both_are_above_it(rig):
    found = found_with(rig, 0.2 * found_mean(rig))
    (wrong,) = [one for one in found.rig_data if one.key == "charge_pressure"]
    assert wrong.found.value == pytest.approx(found_mean(rig), rel=0.05)


def test_where_the_lower_pressure_comes_down_to_the_source_it_may_be_check_valves(rig):
    recording = recorded(rig, rig.settings[0], 0, 8.0)
    lower = np.minimum(recording.channels["p1"], recording.channels["p2"])
    assert np.quantile(lower, 0.05) < 0.6 * found_mean(rig)
    found = found_with(rig, float(np.quantile(lower, 0.05)))
    assert "charge_pressure" not in {one.key for one in found.rig_data}


def test_a_source_without_pressure_is_compared_with_nothing(rig):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = found_with(rig, 0.0)
    assert "charge_pressure" not in {one.key for one in found.rig_data}
