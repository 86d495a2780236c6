"""Of which signal a missing term is a function: all forms weighed from one Gram matrix."""

from dataclasses import dataclass, replace

import numpy as np

from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.data.inputs import CLOSED, FORCED
from eha_monitor.mismatch.likelihood.fit import Fit
from eha_monitor.mismatch.likelihood.gains import smallest_unknowns
from eha_monitor.mismatch.name.columns import Column, columns_at
from eha_monitor.mismatch.name.proposals import weighed
from eha_monitor.mismatch.name.rank import Ranked
from eha_monitor.mismatch.name.unnamed import PRIOR, Unnamed
from eha_monitor.mismatch.show.sizes import filtered_tracks
from eha_monitor.physics import signals as s
from eha_monitor.physics.own_term import cardinal

KNOTS = 9  # of a table when the forms are weighed
COVERED = 0.001  # quantile of the signal at which a table ends: beyond it nothing was measured
SHARP = 0.02  # of the largest speed: over which a term that follows the direction turns round
# What a term adds to -> which unknown of the filter stands for it, and its balance.
UNKNOWN = {"force": "force", "flow": "flow", "flow_1": "flow_1", "flow_2": "flow_2",
           "speed": "drive"}
BALANCE = {"force": "force", "flow": "flow", "flow_1": "flow", "flow_2": "flow",
           "speed": "drive"}


@dataclass(frozen=True)
class Form:
    """A way in which a missing term may depend on the signals; keys of an own term's table.

    Attributes
    ----------
    adds : ``force`` N, ``flow``, ``flow_1``, ``flow_2`` m³/s or ``speed`` rad/s.
    of : the signal of the table.
    times : what the table's value is multiplied by: ``none``, ``direction``, ``v`` or ``dp``.
    """

    adds: str
    of: str
    times: str = "none"

    @property
    def name(self) -> str:
        """Name of its group of columns."""
        return f"learned {self.adds} of {self.of} times {self.times}"


@dataclass(frozen=True)
class Guess:
    """A form with its curve by the linear guess.

    Attributes
    ----------
    evidence : log units, by the linear guess.
    first, last : ends of the table, SI;  ``scale`` of its factor.
    values : (KNOTS,) SI.
    ranked : the same guess of all other numbers, of ``what`` columns; its level of the unknowns.
    """

    form: Form
    evidence: float
    first: float
    last: float
    scale: float
    values: np.ndarray
    ranked: Ranked | None = None
    what: tuple[Column, ...] = ()


def forms_of(experiment: Experiment) -> tuple[Form, ...]:
    """Return the forms that an experiment's channels can tell apart."""
    found = [Form("force", "v"), Form("force", "x"), Form("force", "x", "direction"),
             Form("force", "x", "v")]
    if experiment.mode != FORCED or experiment.by_pressures:
        found += [Form("force", "p", "direction"), Form("force", "dp", "direction")]
    if experiment.mode == FORCED:
        return tuple(found)
    found += [Form("flow", "dp"), Form("flow", "x"), Form("flow", "v"), Form("flow", "x", "dp"),
              Form("flow_1", "p1"), Form("flow_2", "p2")]
    if experiment.mode == CLOSED:
        found += [Form("speed", "omega"), Form("speed", "x")]
    return tuple(found)


def signal_along(track: np.ndarray, of: str) -> np.ndarray:
    """Return a signal of :data:`own_term.OF` along a trajectory, (n,) SI."""
    if of == "dp":
        return track[:, s.P1] - track[:, s.P2]
    if of == "p":
        return 0.5 * (track[:, s.P1] + track[:, s.P2])
    return track[:, {"x": s.X, "v": s.V, "omega": s.OMEGA, "p1": s.P1, "p2": s.P2}[of]]


def factor_along(track: np.ndarray, times: str, scale: float) -> np.ndarray:
    """Return what a table is multiplied by along a trajectory, (n,)."""
    if times == "direction":
        return np.tanh(track[:, s.V] / scale)
    if times == "v":
        return track[:, s.V] / scale
    if times == "dp":
        return signal_along(track, "dp") / scale
    return np.ones(len(track))


def ranked_forms(experiment: Experiment, fit: Fit) -> list[Guess]:
    """Return the forms that would gain anything beside a model, best first."""
    tracks = filtered_tracks(experiment, fit)
    small = dict(zip(("force", "flow", "drive"), smallest_unknowns(experiment).as_array(),
                     strict=True))
    terms, told = [], {}
    for form in forms_of(experiment):
        at = [signal_along(track, form.of) for track in tracks]
        whole = np.concatenate(at)
        first, last = np.quantile(whole, [COVERED, 1.0 - COVERED])
        scale = {"direction": max(SHARP * experiment.ranges.speed, 1e-9),
                 "v": max(experiment.ranges.speed, 1e-9),
                 "dp": max(float(np.quantile(np.abs(np.concatenate(
                     [signal_along(track, "dp") for track in tracks])), 0.98)), 1e-9)}.get(
                         form.times, 1.0)
        if not last - first > 1e-6 * np.abs(whole).max():
            continue
        terms.append(Unnamed(form.name, UNKNOWN[form.adds], form.of, tuple(
            cardinal(one, KNOTS, first, last) * factor_along(track, form.times, scale)[:, None]
            for one, track in zip(at, tracks, strict=True))))
        told[form.name] = (form, float(first), float(last), float(scale),
                           PRIOR * small[BALANCE[form.adds]])
    view = weighed(experiment, frozenset(fit.named), fit,
                   columns_at(experiment, fit, suspects=False, terms=terms), more=1)
    found: dict[str, Guess] = {}
    for one in view.ranking:
        name = next((name for name in one.names if name in told), None)
        if name is None or name in found or one.names - {name} != frozenset(fit.named):
            continue
        form, first, last, scale, unit = told[name]
        values = np.array([value for place, value in sorted(one.amplitudes.items())
                           if view.what[place].owner == name])
        rest = tuple(member for member in one.members if member.owner != name)
        found[name] = Guess(form, one.evidence, first, last, scale, unit * values,
                            replace(one, members=rest), view.what)
    return sorted(found.values(), key=lambda guess: -guess.evidence)
