"""Figures of a diagnosis: the missing term, both fits on unseen data, parameters by part."""

from dataclasses import replace

import numpy as np

from eha_monitor.mismatch.diagnosis import Agreement, Diagnosis, LearnedTerm, Overlay, Value
from eha_monitor.mismatch.diagnosis import Curve as MissingTerm
from eha_monitor.physics import signals
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.reports import figure as fig
from eha_monitor.reports.diagnosis_words import parameter_name
from eha_monitor.reports.traces import LARGEST, robust_range, with_tamed
from eha_monitor.words import PARAMETER_WORDS, effect_words, listed

# What is measured is dark grey, the model before orange, the model after blue.
SEEN, BEFORE, AFTER, _FAINT = "#5b6873", fig.STAGE_TWO, fig.STAGE_ONE, "#b4bcc4"
LARGE, SMALL = (520, 380), (380, 290)  # CSS pixels; three small ones side by side at 1280
MISSING = {"force": "missing force", "flow": "missing flow", "drive": "missing drive speed",
           "sensor": "sensor error"}
_SYMBOL_OF = {"velocity": "velocity v", "position": "position x", "omega": "pump speed ω",
              "pump_speed": "pump speed ω", "pressure_difference": "pressure difference Δp",
              "time": "time", "x": "position x", "v": "velocity v",
              "dp": "pressure difference Δp", "p": "mean pressure p", "p1": "pressure p₁",
              "p2": "pressure p₂", "angle": "angle of the shaft θ"}
_FACTORS = {"dp": "Δp", "v": "v", "omega": "ω"}
# In steady motion pump and piston go together; a force hangs on the piston, pressures on it.
_READ = {signals.T: "time", signals.X: "position", signals.V: "velocity",
         signals.P1: "pressure_difference", signals.P2: "pressure_difference",
         signals.OMEGA: "pump_speed", signals.ANGLE: "pump_speed"}  # by effects
_INDIRECT, _STAND_IN = (("force", "pump_speed"), ("force", "pressure_difference")), 0.5
_STEPS_OF_TIME = 12  # of a recording, in which a slow change shows over the motion
_MOST_BARS = 70  # points with a bar each; more get a band
_APART = 4.0  # times the usual distance of the dots: so far apart no line joins them


def presentable(found: Diagnosis) -> Diagnosis:
    """Return the diagnosis with NaN for sizes that no picture can show, spreads positive."""
    def known(values: dict[str, Value]) -> dict[str, Value]:
        return {name: value for name, value in values.items() if abs(value.value) < LARGEST}

    curves = tuple(replace(curve, spread=np.abs(curve.spread))
                   for curve in map(with_tamed, found.curves))
    agreement = tuple(replace(part, before=known(part.before), after=known(part.after))
                      for part in found.agreement)
    return replace(found, curves=curves, overlays=tuple(map(with_tamed, found.overlays)),
                   agreement=agreement, before=known(found.before), after=known(found.after))


def axis_words(name: str) -> str:
    """Return what a curve is drawn against, as words."""
    return _SYMBOL_OF.get(name.replace(" ", "_"), name.replace("_", " "))


def informative(found: Diagnosis) -> list[MissingTerm]:
    """Return the curves that have something to draw, the most informative one first.

    A curve says much where its quantity decides the missing term: what it varies by is then
    large against the spread at each place.  The balance with the largest share goes first, of
    those that something was named in, then the best curve of each other one; what the named
    effects depend on goes before what only goes with it; time goes last, for it decides nothing by
    itself, unless what is named comes and goes, or nothing is named.  A sensor's error may be a
    drift.
    """
    share = found.location.balance
    named = {effect.balance for effect in found.effects} or set(share)
    blamed = max(sorted(named), key=lambda balance: share.get(balance, 0.0), default="")
    timed = any(effect.intervals_s for effect in found.effects if effect.balance == blamed)
    drawable = [curve for curve in found.curves
                if np.isfinite(curve.measured * curve.x).sum() >= 2]

    def rank(curve: MissingTerm) -> tuple[bool, bool, float]:
        unnamed = found.verdict == "unexplained" and not found.effects
        if curve.against == "time" and (unnamed or curve.balance == "sensor"):
            return False, False, -_contrast(_in_steps(curve))
        stand_in = _STAND_IN if (curve.balance, curve.against) in _INDIRECT else 1.0
        own = {_READ[signal] for effect in found.effects
               if effect.balance == curve.balance and effect.name in CATALOGUE
               for signal in CATALOGUE[effect.name].reads if signal in _READ}
        return ((curve.against == "time") != timed, bool(own) and curve.against not in own,
                -_contrast(curve) * stand_in)

    best: dict[str, list[MissingTerm]] = {}
    for curve in sorted(drawable, key=rank):
        best.setdefault(curve.balance, []).append(curve)
    first, others = best.pop(blamed, []), [curves[0] for name, curves in best.items()
                                           if name in named]
    rest = [curve for name, curves in best.items() for curve in curves[name in named:]]
    return first[:1] + others + first[1:] + rest


