"""Two least-squares fits in numpy alone: importing scipy takes as long as the estimate."""

import itertools

import numpy as np

CUBIC = 4  # coefficients


def local_derivatives(x: np.ndarray, window: int, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Return x' and x'' of the cubic through each ``window`` samples (Savitzky and Golay 1964).

    Parameters
    ----------
    x : (n,) at least ``window`` samples.
    window : odd; the first and the last half of it are read from the outermost cubics.
    dt : s.

    Raises
    ------
    ValueError
        There are fewer samples.
    """
    if len(x) < window:
        raise ValueError(f"expected at least {window} samples, found {len(x)}")
    half = window // 2
    place = np.arange(-half, half + 1) / half
    fit = np.linalg.pinv(np.vander(place, CUBIC, increasing=True))  # (CUBIC, window)
    before, after = fit @ x[:window], fit @ x[-window:]
    found = []
    for order in (1, 2):
        inner = np.convolve(x, order * fit[order][::-1], mode="valid")
        ends = [np.polynomial.polynomial.polyval(
            part, np.polynomial.polynomial.polyder(cubic, order))
            for cubic, part in ((before, place[:half]), (after, place[half + 1:]))]
        found.append(np.concatenate([ends[0], inner, ends[1]]) / (half * dt) ** order)
    return found[0], found[1]


def fitted_with_signs(columns: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the weights that fit ``y`` best, all but the first of them not negative.

    Parameters
    ----------
    columns : (n, k), k a few: every choice of those that are 0 is tried, and the best is the
        answer, because the problem is convex.
    y : (n,).
    """
    k = columns.shape[1]
    size = np.sqrt(np.mean(columns**2, axis=0))
    unit = columns / np.where(size > 0.0, size, 1.0)
    gram, side = unit.T @ unit, unit.T @ y
    best, least = np.zeros(k), np.inf
    for kept in itertools.product((False, True), repeat=k - 1):
        taken = np.flatnonzero((True, *kept))
        part = np.linalg.lstsq(gram[np.ix_(taken, taken)], side[taken], rcond=None)[0]
        left = float(part @ gram[np.ix_(taken, taken)] @ part - 2.0 * part @ side[taken])
        if (part[1:] >= 0.0).all() and left < least:
            best, least = np.zeros(k), left
            best[taken] = part
    return best / np.where(size > 0.0, size, 1.0)
