"""The field's own shapes: what a curve over one signal may be in a formula.

Each is an expression of the config's grammar (:mod:`eha_monitor.physics.expression`) in ``u``, so
that what is fitted, shown and written is one text.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from eha_monitor import ties

Start = dict[str, float]


@dataclass(frozen=True)
class Shape:
    """A shape.

    Attributes
    ----------
    name : in words.
    text : expression in ``u`` and its parameters.
    shown : how a person reads it; parameters and ``u`` in braces.
    units : parameter -> ``y``, ``u``, ``y/u``, ``y/u2``, ``y/u3`` or ``y/ru``: of the curve, of
        the signal, of their ratio, of the ratio with its square, its cube, its root; ``rad`` of
        an angle, ``1`` of a number.
    starts : of a curve, (n,) places and (n,) values, where a fit may begin.
    positive : parameters that are widths or limits.
    """

    name: str
    text: str
    shown: str
    units: dict[str, str]
    starts: Callable[[np.ndarray, np.ndarray], Iterator[Start]]
    positive: tuple[str, ...] = ()


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


def _square(u, y):
    law = u * np.abs(u)
    yield {"c": float(law @ y / (law @ law))}


def _root(u, y):
    law = np.sign(u) * np.sqrt(np.abs(u))
    yield {"c": float(law @ y / (law @ law))}


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


def _saturation(u, y):
    for width in (0.02, 0.1, 0.4):
        law = np.tanh(u / (width * np.ptp(u)))
        yield {"F": float(law @ y / max(law @ law, 1e-300)), "w": width * float(np.ptp(u))}


def _dead_band(u, y):
    largest = float(np.abs(u).max())
    for share in (0.15, 0.4, 0.7):
        law = np.sign(u) * np.maximum(np.abs(u) - share * largest, 0.0)
        yield {"k": float(law @ y / max(law @ law, 1e-300)), "d": share * largest}


def _beyond(u, y):
    largest = float(np.abs(u).max())
    for share in (0.15, 0.4, 0.7):
        law = np.maximum(np.abs(u) - share * largest, 0.0)
        yield {"k": float(law @ y / max(law @ law, 1e-300)), "d": share * largest}


def _cube(u, y):
    yield {"c": float((u**3) @ y / (u**3 @ u**3))}


def _threshold(u, y):
    for share in (0.25, 0.5, 0.75):
        place = float(u.min() + share * np.ptp(u))
        law = np.maximum(u - place, 0.0)
        yield {"k": float(law @ y / max(law @ law, 1e-300)), "u_0": place}


def _under(u, y):
    for share in (0.25, 0.5, 0.75):
        place = float(u.min() + share * np.ptp(u))
        law = np.maximum(place - u, 0.0)
        yield {"k": float(law @ y / max(law @ law, 1e-300)), "u_0": place}


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