def _in_steps(curve: MissingTerm) -> MissingTerm:
    """Return a curve against time as others are, in places: the mean and spread of each."""
    known = np.isfinite(curve.measured) & np.isfinite(curve.x)
    parts = [part for part in np.array_split(curve.measured[known], _STEPS_OF_TIME) if part.size]
    return replace(curve, x=np.arange(len(parts), dtype=float),
                   measured=np.array([part.mean() for part in parts]),
                   spread=np.array([part.std() for part in parts]), modelled=np.array([]))


def _contrast(curve: MissingTerm) -> float:
    """Return how much of the curve is a function of its quantity: variance over spread²."""
    known = np.isfinite(curve.measured) & np.isfinite(curve.x)
    spread = curve.spread[known]
    varies = float(np.var(curve.measured[known]))
    spread = spread[np.isfinite(spread)]
    return varies / max(float(np.mean(spread**2)) if spread.size else varies, 1e-4 * varies,
                        1e-300)


def curve_figure(found: Diagnosis, curve: MissingTerm, large: bool = False) -> fig.Figure:
    """Draw the missing term against one quantity: dots measured, a line modelled."""
    order = np.argsort(curve.x)
    x, measured, spread, modelled = (values[order] for values in (
        curve.x, curve.measured, curve.spread, curve.modelled))
    across = fig.scale_of(x, curve.against_unit)
    named = listed([effect_words(effect.name) for effect in found.effects
                    if effect.balance == curve.balance]
                   + ["the learned term" for term in found.learned
                      if term.balance == curve.balance]
                   + ["what has changed" for change in found.changes[:1]
                      if change.balance in (curve.balance, "sensor") and not found.effects])
    with_line = bool(named) and bool(np.isfinite(modelled).any())
    spread = np.where(np.isfinite(spread), spread, 0.0)
    low, high, _ = robust_range([measured, measured - spread, measured + spread,
                                 *([modelled] if with_line else [])])
    scale = fig.axis_scale(max(abs(low), abs(high)), curve.unit)
    what = MISSING.get(curve.balance, curve.balance)
    panel = fig.Panel(fig.Side(axis_words(curve.against), across),
                      fig.Side(what, scale, limits=fig.padded(low, high)))
    panel.add(fig.Level(0.0, width=0.8))
    label, width = "measured, with its spread", 2.2
    if curve.against == "time":  # it hops to and fro: lines, the model's thin on top
        panel.add(fig.Curve(x, measured, "measured", SEEN, 3.0, opacity=0.5))
        width = 0.9
    elif len(x) > _MOST_BARS:
        panel.add(fig.Band(x, measured - spread, measured + spread, colour=SEEN),
                  fig.Curve(x, measured, label, SEEN, 0.0, marker="circle", size=3.2))
    else:
        panel.add(fig.Curve(x, measured, label, SEEN, 0.0, marker="circle", y_error=spread,
                              size=5.6 if large else 4.2, error_colour=_FAINT))
    if with_line:
        apart = np.diff(x) > _APART * np.median(np.diff(x)) if curve.against != "time" else ()
        breaks = np.flatnonzero(apart) + 1  # nothing was compared there, and no line is known
        panel.add(fig.Curve(np.insert(x, breaks, np.nan), np.insert(modelled, breaks, np.nan),
                            f"modelled: {named}", AFTER, width))
    return fig.Figure((panel,), f"{what} against {curve.against.replace('_', ' ')}: measured"
                            f"{' and modelled' if with_line else ''}",
                      size=LARGE if large else SMALL,
                      on_time=curve.against == "time")


def learned_figure(term: LearnedTerm) -> fig.Figure:
    """Draw a learned curve with its band, what was measured of it, and its best formula."""
    shown = [term.curve, *([term.formula_curve] if np.isfinite(term.formula_curve).all() else [])]
    low, high, _ = robust_range([*shown, term.measured])
    scale, across = fig.axis_scale(max(abs(low), abs(high)), term.unit), fig.scale_of(
        term.x, term.against_unit)
    x, curve, band = term.x, term.curve, 2.0 * term.band
    name, what = axis_words(term.of[0]), learned_words(term)
    panel = fig.Panel(fig.Side(name, across), fig.Side(what, scale, limits=fig.padded(low, high)))
    panel.add(
        fig.Level(0.0, width=0.8),
        fig.Curve(term.at, term.measured, "measured, with its spread", SEEN, 0.0,
                  marker="circle", y_error=np.abs(term.spread), error_colour=_FAINT, size=5.6),
        fig.Band(x, curve - band, curve + band, "learned, ± 2 standard deviations", AFTER, 0.25),
        fig.Curve(x, curve, "learned", AFTER, 2.2))
    if len(shown) > 1:
        panel.add(fig.Curve(x, term.formula_curve,
                              "formula" if term.formula else "best formula, worse", BEFORE, 1.6,
                              "dash"))
    return fig.Figure((panel,), f"{what} against {name}: measured, learned, and the formula",
                      size=LARGE)


