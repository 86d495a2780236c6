"""Gram matrices of sensitivities under other gains of the filter, without running it again.

Innovations and their sensitivities under gains K are a linear map of those under gains K': the
filter's state differs by delta, which the linearised plant carries on,

    e' = e - H delta,   delta+ = A (delta + K' e' - K e)

(the error recursion of two filters of one model).  So each level of the unknowns costs a pass over
the columns, no run of the plant, and only products are kept.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from eha_monitor.compiled import njit
from eha_monitor.estimation.small_matrices import copied
from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.likelihood.fit import Fit, spread
from eha_monitor.mismatch.likelihood.gains import (
    Unknowns,
    expected_covariance,
    gains_of,
    linear_of,
)
from eha_monitor.mismatch.likelihood.innovations import N_FILTERED

BLOCK = 1024  # samples whose products are taken at once


@dataclass(frozen=True)
class Gram:
    """Products of whitened columns at one level of the unknowns."""

    unknowns: Unknowns  # the level
    products: np.ndarray  # (m, m) Gram matrix of the whitened columns, innovations first
    counts: np.ndarray  # (c,) samples in each channel
    logdet: float  # sum over the samples of log det S / 2 that the filter expects


class Regained(NamedTuple):
    """The linearised plant under old and new gains.

    a : (N, N), h : (c, N) of the plant; old, new : (., N, c) gains; w : (c, c) weights.
    """

    a: np.ndarray
    h: np.ndarray
    old: np.ndarray
    new: np.ndarray
    w: np.ndarray


@njit(nogil=True)
def mapped(columns, missing, regained, first, delta, out):
    """Write columns under new gains, weighed by ``w``, from sample ``first`` on.

    Parameters
    ----------
    columns : (n, c, m) under the old gains; NaN nowhere.
    missing : (n, c) bool, what was not measured.
    delta : (N, m) by how much the filters' states differ at ``first``; left as at the end.
    out : (samples, c, m) written; 0 where nothing was measured, before it is weighed.
    """
    a, h, old, new, w = regained
    _, channels, m = columns.shape
    states = a.shape[0]
    other, fresh = np.zeros((states, m)), np.zeros((channels, m))
    for k in range(first, first + len(out)):
        k_old, k_new = old[min(k, old.shape[0] - 1)], new[min(k, new.shape[0] - 1)]
        for j in range(channels):
            if missing[k, j]:
                fresh[j] = 0.0
                continue
            for lane in range(m):
                fresh[j, lane] = columns[k, j, lane]
            for i in range(states):
                value = h[j, i]
                if value != 0.0:
                    for lane in range(m):
                        fresh[j, lane] -= value * delta[i, lane]
        for i in range(states):
            for j in range(channels):
                if missing[k, j]:
                    continue
                up, down = k_new[i, j], k_old[i, j]
                if up != 0.0 or down != 0.0:
                    for lane in range(m):
                        delta[i, lane] += up * fresh[j, lane] - down * columns[k, j, lane]
        for i in range(states):
            other[i] = 0.0
            for j in range(states):
                value = a[i, j]
                if value != 0.0:
                    for lane in range(m):
                        other[i, lane] += value * delta[j, lane]
        for i in range(states):
            copied(delta[i], other[i])
        for i in range(channels):
            row = out[k - first, i]
            row[:] = 0.0
            for j in range(channels):
                value = w[i, j]
                if value != 0.0:
                    for lane in range(m):
                        row[lane] += value * fresh[j, lane]


@njit(nogil=True)
def powers_at(e, missing, counted, a, h, old, new, w):
    """Return the squared whitened innovations under new gains, summed, (L,); see :func:`mapped`.

    Levels stand side by side: one pass over the samples does for all.

    Parameters
    ----------
    e : (n, c) under the old gains, NaN nowhere.
    new : (., N, c, L) gains; w : (c, c, L).
    """
    n, channels = e.shape
    states, levels = a.shape[0], w.shape[2]
    delta, other = np.zeros((states, levels)), np.zeros((states, levels))
    fresh, row, total = np.zeros((channels, levels)), np.zeros(levels), np.zeros(levels)
    for k in range(n):
        k_old, k_new = old[min(k, old.shape[0] - 1)], new[min(k, new.shape[0] - 1)]
        for j in range(channels):
            if missing[k, j]:
                fresh[j] = 0.0
                continue
            for lane in range(levels):
                fresh[j, lane] = e[k, j]
            for i in range(states):
                value = h[j, i]
                if value != 0.0:
                    for lane in range(levels):
                        fresh[j, lane] -= value * delta[i, lane]
        for i in range(states):
            for j in range(channels):
                if not missing[k, j]:
                    down = k_old[i, j] * e[k, j]
                    for lane in range(levels):
                        delta[i, lane] += k_new[i, j, lane] * fresh[j, lane] - down
        for i in range(states):
            other[i] = 0.0
            for j in range(states):
                value = a[i, j]
                if value != 0.0:
                    for lane in range(levels):
                        other[i, lane] += value * delta[j, lane]
        delta, other = other, delta
        if counted[k]:
            for i in range(channels):
                row[:] = 0.0
                for j in range(i + 1):
                    for lane in range(levels):
                        row[lane] += w[i, j, lane] * fresh[j, lane]
                for lane in range(levels):
                    total[lane] += row[lane] * row[lane]
    return total


def expected_whitener(experiment: Experiment, fit: Fit, level: Unknowns
                      ) -> tuple[np.ndarray, np.ndarray]:
    """Return the gains at a level, and W with W S W' = 1 of the S that they lead to expect."""
    gains = gains_of(experiment, fit.theta, fit.active, level)
    s = expected_covariance(experiment, fit.theta, fit.active, level, gains)
    return gains, np.linalg.inv(np.linalg.cholesky(0.5 * (s + s.T)))


