"""No valid recording ends in exit 2 or 70: strangers' rigs of every kind, drawn from seeds."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "benchmarks"))

from breakdowns import ended

from eha_monitor.concealed.strangers.draw import KINDS, LAWS, draw_rig


@pytest.mark.parametrize("kind", KINDS)
def test_estimates_of_drawn_rigs_end_well(kind):
    for i, law in enumerate(LAWS):
        found = ended("estimate", draw_rig(41, i, kind, law), 4.0)
        assert found["status"] == 0, found


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("task", ["diagnose", "together", "reference"])
@pytest.mark.parametrize("kind", KINDS)
def test_diagnoses_of_drawn_rigs_end_well(kind, task):
    for i in range(8):
        found = ended(task, draw_rig(42, i, kind), 6.0)
        assert found["status"] == 0, found
