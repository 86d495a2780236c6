"""Least squares on Gram matrices, with the signs that physics demands and dependent samples.

With columns D, (n, k), and a right side y every fit below needs only D'D, D'y and y'y, so that
recordings are added and left out by adding and subtracting small matrices.
"""

from collections.abc import Sequence

import numpy as np
from scipy.special import log_ndtr

CUT = 0.05  # of the autocorrelation of a residual, below which it is noise
NULL = 1e-10  # of the largest eigenvalue: directions below have no data
ROUNDS = 50  # of exchanges between free and held; a handful is usual
UPDATES, SETTLED = 200, 0.02  # of a spread; by so much of a deviation of the mean


def rms(values: Sequence[float]) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def signed_solution(gram: np.ndarray, side: np.ndarray, signs: np.ndarray,
                    least: np.ndarray | None = None) -> np.ndarray:
    """Return the weights w with the least 1/2 w'Gw - g'w within their signs, (k,).

    Lawson and Hanson's active set (1974, chapter 23) on the Gram matrix.

    Parameters
    ----------
    gram : (k, k) D'D.
    side : (k,) D'y.
    signs : (k,) 1 for w >= 0, -1 for w <= 0, 0 for either.
    least : (k,) bounds in place of those 0.
    """
    if least is not None and np.any(least):
        return least + signed_solution(gram, side - gram @ least, signs)
    k = len(side)
    size = np.sqrt(np.maximum(np.diag(gram), 1e-300)) * np.where(signs < 0, -1.0, 1.0)
    gram, side = gram / np.outer(size, size), side / size
    bounded = signs != 0
    free = ~bounded
    w = np.zeros(k)
    w[free] = minimum_norm(gram[np.ix_(free, free)], side[free])
    for _ in range(ROUNDS):
        slope = side - gram @ w
        slope[free] = -np.inf
        enters = int(np.argmax(slope)) if k else 0
        if not k or slope[enters] <= 1e-12 * max(1.0, float(np.abs(side).max())):
            break
        free[enters] = True
        while True:
            trial = np.zeros(k)
            trial[free] = minimum_norm(gram[np.ix_(free, free)], side[free])
            out = free & bounded & (trial <= 0.0)
            if not out.any():
                break
            fall = np.where(out, w - trial, 1.0)
            share = np.where(out, w / np.where(fall > 0.0, fall, 1.0), np.inf)
            step = min(float(share.min()), 1.0)
            w = w + step * (trial - w)
            free &= ~(out & (share <= step) | bounded & (w <= 0.0))
            w[~free] = 0.0
        w = trial
    return w / size


