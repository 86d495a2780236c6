"""Clean records of the package's own simulator must name nothing, whatever gains on them."""

import numpy as np
import pytest
from rig_tools import TRIANGLE, settings, simulated

from eha_monitor.mismatch.diagnose import diagnose


def night(number: int, seconds: float):
    """Diagnose a triangle on a rig that drifts from night to night; returns also the rig."""
    rig = {"viscous_damping": 600.0 * (1.0 + 0.005 * number),
           "bulk_modulus": 6e8 * (1.0 - 0.004 * number)}
    run = simulated(TRIANGLE, seconds, rig=rig)
    return diagnose([run.recording(number)], settings()), rig


def check(number: int, seconds: float) -> None:
    found, rig = night(number, seconds)
    assert (found.verdict, found.effects) == ("consistent", ()), number
    assert np.isclose(found.after["B"].value, rig["viscous_damping"], rtol=0.01)


def test_a_clean_triangle_names_nothing():
    check(1, 12.0)


def test_what_a_filter_answers_of_several_recordings_has_their_machine():
    """``diagnose A B C --machine FILE`` saves it; where a filter answers it was a traceback."""
    run = simulated(TRIANGLE, 5.0)
    found = diagnose([run.recording(seed) for seed in range(3)], settings())
    assert found.verdict == "consistent" and len(found.belonging.sources) == 3


@pytest.mark.parametrize("seconds, rows", [(5.0, slice(None)), (24.0, slice(2000, 4000))])
def test_a_clean_slow_sine_names_nothing(seconds, rows):
    """In slow motion a soft fluid under a large unknown flow looks as likely, from far off."""
    sine = {"kind": "sine", "amplitude": 0.03, "frequency": 0.3}
    recording = simulated(sine, seconds).recording(1)
    recording = recording.part(rows.start or 0, rows.stop or len(recording))
    found = diagnose([recording], settings())
    assert (found.verdict, found.effects) == ("consistent", ())
    beta = found.after["beta_e"]
    assert abs(beta.value - 6e8) < 3.0 * beta.stddev


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_clean_triangles_of_drifting_rigs_name_nothing():
    """Of five such nights two named a relief valve, 26 log units each."""
    for number in range(6):
        check(number, 24.0)


def test_a_leak_in_slow_motion_is_no_soft_oil():
    """Where B and beta_e alone make up for it, and a narrow valley leads no further."""
    sine = {"kind": "sine", "amplitude": 0.02, "frequency": 0.4}
    leaking = simulated(sine, 20.0, effects={"cross_port_leakage": {"L": 4e-12}})
    found = diagnose([leaking.recording(1)], settings())
    oil = found.after["beta_e"]
    assert abs(oil.value - 600e6) < 2.0 * oil.stddev < 400e6
    (leak,) = (one for one in found.rig_within if one.key == "leakage")
    assert abs(leak.found.value - 8.5e-12) < 3.0 * leak.found.stddev
