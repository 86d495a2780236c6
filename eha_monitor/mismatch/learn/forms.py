"""Of which signal a missing term is a function: all forms weighed from one Gram matrix."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from eha_monitor import ties
from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.data.inputs import CLOSED, FORCED
from eha_monitor.mismatch.likelihood.along import filtered_tracks
from eha_monitor.mismatch.likelihood.fit import Fit
from eha_monitor.mismatch.likelihood.gains import smallest_unknowns
from eha_monitor.mismatch.name.columns import Column, Columns, columns_at
from eha_monitor.mismatch.name.proposals import weighed
from eha_monitor.mismatch.name.rank import Ranked
from eha_monitor.mismatch.name.unnamed import Unnamed
from eha_monitor.physics import signals as s
from eha_monitor.physics.effects import NAMES
from eha_monitor.physics.own_term import OWN_NAMES, cardinal

KNOTS = 9  # of a table when the forms are weighed
COVERED = 0.001  # quantile of the signal at which a table ends: beyond it nothing was measured
MOST_PERIODS, HARMONICS = 24, 2  # of a ripple: in a revolution of the shaft; of each
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
    times : what the table's value is multiplied by: ``none``, ``direction``, ``v``, ``dp`` or
        ``omega``.
    """

    adds: str
    of: str
    times: str = "none"

    @property
    def name(self) -> str:
        """Name of its group of columns."""
        return f"learned {self.adds} of {self.of} times {self.times}"

    @property
    def periodic(self) -> bool:
        """Tell whether its table goes round: the shaft's angle begins anew."""
        return self.of == "angle"


def forms_of(experiment: Experiment) -> tuple[Form, ...]:
    """Return the forms that an experiment's channels can tell apart."""
    found = [Form("force", "v"), Form("force", "x"), Form("force", "x", "direction"),
             Form("force", "x", "v")]
    if experiment.mode != FORCED:  # else they are the force itself
        found += [Form("force", "p", "direction"), Form("force", "dp", "direction")]
    if experiment.mode == FORCED:
        return tuple(found)
    found += [Form("flow", "dp"), Form("flow", "x"), Form("flow", "v"), Form("flow", "x", "dp"),
              Form("flow_1", "p1"), Form("flow_2", "p2")]
    found.append(Form("flow", "angle", "omega"))
    if experiment.mode == CLOSED:
        found += [Form("speed", "omega"), Form("speed", "x")]
    return tuple(found)


def signal_along(track: np.ndarray, of: str) -> np.ndarray:
    """Return a signal of :data:`own_term.OF` along a trajectory, (n,) SI."""
    if of == "dp":
        return track[:, s.P1] - track[:, s.P2]
    if of == "p":
        return 0.5 * (track[:, s.P1] + track[:, s.P2])
    return track[:, {"x": s.X, "v": s.V, "omega": s.OMEGA, "p1": s.P1, "p2": s.P2,
                     "angle": s.ANGLE}[of]]


def factor_along(track: np.ndarray, times: str, scale: float) -> np.ndarray:
    """Return what a table is multiplied by along a trajectory, (n,)."""
    if times == "direction":
        return np.tanh(track[:, s.V] / scale)
    if times == "v":
        return track[:, s.V] / scale
    if times == "dp":
        return signal_along(track, "dp") / scale
    if times == "omega":
        return track[:, s.OMEGA] / scale
    return np.ones(len(track))


@dataclass(frozen=True)
class Table:
    """A form over the range that a recording covers.

    Attributes
    ----------
    first, last : ends of the table, SI;  ``scale`` of its factor;  ``unit`` of its values, SI.
    """

    form: Form
    first: float
    last: float
    scale: float
    unit: float

    def knots(self, count: int) -> np.ndarray:
        """Return the places of its values, (count,) SI."""
        return np.linspace(self.first, self.last, count, endpoint=not self.form.periodic)

    def entry(self, values: np.ndarray) -> dict:
        """Return it with values (n,), SI, as an entry of a config's ``effects``."""
        return {"adds": self.form.adds, "of": self.form.of, "times": self.form.times,
                "scale": self.scale, "first": self.first, "last": self.last,
                "values": values.tolist()}


@dataclass(frozen=True)
class Guess:
    """A table with its curve by the linear guess.

    Attributes
    ----------
    evidence : log units, by the linear guess.
    values : (KNOTS,) SI.
    ranked : the same guess of all other numbers, of ``what`` columns; its level of the unknowns.
    """

    table: Table
    evidence: float
    values: np.ndarray
    ranked: Ranked | None = None
    what: tuple[Column, ...] = ()


