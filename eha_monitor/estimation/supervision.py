"""Watching a parameter that is held constant: has it changed, and how far to trust its sigma.

An extended Kalman filter with a constant parameter forgets nothing, so it reaches the
Cramer-Rao bound, and it would also never follow a change.  Its own innovations tell when to
forget: with h = P_sp/P_pp, the sensitivity of the state error to the parameter error, the score
U = sum h nu/S and the information J = sum h^2/S of a window estimate a local change delta = U/J
with variance 1/J (generalised likelihood ratio over windows, Willsky and Jones 1976).
"""

import math

import numpy as np

from eha_monitor.compiled import njit

BLOCK = 100  # samples between two looks
HISTORY = 64  # blocks that a window may span
DETECTION = 6.0  # standard deviations; 1e-9 a look under the model
SMALLEST = 0.002  # relative change worth an event
FAR = 10.0  # prior sigmas that a parameter may travel in all
HOPS = 6  # changes from which on hopping to and fro is told from a fault that grows
RECENT = 10  # blocks before a detected change that may owe their size to it
OUTLYING = 9.0  # normalised square of such a block
TRUST = 1.5  # score variance ratio below which sigma stands as it is

# Places in the supervision vector.
(SCORE, INFORMATION, BLOCKS, RATIO_SUM, RATIO_COUNT, CHANGES, NET, TRAVEL, FROZEN,
 SLOW, CAPPED_SUM, SAMPLES, SPIKED) = range(13)
# SLOW: running mean of the velocity, stage one's instrument; SAMPLES: taken since the start of the
# block; SPIKED: lone wild ones in a row.  So a stage that stops goes on as if it had not.
HEAD = 13
N_SUPERVISION = HEAD + 3 * HISTORY  # then scores, informations, normalised squares of past blocks


HELD = 2.0  # at FROZEN: the parameter is not even estimated, only its uncertainty carried along


def new_supervision(frozen: bool = False) -> np.ndarray:
    """Return the (N_SUPERVISION,) state of a fresh watch; a frozen one sees no changes."""
    w = np.zeros(N_SUPERVISION)
    w[FROZEN] = 1.0 if frozen else 0.0
    return w


@njit(allocates=False)
def astray(w, prior_variance):
    """Tell whether the changes seen are no fault but a model that does not fit.

    A wrong model makes the parameter follow the motion, to and fro, or run away: a piston that
    is held still by an unknown load has infinite damping.  To chase that is worse than an
    average with an honest sigma.
    """
    return w[CHANGES] >= HOPS and (
        abs(w[NET]) < 0.5 * w[TRAVEL] or w[TRAVEL] > FAR * math.sqrt(prior_variance))


def gave_up(w: np.ndarray) -> bool:
    """Tell whether the watch stopped looking for changes because they led astray."""
    return bool(w[FROZEN] == 1.0 and w[CHANGES] >= HOPS)


@njit(allocates=False)
def score_ratio(w):
    """Mean square of the normalised block scores; 1 where the model and its noise are right."""
    if w[RATIO_COUNT] < 5.0:
        return 1.0
    return w[RATIO_SUM] / w[RATIO_COUNT]


@njit(allocates=False)
def honest_factor(w):
    """Factor on the filter's sigma that its own score asks for (1 while the ratio is < TRUST)."""
    ratio = score_ratio(w)
    return math.sqrt(ratio) if ratio > TRUST else 1.0


@njit(allocates=False)
def forgive_recent(w):
    """Take out of the ratio what a change, seen only now, has put into the last blocks."""
    for j in range(1, min(int(w[BLOCKS]), RECENT)):
        square = w[HEAD + 2 * HISTORY + j]
        if square > OUTLYING:
            w[RATIO_SUM] = max(w[RATIO_SUM] - square, 0.0)
            w[CAPPED_SUM] = max(w[CAPPED_SUM] - OUTLYING, 0.0)
            w[RATIO_COUNT] = max(w[RATIO_COUNT] - 1.0, 0.0)


@njit(allocates=False)
def look(w, value, variance, prior_variance):
    """Close a block; return (delta, information, samples) of a detected change, or zeros.

    Parameters
    ----------
    w : (N_SUPERVISION,) updated.
    value, variance : the parameter and its filter variance.
    prior_variance : before any data; a change is sought only once nine tenths of it are gone.
    """
    score, information = w[SCORE], w[INFORMATION]
    w[SCORE] = 0.0
    w[INFORMATION] = 0.0
    if variance > 0.1 * prior_variance or information <= 0.0:
        return 0.0, 0.0, 0
    blocks = int(w[BLOCKS])
    for i in range(min(blocks, HISTORY - 1), 0, -1):  # newest block first
        w[HEAD + i] = w[HEAD + i - 1]
        w[HEAD + HISTORY + i] = w[HEAD + HISTORY + i - 1]
        w[HEAD + 2 * HISTORY + i] = w[HEAD + 2 * HISTORY + i - 1]
    square = score * score / (information * (1.0 + information * variance))
    w[HEAD] = score
    w[HEAD + HISTORY] = information
    w[HEAD + 2 * HISTORY] = square
    w[BLOCKS] = min(blocks + 1, HISTORY)

    # Each block counts for at most OUTLYING here: a drift that is not yet seen must not raise the
    # threshold by which it is to be seen.
    ratio = 1.0
    if w[RATIO_COUNT] >= 5.0:
        ratio = max(1.0, w[CAPPED_SUM] / w[RATIO_COUNT])
    total_score, total_information = 0.0, 0.0
    for i in range(int(w[BLOCKS])):
        total_score += w[HEAD + i]
        total_information += w[HEAD + HISTORY + i]
        if (i & (i + 1)) != 0:  # windows of 1, 2, 4, ... blocks
            continue
        if total_information * prior_variance < 1.0:
            continue  # what knows less of it than the prior shows no change, and its leap is wild
        spread = total_information * (1.0 + total_information * variance) * ratio
        delta = total_score / total_information
        if w[FROZEN] == 0.0 and total_score * total_score > DETECTION * DETECTION * spread and abs(
            delta
        ) > SMALLEST * abs(value):
            forgive_recent(w)
            w[BLOCKS] = 0.0
            w[CHANGES] += 1.0
            w[NET] += delta
            w[TRAVEL] += abs(delta)
            if astray(w, prior_variance):
                w[FROZEN] = 1.0
            return delta, total_information, (i + 1) * BLOCK
    if w[RATIO_COUNT] >= 300.0:  # forget slowly: half a minute at 1 kHz
        w[RATIO_SUM] *= 0.5
        w[CAPPED_SUM] *= 0.5
        w[RATIO_COUNT] *= 0.5
    w[RATIO_SUM] += square
    w[CAPPED_SUM] += min(square, OUTLYING)
    w[RATIO_COUNT] += 1.0
    return 0.0, 0.0, 0