def learned_words(term: LearnedTerm) -> str:
    """Return what a learned curve is, as a label of an axis."""
    what = MISSING.get(term.balance, term.balance)
    if len(term.of) == 1:
        return what
    if term.unit in ("N", "N·m", "m³/s", "rad/s"):
        return f"{what} against motion"
    return f"{what} for each unit of {_FACTORS[term.of[1]]}"


def overlay_figure(overlay: Overlay, with_after: bool,
                   names: tuple[str, str] = ("model before", "model after")) -> fig.Figure | None:
    """Draw a signal with both models running free, and below what remains of it."""
    known = np.isfinite(overlay.measured) & np.isfinite(overlay.time)
    if known.sum() < 2:
        return None
    start, stop = (float(overlay.time[known][place]) for place in (0, -1))
    # Milliseconds since the start of the recording are no place in it; seconds are.
    t = overlay.time
    time = fig.Side("time", fig.time_scale(max(stop - start, 1.0)),
                    limits=fig.padded(start, stop, 0.0))
    models = [(names[0] if with_after else "model", overlay.before, BEFORE,
               "dash" if with_after else "solid")]
    models += [(names[1], overlay.after, AFTER, "solid")] if with_after else []
    scale = fig.scale_of(overlay.measured, overlay.unit)
    errors = [overlay.measured - values for _, values, *_ in models]
    low, high, _ = robust_range(errors)
    error_scale = fig.axis_scale(max(abs(low), abs(high)), overlay.unit)
    bottom = fig.Panel(time, fig.Side("measured − model", error_scale,
                                      limits=fig.padded(low, high)))
    low, high, _ = robust_range([overlay.measured], [values for _, values, *_ in models])
    words = overlay.signal.replace("_", " ")
    top = fig.Panel(time, fig.Side(words, scale, limits=fig.padded(low, high)))
    bottom.add(fig.Level(0.0, width=0.8))
    top.signal(t, overlay.measured, "measured", SEEN, width=3.2, opacity=0.55)
    for (name, values, colour, dash), error in zip(models, errors, strict=True):
        top.signal(t, values, name, colour, width=1.3, dash=dash)
        bottom.signal(t, error, f"{name}, error", colour, width=1.1, dash=dash, legend=False)
    return fig.Figure((top, bottom), f"{words}: measured and simulated by both models, and their "
                                 "errors", (1.0, 1.0), (LARGE[0], LARGE[1] + 40), on_time=True,
                      stretch=f"{start:.4g} to {stop:.4g} s")


def agreement_figure(name: str, parts: tuple[Agreement, ...], before: Value | None,
                     after: Value | None) -> fig.Figure | None:
    """Draw one parameter as each part of the record gives it, with error bars of one sigma."""
    rows = [(part.part.replace("_", " "), part.before.get(name), part.after.get(name))
            for part in parts] + [("whole record", before, after)]
    rows = [row for row in rows if _drawable(row[1]) or _drawable(row[2])][::-1]
    if len(rows) < 2:
        return None
    known = [value for _, *pair in rows for value in pair if _drawable(value)]
    ends = [end for value in known for end in (value.value, *_ends(value, known))]
    scale = fig.axis_scale(max(map(abs, ends)), known[0].unit)
    low, high = min(ends), max(ends)
    margin = 0.06 * (high - low) or 0.1 * abs(high) or 1.0
    panel = fig.Panel(fig.Side(parameter_name(name), scale, limits=(low - margin, high + margin)),
                      fig.Side(rows=tuple(row[0] for row in rows)))
    if _drawable(after):
        panel.add(fig.Level(after.value, "", AFTER, dash="dash", upright=True))
    for which, colour, shift, label, marker in ((1, BEFORE, 0.14, "before", "square"),
                                                (2, AFTER, -0.14, "after", "circle")):
        mine = [(row[which], place + shift) for place, row in enumerate(rows)
                if _drawable(row[which])]
        if mine:
            reach = np.array([_ends(value, known) for value, _ in mine]).T
            at = np.array([value.value for value, _ in mine])
            panel.add(fig.Curve(
                at, np.array([place for _, place in mine]), f"{label}, ± 1σ",
                colour, 0.0, marker=marker, size=7.5, error_width=2.0, cap=3.0,
                x_error=np.maximum([at - reach[0], reach[1] - at], 0.0)))
    return fig.Figure((panel,), f"{PARAMETER_WORDS.get(name, name)} from each part of the record, "
                      "before and after modelling", size=(LARGE[0], 110 + 44 * len(rows)))


def _drawable(value: Value | None) -> bool:
    return value is not None and np.isfinite(value.value)


def _ends(value: Value, all_of_them: list[Value]) -> tuple[float, float]:
    """Return the ends of an error bar, cut where it would squeeze all others flat."""
    centres = [other.value for other in all_of_them]
    reach = max(1.5 * (max(centres) - min(centres)), 0.2 * max(map(abs, centres)))
    half = float(fig.stated(value.value, value.stddev)) if value.stddev > 0 else 0.0
    return value.value - min(half, reach), value.value + min(half, reach)