def evidences_at(experiment: Experiment, fit: Fit, present: list[np.ndarray],
                 levels: Sequence[Unknowns]) -> np.ndarray:
    """Return the likelihood of innovations (n, c) at other levels, with the expected S, (L,).

    present : of each stretch as :func:`columns.runs_of` gives them, rows contiguous.
    """
    used = experiment.columns
    found, able, gains, whitening = np.full(len(levels), -np.inf), [], [], []
    for i, level in enumerate(levels):
        try:
            one, w = expected_whitener(experiment, fit, level)
        except np.linalg.LinAlgError:
            continue
        able.append(i)
        whitening.append(w)
        gains.append(one[:, :, used])
    if not able:
        return found
    linear = linear_of(experiment, fit.theta, fit.active, levels[able[0]])
    longest = max(map(len, gains))
    new = np.stack([np.concatenate([one, np.repeat(one[-1:], longest - len(one), axis=0)])
                    for one in gains], axis=3)
    w = np.stack(whitening, axis=2)
    old, h = np.ascontiguousarray(fit.gains[:, :, used]), np.ascontiguousarray(linear.h[used])
    total = np.zeros(len(able))
    for stretch, part in zip(experiment.stretches, present, strict=True):
        missing = ~np.isfinite(part)
        power = powers_at(np.nan_to_num(part), missing, stretch.counted, linear.a, h, old, new, w)
        count = (~missing[stretch.counted]).sum(axis=0)
        total += -0.5 * power + count @ np.log(np.einsum("iil->il", w))
    found[able] = total
    return found


def under(experiment: Experiment, fit: Fit, columns: list[np.ndarray], gains: np.ndarray
          ) -> list[np.ndarray]:
    """Return columns of a fit under other gains, (n, c, m) SI for each stretch, 0 if missing."""
    used = experiment.columns
    linear = linear_of(experiment, fit.theta, fit.active, fit.unknowns)
    found = []
    for part in columns:
        out = np.empty_like(part)
        mapped(np.nan_to_num(part), ~np.isfinite(part[:, :, 0]), Regained(
            linear.a, np.ascontiguousarray(linear.h[used]),
            np.ascontiguousarray(fit.gains[:, :, used]), np.ascontiguousarray(gains[:, :, used]),
            np.eye(len(used))), 0, np.zeros((len(linear.a), part.shape[2])), out)
        found.append(out)
    return found


