"""A formula for a learned term: shapes fitted to its curve, the best refitted in the likelihood.

The curve is no more than a way to find where to begin; which formula is given, and whether one is,
decides the evidence of the recording's own innovations, beside that of the table, which may be
ahead by a law's form error.
"""

import re
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.learn.forms import Form
from eha_monitor.mismatch.learn.learned import (
    SHARPEST,
    Learned,
    score_of,
)
from eha_monitor.mismatch.learn.shapes import RIPPLES, SHAPES, Shape
from eha_monitor.mismatch.likelihood.fit import Fit, Free, remade, spread
from eha_monitor.mismatch.name.refit import settled
from eha_monitor.mismatch.name.select import CLOSE
from eha_monitor.physics.contributions import ALL_NAMES, slot_of
from eha_monitor.physics.expression import parsed
from eha_monitor.physics.own_term import ADDED_UNITS, CONSTANTS, OF_UNITS, expressed_along
from eha_monitor.physics.signals import ANGLE, N_SIGNALS, OMEGA, P1, P2, V, X
from eha_monitor.quantity import quantity

PLACE = "u_0"  # parameter of a shape: where it lies; beyond what was recorded it is a guess
REFITTED = 3  # formulas that are fitted to the recording
EXACT = 0.02  # of the curve's root mean square: no table follows a formula closer
SHOWN = {"dp": "Δp", "omega": "ω", "p1": "p₁", "p2": "p₂", "angle": "θ"}
FACTORS = {"none": ("", "", ""), "direction": ("*tanh(v/v_e)", " against the motion", ""),
           "v": ("*v", " · v", "·s/m"), "dp": ("*dp", " · Δp", "/Pa"),
           "omega": ("*omega", " · ω", "·s/rad")}
WIDE = 3.0  # times its own size: the prior deviation of a formula's parameter


@dataclass(frozen=True)
class Formula:
    """A formula in the place of a table.

    Attributes
    ----------
    shape : which; ``text`` the expression of a config, ``values`` its parameters, SI.
    shown : with its numbers, as a person reads it.
    fit : the model with it; ``evidence`` log units, comparable with :attr:`Learned.evidence`.
    """

    shape: str
    text: str
    values: dict[str, float]
    shown: str
    fit: Fit
    evidence: float

    def entry(self, adds: str) -> dict:
        """Return it as an entry of a config's ``effects``."""
        return {"adds": adds, "expression": self.text, **self.values}


def formulas_of(experiment: Experiment, learned: Learned) -> list[Formula]:
    """Return the formulas that fit best, best first; the first is given if no table leads far."""
    places = learned.knots
    shapes = RIPPLES if learned.table.form.periodic else SHAPES
    fits = sorted((fit for shape in shapes if (fit := on_curve(shape, places, learned))),
                  key=lambda found: found[0])
    # What the curve itself is far from, the recording is too: only rivals are fitted to it.
    made = spread(lambda found: refitted(experiment, learned, *found[1:]), [
        one for one in fits[:REFITTED] if one[0] < fits[0][0] + CLOSE])
    return sorted((one for one in made if np.isfinite(one.evidence)
                   and lies_within(one, learned)),
                  key=lambda one: -one.evidence)


def lies_within(formula: Formula, learned: Learned) -> bool:
    """Tell whether a bump or a threshold lies in what was recorded; a wave lies everywhere."""
    place, table = formula.values.get(PLACE), learned.table
    return place is None or "sin(" in formula.text or table.first <= place <= table.last


def curve_of(text: str, values: dict[str, float], of: str, at: np.ndarray) -> np.ndarray:
    """Return an expression of one signal at its places, (n,)."""
    rows, found = np.zeros((len(at), N_SIGNALS)), np.empty(len(at))
    rows[:, [X, V, OMEGA, P1, ANGLE]] = np.asarray(at)[:, None]
    rows[:, P2] = at if of in ("p", "p2") else 0.0  # dp is p1 - p2
    expressed_along(parsed(text).slot("force", values), rows, found)
    return found


def in_signal(text: str, of: str) -> str:
    """Return a shape's text in a signal of the grammar."""
    return re.sub(r"\bu\b", of, text)


def unit_of(form: Form, kind: str) -> str:
    """Return the unit of a shape's parameter, SI."""
    y = (ADDED_UNITS[form.adds] + FACTORS[form.times][2]).replace("/s·s/rad", "/rad")
    u = OF_UNITS[form.of]
    divided = f"{y}/({u})" if "/" in u else f"{y}/{u}"
    return {"y": y, "u": u, "y/u": divided, "y/u2": f"{y}/({u})²",
            "y/u3": f"{y}/({u})³", "y/ru": f"{y}/√({u})", "rad": "rad", "1": ""}[kind]


