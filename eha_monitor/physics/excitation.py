"""Demanded positions: triangle, sine, multisine, chirp, steps, rest, a file."""

import warnings
from functools import lru_cache
from pathlib import Path

import numpy as np

from eha_monitor.errors import InputError
from eha_monitor.settings.rig import Segment


def demanded_position(segments: dict[str, Segment], time: np.ndarray) -> np.ndarray:
    """Return x_d(t) in m; the stretches follow one another and then repeat from the start.

    Parameters
    ----------
    segments : stretches by name, in order.
    time : any shape, seconds since the start.
    """
    ends = np.cumsum([segment.duration for segment in segments.values()])
    local = np.mod(time, ends[-1])
    which = np.searchsorted(ends, local, side="right").clip(max=len(ends) - 1)
    out = np.empty_like(local)
    for i, segment in enumerate(segments.values()):
        mask = which == i
        if mask.any():
            start = ends[i] - segment.duration
            out[mask] = segment.offset + shape(segment, local[mask] - start)
    return out


def total_duration(segments: dict[str, Segment]) -> float:
    """Seconds until the excitation repeats."""
    return float(sum(segment.duration for segment in segments.values()))


def shape(segment: Segment, t: np.ndarray) -> np.ndarray:
    """Return one stretch about its offset, m; ``t`` counts from its start."""
    a, f = segment.amplitude, segment.frequency
    if segment.kind == "triangle":  # starts at 0, rising with speed 4 a f
        phase = np.mod(f * t + 0.25, 1.0)
        return a * (1.0 - 4.0 * np.abs(phase - 0.5))
    if segment.kind == "sine":
        return a * np.sin(2 * np.pi * f * t)
    if segment.kind == "chirp":  # frequency rises linearly from f to frequency_end
        rate = (segment.frequency_end - f) / segment.duration
        return a * np.sin(2 * np.pi * (f * t + 0.5 * rate * t**2))
    if segment.kind == "multisine":
        return a * multisine(segment, t)
    if segment.kind == "steps":
        heights = np.random.default_rng(segment.seed).uniform(
            -1.0, 1.0, int(np.ceil(segment.duration * f)) + 1)
        return a * heights[np.floor(t * f).astype(int).clip(0, len(heights) - 1)]
    if segment.kind == "file":
        table = read_motion(segment.file)
        return np.interp(t, table[:, 0], table[:, 1])
    return np.zeros_like(t)


def multisine(segment: Segment, t: np.ndarray) -> np.ndarray:
    """Tones spaced evenly in log frequency, falling as 1/f, random phases, peak near 1."""
    rng = np.random.default_rng(segment.seed)
    tones = np.geomspace(segment.frequency, segment.frequency_end, segment.components)
    phases = rng.uniform(0, 2 * np.pi, segment.components)
    weights = segment.frequency / tones
    waves = [w * (np.sin(2 * np.pi * f * t + p) - np.sin(p))
             for w, f, p in zip(weights, tones, phases, strict=True)]
    return np.sum(waves, axis=0) / weights.sum()


@lru_cache(maxsize=8)
def read_motion(path: str) -> np.ndarray:
    """Return (n, 2) time in s and position in m from a CSV with columns ``t`` and ``x_d``."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # numpy warns of an empty file; the error says it
            table = np.genfromtxt(Path(path), delimiter=",", names=True)
        motion = np.column_stack([table["t"], table["x_d"]])
    except (OSError, ValueError, IndexError, TypeError, KeyError) as problem:
        raise InputError(f"{path}: expected a CSV with columns t (s) and x_d (m)") from problem
    if len(motion) < 2 or not np.isfinite(motion).all() or (np.diff(motion[:, 0]) <= 0).any():
        raise InputError(f"{path}: expected finite rows with rising t")
    return motion
