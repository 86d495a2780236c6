"""A formula for a learned term: shapes fitted to its curve, the best refitted in the likelihood.

A shape of the field is an expression of the config's grammar
(:mod:`eha_monitor.physics.own_term`) in ``u``, so that what is fitted, shown and written is one
text.

The curve is no more than a way to find where to begin; which formula is given, and whether one is,
decides the evidence of the recording's own innovations, beside that of the table, which may be
ahead by a law's form error.
"""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from eha_monitor import ties
from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.learn.learned import SHARPEST, Form, Learned, score_of, with_own
from eha_monitor.mismatch.likelihood.fit import Fit, Free, spread
from eha_monitor.mismatch.name.finalists import CLOSE
from eha_monitor.mismatch.name.refit import settled
from eha_monitor.physics.contributions import ALL_NAMES, slot_of
from eha_monitor.physics.own_term import ADDED_UNITS, CONSTANTS, OF_UNITS, expressed_along, parsed
from eha_monitor.physics.signals import ANGLE, N_SIGNALS, OMEGA, P1, P2, V, X
from eha_monitor.quantity import quantity

Start = dict[str, float]


@dataclass(frozen=True)
class Shape:
    """A shape that a curve may have, with its name in words."""

    name: str  # in words
    text: str  # expression in ``u`` and its parameters
    shown: str  # how a person reads it; parameters and ``u`` in braces
    # Parameter -> ``y``, ``u``, ``y/u``, ``y/u2``, ``y/u3`` or ``y/ru``: of the curve, of
    # the signal, of their ratio, of the ratio with its square, its cube, its root; ``rad``
    # of an angle, ``1`` of a number
    units: dict[str, str]
    # Of a curve, (n,) places and (n,) values, where a fit may begin
    starts: Callable[[np.ndarray, np.ndarray], Iterator[Start]]
    positive: tuple[str, ...] = ()  # parameters that are widths or limits


def _extreme(u: np.ndarray, y: np.ndarray) -> tuple[float, float, float]:
    """Return the level beside the largest excursion, its height and its place."""
    level = float(np.median(y))
    at = ties.largest(np.abs(y - level))
    return level, float(y[at] - level), float(u[at])


def _constant(u, y):
    yield {"F": float(y.mean())}


def _line(u, y):
    slope, level = np.polyfit(u, y, 1)
    yield {"F": float(level), "k": float(slope)}


def _parabola(u, y):
    b, a, level = np.polyfit(u, y, 2)
    yield {"F": float(level), "k": float(a), "c": float(b)}


def _law(size: str, law: Callable, shape: str = "", of: Callable = lambda u, share: share,
         shares: tuple[float, ...] = (0.0,)) -> Callable:
    """Return what yields a law's size by least squares, for each place or width of its shape.

    ``size``, ``shape`` : names of the parameters; ``law`` of u and the shape's value.
    ``of`` : the shape's value of u and a share.
    """
    def starts(u, y):
        for share in shares:
            value = float(of(u, share))
            made = law(u, value)
            found = {size: float(made @ y / max(made @ made, 1e-300))}
            yield found | ({shape: value} if shape else {})
    return starts


def _of_largest(u, share):
    return share * np.abs(u).max()


def _along(u, share):
    return u.min() + share * np.ptp(u)


_square = _law("c", lambda u, _: u * np.abs(u))
_cube = _law("c", lambda u, _: u**3)
_root = _law("c", lambda u, _: np.sign(u) * np.sqrt(np.abs(u)))
_saturation = _law("F", lambda u, w: np.tanh(u / w), "w", lambda u, share: share * np.ptp(u),
                   (0.02, 0.1, 0.4))
_dead_band = _law("k", lambda u, d: np.sign(u) * np.maximum(np.abs(u) - d, 0.0), "d",
                  _of_largest, (0.15, 0.4, 0.7))
_beyond = _law("k", lambda u, d: np.maximum(np.abs(u) - d, 0.0), "d", _of_largest,
               (0.15, 0.4, 0.7))
