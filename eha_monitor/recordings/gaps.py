"""Where rows of a recording are missing, in sentences."""

import numpy as np

from eha_monitor.recordings.columns import blocks, let_go, spans_of
from eha_monitor.recordings.grid import GAP

TOLD = 3  # gaps named one by one


def tell_gaps(columns: dict[str, np.ndarray], step: float, said: list[str]) -> None:
    """Say where rows are missing: of everything, then of single channels beyond that."""
    names, values = list(columns), tuple(columns.values())

    def unseen():
        for start, _, rows in blocks(*values):
            yield start, ~np.isfinite(np.stack(rows)).any(axis=0)

    def lacking(place: int):
        for start, _, rows in blocks(*values):
            finite = np.isfinite(np.stack(rows))
            yield start, ~finite[place] & finite.any(axis=0)

    _tell_spans(*spans_of(unseen()), "no data", step, said)
    for place, name in enumerate(names):
        if not any(bool(np.isnan(rows[0]).any()) for _, _, rows in blocks(values[place])):
            continue
        starts, stops = spans_of(lacking(place))
        long = (stops - starts) * step > max(GAP * step, 0.01)  # single NaN have been counted
        _tell_spans(starts[long], stops[long], f"{name}: no data", step, said)
    let_go(*values)


def _tell_spans(starts: np.ndarray, stops: np.ndarray, what: str, step: float,
               said: list[str]) -> None:
    """Say where stretches of rows lie, the first ones by name."""
    for start, stop in list(zip(starts, stops, strict=True))[:TOLD]:
        said.append(f"{what} from {start * step:.3f} s for {(stop - start) * step:.3f} s")
    if len(starts) > TOLD:
        rest = np.sum(stops[TOLD:] - starts[TOLD:]) * step
        said.append(f"{what} in {len(starts) - TOLD} more gaps, {rest:.3f} s in all")


def filled(u: np.ndarray) -> np.ndarray:
    """Return the samples with short gaps bridged linearly, (n,)."""
    good = np.isfinite(u)
    if good.all() or not good.any():
        return u
    index = np.arange(len(u))
    return np.interp(index, index[good], u[good])
