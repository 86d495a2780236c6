"""Where nothing moves: there the stages have nothing to learn and nothing to be judged by.

A seal holds whatever load there is, which M x'' = F - B x' cannot say: to the filters a piston
that stands under a force has endless damping.  A piston that does not follow its drive is no rest.
"""

from collections.abc import Mapping

import numpy as np

from eha_monitor.estimation.results import NoiseEstimate

REST_S = 0.25  # s without motion that make a rest
RESTING = 1.5  # times the noise: the deviation over so long of what does not move
DRIVE, FORCE = ("x_d", "omega_d", "omega"), ("force", "p1", "p2")  # what moves a piston
SMALLEST = 1e-9  # of the largest value: the noise of a demand that holds none


def resting(channels: Mapping[str, np.ndarray], noise: Mapping[str, NoiseEstimate], dt: float,
            step: float) -> np.ndarray:
    """Return where neither the piston nor its drive has moved for ``REST_S``, (n,) bool.

    Parameters
    ----------
    channels : by name, (n,) SI, NaN where missing.
    noise : of the channels; ``step`` of the position, m.
    dt : s between samples.
    """
    moves = ([name for name in DRIVE if name in channels]
             or [name for name in FORCE if name in channels])
    count = max(round(REST_S / dt), 4)
    if "x" not in channels or len(channels["x"]) < count:
        return np.zeros(len(channels.get("x", ())), dtype=bool)
    found = np.ones(len(channels["x"]), dtype=bool)
    for name in ("x", *moves):
        level = noise[name].value if name in noise else 0.0
        if name == "x":
            level = max(level, step / np.sqrt(3.0))
        found &= _still(channels[name], count, level)
    return found


def _still(values: np.ndarray, count: int, level: float) -> np.ndarray:
    """Return where the last ``count`` values differ by no more than noise of that level."""
    there = np.isfinite(values)
    if not there.any():
        return np.ones(len(values), dtype=bool)
    level = max(level, SMALLEST * float(np.abs(values[there]).max()))
    plain = np.where(there, values - values[there][0], 0.0)
    known, first, second = (np.concatenate([[0.0], np.cumsum(one)])
                            for one in (there.astype(float), plain, plain**2))
    n, one, two = (total[count:] - total[:-count] for total in (known, first, second))
    still = two - one**2 / np.maximum(n, 1.0) <= (RESTING * level) ** 2 * n
    # Before the first window is whole, its own verdict stands.
    return np.concatenate([np.full(count - 1, still[0]), still])
