"""Where a measured force presses the piston against a stop, and no balance of the model holds."""

import numpy as np

from eha_monitor.recordings.columns import spans_of

OVER = 0.04  # s over which the velocity is taken
STANDS = 0.05  # of the largest speed: slower is standing
LASTING = 0.03  # s: a shorter stand is a reversal
PRESSES = 2.0  # times the median force in motion: more than friction holds, so a stop does
NEAR = 0.1  # of the stroke: a stop gives way, and the force turns round there


def between_stops(x: np.ndarray, force: np.ndarray, dt: float) -> list[tuple[int, int]]:
    """Return the parts of a record that are away from every stop; all of it where none is.

    A piston that stands at an end of its way, under a force far beyond what moves it, is held by a
    stop.  What lies nearer to it than ``NEAR`` of the stroke is left out.

    Parameters
    ----------
    x, force : (n,) m and N, NaN where missing.
    dt : sample time, s.

    Returns
    -------
    (first, last) of each part; ``last`` is not in it.
    """
    measured = np.isfinite(x) & np.isfinite(force)
    reach, every = max(1, round(0.5 * OVER / dt)), np.arange(len(x))
    if len(x) < 4 * reach or not measured.any():
        return [(0, len(x))]
    x, force = (np.interp(every, every[measured], one[measured]) for one in (x, np.abs(force)))
    speed = np.pad(np.abs(x[2 * reach :] - x[: -2 * reach]), reach, mode="edge")
    top, near = np.quantile(speed, 0.998), NEAR * np.ptp(x)
    moves = np.median(force[speed >= 0.5 * top])
    held = (speed < STANDS * top) & ((x < x.min() + near) | (x > x.max() - near))
    places = [float(np.median(x[a:b])) for a, b in zip(*spans_of([(0, held)]), strict=True)
              if (b - a) * dt >= LASTING and np.median(force[a:b]) > PRESSES * moves]
    if not places:
        return [(0, len(x))]
    away = np.all(np.abs(x[:, None] - np.array(places)) > near, axis=1)
    return [(int(a), int(b)) for a, b in zip(*spans_of([(0, away)]), strict=True)]
