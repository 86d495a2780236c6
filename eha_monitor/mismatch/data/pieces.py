"""Pieces of a stretch."""

from dataclasses import replace

from eha_monitor.mismatch.data.experiment import BURN_IN, Stretch


def cut(stretch: Stretch, first: int, last: int, dt: float) -> Stretch:
    """Return samples ``first`` to ``last`` of a stretch; the filter finds its state anew."""
    here = slice(first, last)
    counted = stretch.counted[here].copy()
    counted[: round(BURN_IN / dt) if first else 0] = False
    return replace(stretch, start=stretch.start + first * dt, z=stretch.z[here],
                   u=stretch.u[here], p1=stretch.p1[here], p2=stretch.p2[here], counted=counted,
                   held_out=stretch.held_out[here],
                   loose=None if stretch.loose is None else stretch.loose[here])