_threshold = _law("k", lambda u, at: np.maximum(u - at, 0.0), "u_0", _along, (0.25, 0.5, 0.75))
_under = _law("k", lambda u, at: np.maximum(at - u, 0.0), "u_0", _along, (0.25, 0.5, 0.75))


def _bump(u, y):
    _, _, place = _extreme(u, y)
    height = float(y[ties.largest(np.abs(y))])
    for width in (0.05, 0.15, 0.4):
        yield {"F": height, "u_0": place, "w": width * float(np.ptp(u))}


def _raised_bump(u, y):
    level, height, place = _extreme(u, y)
    for width in (0.05, 0.15, 0.4):
        yield {"F_0": level, "F": height, "u_0": place, "w": width * float(np.ptp(u))}


def _decay(u, y):
    middle = float(y[ties.largest(-np.abs(u))])
    far = float(y[ties.largest(np.abs(u))])
    for width in (0.05, 0.2):
        yield {"F_0": far, "F": middle - far, "w": width * float(np.ptp(u))}


def _sine(u, y):
    level = float(y.mean())
    for cycles in (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0):
        length = float(np.ptp(u)) / cycles
        law = np.stack([np.sin(2 * np.pi * u / length), np.cos(2 * np.pi * u / length)])
        a, b = np.linalg.lstsq(law.T, y - level, rcond=None)[0]
        size, phase = float(np.hypot(a, b)), float(np.arctan2(b, a))
        yield {"F_0": level, "F": size, "u_0": -phase * length / (2 * np.pi), "w": length}


def _waves(u, y, count):
    """Return how many periods a revolution has, and size and phase of so many harmonics."""
    n = 2.0 * np.pi / (len(u) * (u[1] - u[0]))  # the first place comes again at the end
    found = []
    for k in range(1, count + 1):
        a, b = 2.0 * np.mean(y * np.cos(k * n * u)), 2.0 * np.mean(y * np.sin(k * n * u))
        found.append((float(np.hypot(a, b)), float(np.arctan2(b, a))))
    return float(n), found


def _ripple(u, y):
    n, [(size, phase)] = _waves(u, y, 1)
    yield {"F": size, "n": n, "a": phase}


def _two_waves(u, y):
    n, [(size, phase), (second, other)] = _waves(u, y, 2)
    yield {"F": size, "n": n, "a": phase, "G": second, "b": other}


