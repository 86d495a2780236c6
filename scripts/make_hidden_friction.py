"""Make bags/hidden_friction: an actuator whose seals have 40 N of dry friction.

    python scripts/make_hidden_friction.py [BAG]

The plant is not the model that ``diagnose`` fits: two chambers with states of their own, bristle
seals, an encoder, sensors that lag and a clock that jitters (eha_monitor/concealed).  Rig and
sensors are the paper's otherwise, so the bag is diagnosed without a config.
"""

import sys
from pathlib import Path

import numpy as np

from eha_monitor.concealed.cases import SAMPLE_TIME, Case, multisine, steps, triangle
from eha_monitor.concealed.generate import nominal_config, recording_of
from eha_monitor.recordings.recording import Recording
from eha_monitor.recordings.write import write_recording
from eha_monitor.settings.load import settings_from_tree

START_NS = 1_700_000_000_000_000_000


def demand() -> np.ndarray:
    """Return 11 s of x_d in m: triangles fast and slow, tones, steps.

    The diagnosis keeps the last fifth of every 5 s back: here a slow triangle and tones.
    """
    rng = np.random.default_rng(3)
    t = np.arange(round(1.0 / SAMPLE_TIME)) * SAMPLE_TIME

    def lasting(seconds: int) -> np.ndarray:
        return np.arange(seconds * len(t)) * SAMPLE_TIME

    return np.concatenate([
        triangle(lasting(2), 2.0, 0.02), multisine(lasting(2), 2.0, 0.03, rng),
        triangle(lasting(2), 2.0, 0.004), steps(lasting(1), 1.0, 0.008, 0.2, rng),
        triangle(lasting(1), 1.0, 0.01), multisine(lasting(2), 2.0, 0.03, rng),
        triangle(lasting(1), 1.0, 0.002)])


def main() -> None:
    """Write the bag."""
    case = Case("hidden_friction", (("coulomb_friction", 1.0),), demand=demand(), seed=5)
    target = Path(sys.argv[1] if len(sys.argv) > 1
                  else Path(__file__).parents[1] / "bags" / "hidden_friction")
    channels, _ = recording_of(case)
    settings = settings_from_tree(nominal_config(case), "case")
    write_recording(target, Recording(SAMPLE_TIME, channels, START_NS), settings, overwrite=True)
    size = sum(path.stat().st_size for path in target.iterdir())
    print(f"{target}: {len(channels['x']) * SAMPLE_TIME:g} s, {size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