def grams_of(experiment: Experiment, fit: Fit, columns: list[np.ndarray],
             levels: list[Unknowns], copies: Sequence[tuple[int, float]] = ()) -> list[Gram]:
    """Return the Gram matrices of columns at some levels of the unknowns.

    Parameters
    ----------
    fit : where the columns were taken, under its gains.
    columns : for each stretch (n, c, m) in SI; NaN where nothing was measured.
    copies : (place, factor) of further columns that are others times a factor.
    """
    used = experiment.columns
    missing = [~np.isfinite(part[:, :, 0]) for part in columns]
    m = columns[0].shape[2]

    def one(level: Unknowns) -> Gram | None:
        linear = linear_of(experiment, fit.theta, fit.active, level)
        try:
            gains, w = expected_whitener(experiment, fit, level)
        except np.linalg.LinAlgError:
            return None
        products, counts = np.zeros((m, m)), np.zeros(len(used))
        old, new, h = (np.ascontiguousarray(part) for part in (
            fit.gains[:, :, used], gains[:, :, used], linear.h[used]))
        block = np.empty((BLOCK, len(used), m))
        for stretch, part, gone in zip(experiment.stretches, columns, missing, strict=True):
            counts += (~gone[stretch.counted]).sum(axis=0)
            delta = np.zeros((len(linear.a), m))
            regained = Regained(linear.a, h, old, new, w)
            for first in range(0, len(part), BLOCK):
                out = block[: min(BLOCK, len(part) - first)]
                mapped(part, gone, regained, first, delta, out)
                counted = stretch.counted[first : first + len(out)]
                rows = (out if counted.all() else out[counted]).reshape(-1, m)
                products += rows.T @ rows
        logdet = -float(counts @ np.log(np.diag(w)))
        return Gram(level, products, counts, logdet)

    return [extended(gram, copies) for gram in spread(one, levels) if gram is not None]


def extended(gram: Gram, copies: Sequence[tuple[int, float]]) -> Gram:
    """Return the Gram matrix with columns that are others times a factor."""
    if not copies:
        return gram
    m = len(gram.products)
    places = np.array([*range(m), *(place for place, _ in copies)])
    factors = np.array([*np.ones(m), *(factor for _, factor in copies)])
    products = gram.products[np.ix_(places, places)] * np.outer(factors, factors)
    return replace(gram, products=products)


@njit(nogil=True)
def injected(forcing, missing, a, h, gains, into, out):
    """Write what unit inputs to the linearised plant do to a filter's innovations.

    Parameters
    ----------
    forcing : (n, m) each input over the sample that begins there.
    into : (N, m) what a unit of it adds to the state over a sample.
    a, h, gains : as in :func:`mapped`, gains (., N, c).
    out : (n, c, m) written; NaN where nothing was measured.
    """
    n, m = forcing.shape
    states, channels = a.shape[0], h.shape[0]
    delta = np.zeros((states, m))
    other = np.zeros((states, m))
    for k in range(n):
        gain = gains[min(k, gains.shape[0] - 1)]
        for j in range(channels):
            if missing[k, j]:
                out[k, j] = 0.0
                continue
            for lane in range(m):
                total = 0.0
                for i in range(states):
                    total -= h[j, i] * delta[i, lane]
                out[k, j, lane] = total
        for i in range(states):
            for j in range(channels):
                if not missing[k, j] and gain[i, j] != 0.0:
                    for lane in range(m):
                        delta[i, lane] += gain[i, j] * out[k, j, lane]
        for i in range(states):
            for lane in range(m):
                other[i, lane] = into[i, lane] * forcing[k, lane]
            for j in range(states):
                value = a[i, j]
                if value != 0.0:
                    for lane in range(m):
                        other[i, lane] += value * delta[j, lane]
        delta, other = other, delta


def carried(linear_a: np.ndarray, place: int) -> np.ndarray:
    """Return what a unit of an unknown, held over a sample, adds to the plant's state, (N,)."""
    into = linear_a[:, place].copy()
    into[5:N_FILTERED] = 0.0
    return into
