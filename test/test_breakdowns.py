"""No valid recording ends in exit 2 or 70: strangers' rigs of every kind, drawn from seeds.

Single rods, gravity, 500 Hz, digital hold, 12 bits, gauge pressures, play.
"""

import pytest
from strangers.draw import KINDS, LAWS, draw_rig
from strangers.generate import recorded, settings_of

from eha_monitor.api.read import checked
from eha_monitor.estimation.pipeline import estimate
from eha_monitor.mismatch.compared import compared
from eha_monitor.mismatch.diagnose import diagnose

REFERENCES = 5


def run(task, rig, seconds):
    """Run a task on short recordings of a rig: the numbers, one or several explained, a change."""
    settings = settings_of(rig)
    count = {"together": 3, "reference": REFERENCES + 1}.get(task, 1)
    recordings = [recorded(rig, rig.settings[k % len(rig.settings)], k, seconds)
                  for k in range(count)]
    checked(recordings, settings)
    if task == "estimate":
        assert estimate(recordings[0], settings).parameters["B"].status
    elif task == "reference":
        assert compared(recordings[:1], recordings[1:], settings).verdict
    else:
        assert diagnose(recordings, settings).verdict


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("kind", KINDS)
def test_estimates_of_drawn_rigs_end_well(kind, law):
    run("estimate", draw_rig(41, list(LAWS).index(law), kind, law), 4.0)


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("task", ["diagnose", "together", "reference"])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("i", range(8))
def test_diagnoses_of_drawn_rigs_end_well(kind, task, i):
    run(task, draw_rig(42, i, kind), 6.0)