SHAPES = (
    Shape("a constant", "F", "{F}", {"F": "y"}, _constant),
    Shape("a line", "F + k*u", "({F} + {k} · {u})", {"F": "y", "k": "y/u"}, _line),
    Shape("a parabola", "F + k*u + c*u*u", "({F} + {k} · {u} + {c} · {u}²)",
          {"F": "y", "k": "y/u", "c": "y/u2"}, _parabola),
    Shape("a square law", "c*u*abs(u)", "{c} · |{u}|{u}", {"c": "y/u2"}, _square),
    Shape("a cube", "c*u*u*u", "{c} · {u}³", {"c": "y/u3"}, _cube),
    Shape("a root", "c*sign(u)*sqrt(abs(u))", "{c} · sgn({u}) √|{u}|", {"c": "y/ru"}, _root),
    Shape("a bump", "F*exp(-((u - u_0)/w)**2)", "{F} · exp(−(({u} − {u_0})/{w})²)",
          {"F": "y", "u_0": "u", "w": "u"}, _bump, ("w",)),
    Shape("a bump on a constant", "F_0 + F*exp(-((u - u_0)/w)**2)",
          "({F_0} + {F} · exp(−(({u} − {u_0})/{w})²))",
          {"F_0": "y", "F": "y", "u_0": "u", "w": "u"}, _raised_bump, ("w",)),
    Shape("a decay", "F_0 + F*exp(-abs(u)/w)", "({F_0} + {F} · exp(−|{u}|/{w}))",
          {"F_0": "y", "F": "y", "w": "u"}, _decay, ("w",)),
    Shape("a saturation", "F*tanh(u/w)", "{F} · tanh({u}/{w})", {"F": "y", "w": "u"},
          _saturation, ("w",)),
    Shape("a dead band", "k*(max(u - d, 0) + min(u + d, 0))",
          "{k} · ({u} beyond ±{d})", {"k": "y/u", "d": "u"}, _dead_band, ("d",)),
    Shape("a rise beyond", "k*max(abs(u) - d, 0)", "{k} · (|{u}| above {d})",
          {"k": "y/u", "d": "u"}, _beyond, ("d",)),
    Shape("a threshold", "k*max(u - u_0, 0)", "{k} · ({u} above {u_0})",
          {"k": "y/u", "u_0": "u"}, _threshold),
    Shape("a threshold from below", "k*max(u_0 - u, 0)", "{k} · ({u} below {u_0})",
          {"k": "y/u", "u_0": "u"}, _under),
    Shape("a sine", "F_0 + F*sin(2*pi*(u - u_0)/w)",
          "({F_0} + {F} · sin(2π({u} − {u_0})/{w}))",
          {"F_0": "y", "F": "y", "u_0": "u", "w": "u"}, _sine, ("w",)),
)
# Over the shaft's angle: n periods in a revolution, one for each piston or tooth of a pump.
RIPPLES = (
    Shape("a ripple", "F*cos(n*u - a)", "{F} · cos({n} · {u} − {a})",
          {"F": "y", "n": "1", "a": "rad"}, _ripple, ("n",)),
    Shape("a ripple with its second harmonic", "F*cos(n*u - a) + G*cos(2*n*u - b)",
          "({F} · cos({n} · {u} − {a}) + {G} · cos(2 · {n} · {u} − {b}))",
          {"F": "y", "n": "1", "a": "rad", "G": "y", "b": "rad"}, _two_waves, ("n",)),
)


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
    """A formula in the place of a table."""

    shape: str  # which
    text: str  # expression of a config
    values: dict[str, float]  # its parameters, SI
    shown: str  # with its numbers, as a person reads it
    fit: Fit  # the model with it
    evidence: float  # log units, comparable with :attr:`Learned.evidence`

    def entry(self, adds: str) -> dict:
        """Return it as an entry of a config's ``effects``."""
        return {"adds": adds, "expression": self.text, **self.values}


def formulas_of(experiment: Experiment, learned: Learned) -> list[Formula]:
    """Return the formulas that fit best, best first; the first is given if no table leads far."""
    places = learned.knots
    shapes = RIPPLES if learned.table.form.periodic else SHAPES
    y, covariance = learned.values / learned.divisor, learned.covariance() / learned.divisor**2
    fits = sorted((fit for shape in shapes if (fit := on_curve(
        shape, places, y, covariance, learned.table.form.of))), key=lambda found: found[0])
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


def on_curve(shape: Shape, places: np.ndarray, y: np.ndarray, covariance: np.ndarray, of: str
             ) -> tuple[float, Shape, dict[str, float]] | None:
    """Fit a shape to a learned curve, by the curve's own covariance.

    Parameters
    ----------
    places, y, covariance : (n,), (n,), (n, n) of the curve ``of`` a signal, SI.

    Returns
    -------
    cost : half the chi-squared and Schwarz's price of the parameters (1978).
    shape, values : SI.
    """
    floor = EXACT * float(np.sqrt(np.mean(y**2)))
    root = cholesky(covariance + floor**2 * np.eye(len(y)), lower=True)
    text = in_signal(shape.text, of)

    def left(values):
        made = curve_of(text, values, of, places)
        return solve_triangular(root, np.nan_to_num(made - y, nan=1e6), lower=True)

    fits = [fitted_shape(shape, start, places, y, left) for start in shape.starts(places, y)]
    if not fits:
        return None
    cost, values = min(fits, key=lambda fit: fit[0])
    return cost + 0.5 * len(values) * np.log(len(y)), shape, values


