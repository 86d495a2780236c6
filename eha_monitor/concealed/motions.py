"""Demanded positions of the trial, continuous in time; corners fall on whole samples."""

import numpy as np

RAMP = 6e-3  # s, a step is a ramp of this length: the sampled demand then hides nothing
# rich: two triangles, multisine, steps; short: the same parts; triangle and sine: the paper's own;
# two_speed: the paper's triangle, then a slow one.
LENGTHS = {"rich": 24.0, "short": 6.0, "triangle": 24.0, "two_speed": 24.0, "sine": 8.0}


def triangle(t: np.ndarray, period: float, amplitude: float) -> np.ndarray:
    """Return a triangle from 0, rising first; m."""
    phase = np.mod(t / period + 0.25, 1.0)
    return amplitude * (1.0 - 4.0 * np.abs(phase - 0.5))


def multisine(t: np.ndarray, duration: float, amplitude: float, rng) -> np.ndarray:
    """Return tones from about 0.4 to 28 Hz, periodic in ``duration``, from 0 to 0; m."""
    lines = np.unique(np.round(np.geomspace(0.4, 28.0, 14) * duration).clip(min=1))
    phases = rng.uniform(0.0, 2 * np.pi, len(lines))
    weights = (lines / lines[0]) ** -0.35
    wave = np.zeros_like(t)
    for line, phase, weight in zip(lines, phases, weights, strict=True):
        wave += weight * (np.sin(2 * np.pi * line * t / duration + phase) - np.sin(phase))
    return amplitude * wave / weights.sum()


def steps(t: np.ndarray, duration: float, amplitude: float, each: float, rng) -> np.ndarray:
    """Return steps to random places on alternate sides, the last back to 0; m."""
    count = round(duration / each)
    sides = np.where(np.arange(count - 1) % 2 == 0, 1.0, -1.0)
    places = np.concatenate(
        [[0.0], amplitude * sides * rng.uniform(0.3, 1.0, count - 1), [0.0]])
    corners = np.arange(count) * each
    at = np.column_stack([corners, corners + RAMP]).ravel()
    return np.interp(t, at, np.column_stack([places[:-1], places[1:]]).ravel())


def demanded_position(motion: str, t: np.ndarray, seed: int = 0, scale: float = 1.0) -> np.ndarray:
    """Return x_d(t) in m; before 0 the demand rests at its first value.

    Parameters
    ----------
    motion : a key of ``LENGTHS``.
    t : any shape, s.
    seed : phases of the multisine and places of the steps.
    scale : factor on all amplitudes.
    """
    t = np.maximum(t, 0.0)
    if motion == "triangle":
        return scale * triangle(t, 4.0, 0.04)
    if motion == "sine":
        return scale * 0.01 * np.sin(2 * np.pi * 4.0 * t)
    if motion == "two_speed":
        return scale * np.where(t < 12.0, triangle(t, 4.0, 0.04), triangle(t, 4.0, 0.008))
    # Parts: fast triangle, slow triangle, multisine, steps, as (length, shape).
    rng = np.random.default_rng([seed, 77])
    tones, places = rng.spawn(2)
    if motion == "rich":
        parts = (
            (8.0, lambda u: triangle(u, 4.0, 0.04)),
            (4.0, lambda u: triangle(u, 4.0, 0.008)),
            (8.0, lambda u: multisine(u, 8.0, 0.036, tones)),
            (4.0, lambda u: steps(u, 4.0, 0.008, 0.4, places)),
        )
    elif motion == "short":
        parts = (
            (2.0, lambda u: triangle(u, 2.0, 0.02)),
            (1.0, lambda u: triangle(u, 1.0, 0.002)),
            (2.0, lambda u: multisine(u, 2.0, 0.036, tones)),
            (1.0, lambda u: steps(u, 1.0, 0.008, 0.2, places)),
        )
    else:
        raise ValueError(f"motion: expected {', '.join(LENGTHS)}, got {motion!r}")
    out = np.zeros_like(t)
    start = 0.0
    for length, shape in parts:
        here = (t >= start) & (t < start + length)
        out[here] = shape(t[here] - start)
        start += length
    return scale * out