def tables_of(experiment: Experiment, fit: Fit) -> tuple[Table, ...]:
    """Return every form over what the recordings cover."""
    tracks = filtered_tracks(experiment, fit)
    units = units_of(experiment, fit)
    difference = np.abs(np.concatenate([signal_along(track, "dp") for track in tracks]))
    scales = {"direction": max(SHARP * experiment.ranges.speed, 1e-9),
              "v": max(experiment.ranges.speed, 1e-9),
              "dp": max(float(np.quantile(difference, 0.98)), 1e-9)}
    speed = np.abs(np.concatenate([track[:, s.OMEGA] for track in tracks]))
    scales["omega"] = max(float(np.quantile(speed, 0.98)), 1e-9)
    found = []
    for form in forms_of(experiment):
        whole = np.concatenate([signal_along(track, form.of) for track in tracks])
        first, last = np.quantile(whole, [COVERED, 1.0 - COVERED])
        if form.periodic:
            first, last = 0.0, 2.0 * np.pi / periods_of(experiment, fit, tracks)
        if last - first > 1e-6 * np.abs(whole).max():
            found.append(Table(form, float(first), float(last),
                               float(scales.get(form.times, 1.0)), units[BALANCE[form.adds]]))
    return tuple(found)


def periods_of(experiment: Experiment, fit: Fit, tracks: list[np.ndarray]) -> int:
    """Return how often in a revolution of the shaft what a model leaves comes again.

    A pump's flow ripples with its pistons or teeth, in proportion to its speed, with harmonics.
    An innovation is what entered over the sample before it, so the angle in its middle counts.
    """
    counted = [stretch.counted for stretch in experiment.stretches]
    middle = [np.concatenate([[0.0], 0.5 * (track[1:, s.ANGLE] + track[:-1, s.ANGLE])])
              for track in tracks]
    angle = np.concatenate([one[mask] for one, mask in zip(middle, counted, strict=True)])
    speed = np.concatenate([track[mask, s.OMEGA]
                            for track, mask in zip(tracks, counted, strict=True)])
    left = np.nan_to_num(fit.e / np.nanstd(fit.e, axis=0))
    shares = np.zeros(HARMONICS * MOST_PERIODS + 1)
    for k in range(1, len(shares)):
        waves = speed[:, None] * np.stack([np.cos(k * angle), np.sin(k * angle)], axis=1)
        shares[k] = np.sum((waves.T @ left) ** 2) / max(np.sum(waves**2), 1e-300)
    of = np.arange(1, MOST_PERIODS + 1)
    return int(of[ties.largest(sum(shares[of * h] for h in range(1, HARMONICS + 1)))])


def units_of(experiment: Experiment, fit: Fit) -> dict[str, float]:
    """Return the prior deviation of a table's values in each balance, SI."""
    small = smallest_unknowns(experiment).as_array()
    return dict(zip(("force", "flow", "drive"),
                    (experiment.policy.matters * small).tolist(), strict=True))


def columns_with(experiment: Experiment, fit: Fit, tables: Sequence[Table],
                 suspects: bool = False) -> Columns:
    """Return the columns at a fit with those of every knot of tables, a group for each.

    Parameters
    ----------
    suspects : also the effects that the model does not have.
    """
    tracks, terms = filtered_tracks(experiment, fit), []
    for one in tables:
        form = one.form
        terms.append(Unnamed(form.name, UNKNOWN[form.adds], form.of, tuple(
            cardinal(signal_along(track, form.of), KNOTS, one.first, one.last, form.periodic)
            * factor_along(track, form.times, one.scale)[:, None] for track in tracks)))
    return columns_at(experiment, fit, suspects=suspects, terms=terms)


def free_slot(experiment: Experiment) -> int | None:
    """Return the place of an own term that the config leaves free, None where it has all."""
    return next((i for i in range(len(NAMES), len(NAMES) + len(OWN_NAMES))
                 if not experiment.active[i]), None)


def ranked_forms(experiment: Experiment, tables: Sequence[Table], fit: Fit) -> list[Guess]:
    """Return the forms that would gain anything beside a model, best first."""
    by_name = {table.form.name: table for table in tables}
    view = weighed(experiment, frozenset(fit.named), fit,
                   columns_with(experiment, fit, tables), more=1)
    found: dict[str, Guess] = {}
    for one in view.ranking:
        name = next((name for name in one.names if name in by_name), None)
        if name is None or name in found or one.names - {name} != frozenset(fit.named):
            continue
        table = by_name[name]
        values = np.array([value for place, value in sorted(one.amplitudes.items())
                           if view.what[place].owner == name])
        rest = tuple(member for member in one.members if member.owner != name)
        found[name] = Guess(table, one.evidence, table.unit * values,
                            replace(one, members=rest), view.what)
    return ties.ordered(found.values(), lambda guess: guess.evidence,
                        lambda guess: guess.table.form.name, ties.GUESS)