def fitted_shape(shape: Shape, start: Start, places: np.ndarray, y: np.ndarray,
                 left: Callable[[dict[str, float]], np.ndarray]) -> tuple[float, dict[str, float]]:
    """Return half the sum of squares that a shape leaves at best, and its parameters, SI.

    ``start`` : its parameters; ``places``, ``y`` (n,) a curve that is as wide and as high.
    ``left`` : parameters -> (m,) residuals.
    """
    from scipy.optimize import least_squares  # half a second, for what is seldom learned

    keys = list(shape.units)
    size = np.array([max(abs(start[key]), 1e-3 * scale_of(shape.units[key], places, y))
                     for key in keys])

    def values_at(z):
        return {key: float(start[key] * np.exp(np.clip(z[i], -8.0, 8.0)))
                if key in shape.positive else float(start[key] + size[i] * z[i])
                for i, key in enumerate(keys)}

    found = least_squares(lambda z: left(values_at(z)), np.zeros(len(keys)), max_nfev=60)
    return found.cost, values_at(found.x)


def scale_of(kind: str, u: np.ndarray, y: np.ndarray) -> float:
    """Return the size of a shape's parameter over a curve, SI."""
    across, high = float(np.ptp(u)), float(np.abs(y).max()) + 1e-300
    return {"y": high, "u": across, "y/u": high / across, "y/u2": high / across**2,
            "y/u3": high / across**3, "y/ru": high / np.sqrt(across), "rad": np.pi, "1": 1.0}[kind]


def refitted(experiment: Experiment, learned: Learned, shape: Shape, values: dict[str, float]
             ) -> Formula:
    """Return a formula fitted to the recording, in the table's place, beside all else."""
    form, which = learned.table.form, learned.which
    text, values = as_expression(shape, form, values, learned.scale)
    y, free, places = learned.values / learned.divisor, [], constants_in(which, text)
    fastest = max(experiment.ranges.speed, 1e-9)
    for key, at in places.items():
        name = f"{ALL_NAMES[which]}.{key}"
        if key == "v_e":
            free.append(Free(name, at, SHARPEST * fastest, fastest,
                             float(np.log(values[key])), experiment.policy.shape, True))
        elif key in shape.positive:
            free.append(Free(name, at, 1e-4 * values[key], 1e4 * values[key],
                             float(np.log(values[key])), experiment.policy.shape, True))
        else:
            size = scale_of(shape.units[key], learned.knots, y)
            free.append(Free(name, at, -1e3 * size, 1e3 * size, 0.0, WIDE * size))
    made = settled(experiment, with_own(
        experiment, learned.fit, which, parsed(text).slot(form.adds, values), free))
    found = {key: float(made.theta[at]) for key, at in places.items()}
    return Formula(shape.name, text, found, shown_as(shape, form, found), made,
                   score_of(experiment, made) + experiment.policy.unnamed)


def constants_in(which: int, text: str) -> dict[str, int]:
    """Return the places in theta of the parameters of an own term's expression, by name."""
    return {key: slot_of(which).start + CONSTANTS + place
            for key, place in parsed(text).parameters.items()}


def as_expression(shape: Shape, form: Form, values: dict[str, float], scale: float
                  ) -> tuple[str, dict[str, float]]:
    """Return a shape times its form's factor as an expression of a config, and its parameters.

    ``scale`` : speed over which a term that follows the direction turns round, m/s.
    """
    factor, text = FACTORS[form.times][0], in_signal(shape.text, form.of)
    text = f"({text}){factor}" if factor and ("+" in text or "-" in text) else text + factor
    return text, dict(values) | ({"v_e": scale} if form.times == "direction" else {})


def shown_as(shape: Shape, form: Form, values: dict[str, float]) -> str:
    """Return a formula with its numbers, as a person reads it."""
    numbers = {key: quantity(values[key], unit_of(form, kind), 3)
            for key, kind in shape.units.items()}
    text = shape.shown.format(u=SHOWN.get(form.of, form.of), **numbers) + FACTORS[form.times][1]
    return text.replace("+ −", "− ").replace("− −", "+ ").replace("+ -", "− ").replace("− -", "+ ")