def random_effects(products: np.ndarray, signs: np.ndarray, least: np.ndarray, start: np.ndarray
                   ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the mean of parameters that differ from recording to recording, spread, covariance.

    w_i ~ N(w, T), T diagonal (Laird, Ware 1982), and each recording says of its own w_i no more
    than its Gram matrix P_i holds, which need not be regular: with W_i = (P_i^-1 + T)^-1

        H = sum W_i,    w = argmin 1/2 w'Hw - w' sum W_i w_i  within the signs,    cov w = H^-1,

    and T of the restricted likelihood by minorisation (Zhou, Hu, Zhou, Lange 2019): T_jj grows or
    falls by the root of sum (W_i (w_i - w))_j^2 over its expectation.

    Parameters
    ----------
    products : (r, k, 1 + k) of each recording's columns with its y and themselves, over the
        variance of an independent sample.
    signs, least : (k,) as of :func:`signed_solution`.
    start : (k,) spread with which the iteration begins, SI, > 0.

    Returns
    -------
    tuple
        (k,) mean, (k,) spread between recordings, (k, k) covariance of the mean, infinite along
        what no recording says.
    """
    k = len(start)
    if not k:
        return np.zeros(0), np.zeros(0), np.zeros((0, 0))
    grams, sides = products[:, :, 1:], products[:, :, 0]
    size = np.sqrt(np.maximum(grams.sum(axis=0).diagonal(), 1e-300))
    grams, sides = grams / np.outer(size, size), sides / size
    spread = np.maximum(start * size, 1.0)
    for _ in range(UPDATES):
        share = np.linalg.solve(np.eye(k) + spread[:, None] * grams * spread,
                                spread[:, None] * np.concatenate(
                                    [grams, sides[:, :, None]], axis=2))
        whole = grams @ (spread[:, None] * share)
        weight, right = grams - whole[:, :, :k], sides - whole[:, :, k]
        total = weight.sum(axis=0)
        w = signed_solution(total, right.sum(axis=0), signs, least * size)
        inverse = inverse_of(total)
        known = np.where(np.isfinite(inverse), inverse, 0.0)
        score = ((right - weight @ w) ** 2).sum(axis=0)
        expected = (weight - weight @ known @ weight).diagonal(axis1=1, axis2=2).sum(axis=0)
        before, spread = spread, spread * np.clip(np.sqrt(
            score / np.maximum(expected, 1e-12)), 0.2, 5.0)
        if np.all(np.abs(spread - before) <= SETTLED * spread.clip(1.0)):
            break
    return w / size, np.where(spread > SETTLED, spread, 0.0) / size, inverse / np.outer(
        size, size)


def minimum_norm(gram: np.ndarray, side: np.ndarray) -> np.ndarray:
    """Return the weights of the normal equations; none along directions without data.

    Parameters
    ----------
    side : (k,), or (k, s) for several right sides.
    """
    if not len(side):
        return side.copy()
    try:
        factor = np.linalg.cholesky(gram)
        if np.diag(factor).min() ** 2 > NULL * len(side):
            return np.linalg.solve(gram, side)
    except np.linalg.LinAlgError:
        pass
    return np.linalg.lstsq(gram, side, rcond=NULL)[0]


def weights_of(gram: np.ndarray, side: np.ndarray) -> np.ndarray:
    """Return :func:`minimum_norm` whatever the columns' units."""
    size = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    return (minimum_norm(gram / np.outer(size, size), (side.T / size).T).T / size).T


def beside(values: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return what no combination of columns (n, k) makes of values, (n,)."""
    return values - columns @ weights_of(columns.T @ columns, columns.T @ values)


def inverse_of(gram: np.ndarray) -> np.ndarray:
    """Return the inverse of a Gram matrix, (k, k); infinite variances where there are no data."""
    size = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    values, vectors = np.linalg.eigh(gram / np.outer(size, size))
    kept = values > NULL * values.max(initial=0.0)
    inverse = (vectors[:, kept] / values[kept]) @ vectors[:, kept].T
    unknown = (vectors[:, ~kept] ** 2).sum(axis=1) > NULL
    inverse[unknown, unknown] = np.inf
    return inverse / np.outer(size, size)


def from_absent(values: Sequence[float], covariance: np.ndarray, which: Sequence[bool]) -> float:
    """Return how far some terms together are from absent, in standard deviations.

    Two shapes of one seal's friction share it as chance has it: neither may be sure where their
    sum is.

    Parameters
    ----------
    values, covariance, which : (k,) SI; (k, k); (k,) the terms of a family.
    """
    known = np.isfinite(np.diag(covariance))  # of what no recording shows nothing is apart
    own = np.flatnonzero(np.asarray(which, dtype=bool) & known)
    w = np.asarray(values)[own]
    return float(np.sqrt(max(w @ inverse_of(covariance[np.ix_(own, own)]) @ w, 0.0)))


def independent(residual: np.ndarray) -> float:
    """Return how many samples of a residual count as one: 1 + 2 sum rho_k, at least 1.

    The sum ends where the autocorrelation first falls below ``CUT`` (Bartlett 1946; Geyer 1992).

    Parameters
    ----------
    residual : (n,) on a uniform grid; NaN where not compared.
    """
    there = np.isfinite(residual)
    if there.sum() < 8:
        return float(max(there.sum(), 1))
    r = np.where(there, residual - residual[there].mean(), 0.0)
    size = 1 << int(np.ceil(np.log2(2 * len(r))))
    spectrum, mask = np.fft.rfft(r, size), np.fft.rfft(there.astype(float), size)
    products = np.fft.irfft(np.abs(spectrum) ** 2, size)[: len(r)]
    counts = np.fft.irfft(np.abs(mask) ** 2, size)[: len(r)]
    rho = products / np.maximum(counts, 1.0)
    rho = rho / max(rho[0], 1e-300)
    below = np.flatnonzero((rho < CUT) | (counts < 0.25 * there.sum()))
    last = int(below[0]) if len(below) else len(rho)
    return float(max(1.0, 1.0 + 2.0 * rho[1:last].sum()))


def unexcluded(columns: np.ndarray, column: np.ndarray, left: np.ndarray, noise: float,
               positive: bool = False) -> tuple[np.ndarray, float, float, float]:
    """Return what a column, whose weight is N(0, 1), makes of a fit that has not got it.

    The weight's posterior has the information z'Mz/noise + 1, with M the residual maker of the
    columns; a parameter moves by -(X'X)^-1 X'z of it.

    Parameters
    ----------
    columns : (n, k) X; ``column`` (n,) z; ``left`` (n,) residual of the fit without it.
    noise : variance of what is left, times the samples that count as one.
    positive : the weight is half-normal.

    Returns
    -------
    how far each parameter goes with a weight of 1, (k,); mean and variance of the weight; the log
    of its evidence, 0 for a fit without the column.
    """
    moves = np.linalg.lstsq(columns, column, rcond=None)[0]
    own = column - columns @ moves
    variance = 1.0 / (1.0 + float(own @ own) / max(noise, 1e-300))
    weight = variance * float(own @ left) / max(noise, 1e-300)
    evidence = 0.5 * (weight**2 / variance + float(np.log(variance)))
    if positive:  # moments of the normal truncated at 0
        at = weight / np.sqrt(variance)
        evidence += float(log_ndtr(at) + np.log(2.0))
        ratio = float(np.exp(-0.5 * at**2 - log_ndtr(at)) / np.sqrt(2.0 * np.pi))
        weight, variance = (weight + np.sqrt(variance) * ratio,
                            variance * max(1.0 - at * ratio - ratio**2, 0.0))
    return -moves, float(weight), float(variance), evidence
