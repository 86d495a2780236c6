"""Demanded positions as people choose them; continuous in time, from 0 at t = 0."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Motion:
    """A demanded position x_d(t) in m.

    Attributes
    ----------
    kind : ``triangle``, ``sines``, ``ramps`` or ``chirp``.
    amplitudes : m; half of peak to peak of each tone, or of each stretch of triangle.
    frequencies : Hz; tones, triangles of equal length in turn, or first and last of a chirp.
    seed : phases of the tones, places of the ramps.
    speed : m/s, of the ramps.
    dwell : s, how long a ramp's end is held.
    before : s of rest at the start of the recording; negative: it begins on a moving rig.
    """

    kind: str
    amplitudes: tuple[float, ...]
    frequencies: tuple[float, ...] = ()
    seed: int = 0
    speed: float = 0.05
    dwell: float = 0.4
    before: float = 0.3

    def __call__(self, t: np.ndarray, length: float) -> np.ndarray:
        """Return x_d (n,) in m at times ``t`` (n,) in s of a recording of ``length`` s."""
        u = np.asarray(t) - self.before
        moving = np.maximum(u, 0.0)
        return {"triangle": self._triangle, "sines": self._sines, "ramps": self._ramps,
                "chirp": self._chirp}[self.kind](moving, length - self.before)

    def _triangle(self, u, length):
        parts = len(self.frequencies)
        out = np.zeros_like(u)
        each = length / parts
        start = 0.0
        for k, (a, f) in enumerate(zip(self.amplitudes, self.frequencies, strict=True)):
            # Whole periods, so that each stretch ends at 0.
            end = length + 1.0 if k == parts - 1 else start + max(round(each * f), 1) / f
            here = (u >= start) & (u < end)
            phase = np.mod((u[here] - start) * f + 0.25, 1.0)
            out[here] = a * (1.0 - 4.0 * np.abs(phase - 0.5))
            start = end
        return out

    def _sines(self, u, length):
        phases = np.random.default_rng([self.seed, 3]).uniform(0, 2 * np.pi, 64)
        out = np.zeros_like(u)
        for a, f, phi in zip(self.amplitudes, self.frequencies, phases, strict=False):
            out += a * np.sin(2 * np.pi * f * u + phi)
        # Faded in over half a second: nobody jumps into a motion.
        s = np.clip(u / 0.5, 0.0, 1.0)
        return out * s * s * (3.0 - 2.0 * s)

    def _ramps(self, u, length):
        rng = np.random.default_rng([self.seed, 5])
        times, places, side = [0.0], [0.0], 1.0
        while times[-1] < length + 2.0:
            place = side * self.amplitudes[0] * rng.uniform(0.3, 1.0)
            speed = self.speed * rng.uniform(0.5, 1.0)
            times += [times[-1] + abs(place - places[-1]) / speed]
            times += [times[-1] + self.dwell * rng.uniform(0.5, 1.5)]
            places += [place, place]
            side = -side
        return np.interp(u, times, places)

    def _chirp(self, u, length):
        first, last = self.frequencies
        rate = np.log(last / first) / length
        phase = 2 * np.pi * first * (np.exp(rate * u) - 1.0) / rate
        return self.amplitudes[0] * np.sin(phase)