def on_curve(shape: Shape, places: np.ndarray, learned: Learned
             ) -> tuple[float, Shape, dict[str, float]] | None:
    """Fit a shape to a learned curve, by the curve's own covariance.

    Returns
    -------
    cost : half the chi-squared and Schwarz's price of the parameters (1978).
    shape, values : SI, of the curve divided by the scale of its factor.
    """
    from scipy.optimize import least_squares  # half a second, for what is seldom learned

    divisor = learned.divisor
    y = learned.values / divisor
    floor = EXACT * float(np.sqrt(np.mean(y**2)))
    covariance = learned.covariance() / divisor**2 + floor**2 * np.eye(len(y))
    root = cholesky(covariance, lower=True)
    text = in_signal(shape.text, learned.table.form.of)
    keys = list(shape.units)
    best = None
    for start in shape.starts(places, y):
        size = np.array([max(abs(start[key]), 1e-3 * scale_of(shape.units[key], places, y))
                         for key in keys])
        log = np.array([key in shape.positive for key in keys])

        def values_at(z, start=start, size=size, log=log):
            return {key: float(start[key] * np.exp(np.clip(z[i], -8.0, 8.0))) if log[i]
                    else float(start[key] + size[i] * z[i]) for i, key in enumerate(keys)}

        def left(z, values_at=values_at):
            made = curve_of(text, values_at(z), learned.table.form.of, places)
            return solve_triangular(root, np.nan_to_num(made - y, nan=1e6), lower=True)

        found = least_squares(left, np.zeros(len(keys)), max_nfev=60)
        if best is None or found.cost < best[0]:
            best = (found.cost, values_at(found.x))
    if best is None:
        return None
    return best[0] + 0.5 * len(keys) * np.log(len(y)), shape, best[1]


def scale_of(kind: str, u: np.ndarray, y: np.ndarray) -> float:
    """Return the size of a shape's parameter over a curve, SI."""
    across, high = float(np.ptp(u)), float(np.abs(y).max()) + 1e-300
    return {"y": high, "u": across, "y/u": high / across, "y/u2": high / across**2,
            "y/u3": high / across**3, "y/ru": high / np.sqrt(across), "rad": np.pi, "1": 1.0}[kind]


def refitted(experiment: Experiment, learned: Learned, shape: Shape, values: dict[str, float]
             ) -> Formula:
    """Return a formula fitted to the recording, in the table's place, beside all else."""
    form, which = learned.table.form, learned.which
    factor = FACTORS[form.times][0]
    text = in_signal(shape.text, form.of)
    text = f"({text}){factor}" if factor and ("+" in text or "-" in text) else text + factor
    values = dict(values)
    if form.times == "direction":
        values["v_e"] = learned.scale
    expression = parsed(text)
    slot, own = slot_of(which), ALL_NAMES[which]
    theta, active = learned.fit.theta.copy(), learned.fit.active.copy()
    theta[slot] = expression.slot(form.adds, values)
    y = learned.values / learned.divisor
    fastest = max(experiment.ranges.speed, 1e-9)
    free = [f for f in learned.fit.free if f.owner != own]
    for key, place in expression.parameters.items():
        at, name = slot.start + CONSTANTS + place, f"{own}.{key}"
        if key == "v_e":
            free.append(Free(name, at, SHARPEST * fastest, fastest,
                             float(np.log(values[key])), experiment.policy.shape, True))
        elif key in shape.positive:
            free.append(Free(name, at, 1e-4 * values[key], 1e4 * values[key],
                             float(np.log(values[key])), experiment.policy.shape, True))
        else:
            size = scale_of(shape.units[key], learned.knots, y)
            free.append(Free(name, at, -1e3 * size, 1e3 * size, 0.0, WIDE * size))
    made = settled(experiment, remade(
        experiment, learned.fit, theta=theta, active=active, free=tuple(free)))
    found = {key: float(made.theta[slot.start + CONSTANTS + place])
             for key, place in expression.parameters.items()}
    return Formula(shape.name, text, found, shown_as(shape, form, found), made,
                   score_of(experiment, made) + experiment.policy.unnamed)


def shown_as(shape: Shape, form: Form, values: dict[str, float]) -> str:
    """Return a formula with its numbers, as a person reads it."""
    numbers = {key: quantity(values[key], unit_of(form, kind), 3)
            for key, kind in shape.units.items()}
    text = shape.shown.format(u=SHOWN.get(form.of, form.of), **numbers) + FACTORS[form.times][1]
    return text.replace("+ −", "− ").replace("− −", "+ ").replace("+ -", "− ").replace("− -", "+ ")

