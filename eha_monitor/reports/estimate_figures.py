"""The figures of an estimate: B and beta_e as they converge, the motion, the innovations."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from eha_monitor.estimation.consistency import variance_ratios, whitened
from eha_monitor.estimation.results import Estimate, StageResult
from eha_monitor.quantity import SYMBOLS, Scale, number, quantity
from eha_monitor.reports import figure as fig
from eha_monitor.reports import traces
from eha_monitor.settings.monitor import Limits
from eha_monitor.words import PARAMETER_WORDS

_LIMITS = (("low_error", "ERROR below"), ("low_warn", "WARN below"),
           ("high_warn", "WARN above"), ("high_error", "ERROR above"))
_WHOLE, _SHARED = slice(None), "record"  # charts of the whole record zoom together


def presentable(estimate: Estimate) -> Estimate:
    """Return the estimate with NaN for infinities and for sizes that no picture can show."""
    recording = replace(estimate.recording, channels={
        name: traces.tamed(values) for name, values in estimate.recording.channels.items()})
    return replace(estimate, recording=recording, stage_one=traces.with_tamed(estimate.stage_one),
                   stage_two=traces.with_tamed(estimate.stage_two))


# ---- B and beta_e ---------------------------------------------------------------------------

@dataclass(frozen=True)
class _Watched:
    """A parameter's curve with its limits (SI, words), and its colour.

    ``beside`` : (k, 3) time (s), value and deviation by least squares; none where the model fits.
    """

    name: str
    stage: StageResult
    limits: list[tuple[float, str]]
    colour: str
    beside: np.ndarray

    def view(self) -> tuple[float, float]:
        """Return the least and largest value to show, SI: the curve and the limits near it."""
        low, high = core_range(self.stage, 0.4)
        near = [limit for limit, _ in self.limits if is_near(limit, low, high)]
        near += self.beside[:, 1].tolist()
        return min([low, *near]), max([high, *near])


def _watched(estimate: Estimate, name: str) -> _Watched:
    thresholds = estimate.settings.thresholds
    stage, limits, colour = (
        (estimate.stage_one, thresholds.viscous_damping, fig.STAGE_ONE) if name == "B" else
        (estimate.stage_two, thresholds.bulk_modulus, fig.STAGE_TWO))
    found = [(one.time_s, known.value, known.stddev) for one in estimate.beside
             if name in estimate.model.tainted and (known := one.determined(name))]
    return _Watched(name, stage, limits_of(limits), colour, np.array(found).reshape(-1, 3))


def parameter_block(estimate: Estimate, name: str) -> fig.Block:
    """Return the convergence of ``B`` or ``beta_e``: all of it with the limits, and its end."""
    one = _watched(estimate, name)
    stage, value = one.stage, one.stage.value
    key, title = f"parameter-{name}", f"{PARAMETER_WORDS[name].capitalize()} {SYMBOLS[name]}"
    if not np.isfinite(value).any():
        reason = stage.estimate.message or "the stage had no data"
        return fig.Block(key, title, notes=(f"No curve: {reason}",))
    low, high = core_range(stage, 0.4)
    notes = far_limits([line for line in one.limits if not is_near(line[0], low, high)],
                       stage.estimate.unit)
    view = one.view()
    margin = 0.08 * (view[1] - view[0])
    known = value[np.isfinite(value)]
    if known.min() < view[0] - margin or known.max() > view[1] + margin:
        notes.append("The start of the curve, from the prior, is outside the plot.")
    start = _settled(stage)
    pictures = [_parameters([one], _WHOLE, [view], "whole record")]
    if stage.estimate.status == "converged" and 0 < start < len(value) - 10:
        tail = core_range(stage, start / len(value))
        pictures.append(_parameters([one], slice(start, None), [tail],
                                    "after convergence, enlarged"))
    if name == "B" and estimate.recording.has("temperature"):
        at = estimate.settings.viscosity.reference_temperature
        notes.append(f"A temperature was recorded: the limits apply at {at:g} °C, to which B is "
                     "converted by the viscosity law before it is compared; the curve shows B as "
                     "estimated.")
    return fig.Block(key, title, tuple(pictures), tuple(notes))


def parameter_figure(estimate: Estimate, names: Sequence[str], height: int | None = None
                     ) -> fig.Figure | None:
    """Draw ``B``, ``beta_e`` or both over the whole record; None where neither has a curve."""
    shown = [one for one in (_watched(estimate, name) for name in names)
             if np.isfinite(one.stage.value).any()]
    if not shown:
        return None
    height = height or (fig.HEIGHT - 100 if len(shown) == 1 else 560)
    return replace(_parameters(shown, _WHOLE, [one.view() for one in shown], "whole record"),
                   size=(fig.WIDTH, height))


def core_range(stage: StageResult, from_share: float) -> tuple[float, float]:
    """Return the range of the curve and its band behind a share of the record, SI.

    Percentiles and medians keep single jumps from hiding the rest.
    """
    start = int(from_share * len(stage.value))
    value, stddev = stage.value[start:], stage.stddev[start:]
    if not np.isfinite(value).any():
        value, stddev = stage.value, stage.stddev
    finite = np.isfinite(value)
    value = value[finite]
    spread = 2 * fig.stated(value, np.nan_to_num(stddev[finite], nan=0.0, posinf=0.0))
    half = len(value) // 2
    low, high = np.percentile(value, (0.5, 99.5))
    late, wide = value[half:], spread[half:]
    # A parameter that is hardly determined has a band that says nothing by its size.
    wide = np.minimum(wide, 2 * np.abs(late) + (high - low))
    return (float(min(low, np.median(late - 1.5 * wide))),
            float(max(high, np.median(late + 1.5 * wide))))


def far_limits(lines: list[tuple[float, str]], unit: str) -> list[str]:
    """Return the note on limits, SI, with their words, that a picture leaves out; none of none."""
    far = ", ".join(f"{words} {quantity(limit, unit)}" for limit, words in lines)
    return [f"Outside the plot: {far}."] if far else []


def is_near(limit: float, low: float, high: float) -> bool:
    """Whether a limit can share the picture without squeezing the curve flat."""
    size = max(abs(low), abs(high), 3 * (high - low))
    return low - 2.5 * size <= limit <= high + 2.5 * size


def _settled(stage: StageResult) -> int:
    """Return the sample from which the curve is worth enlarging."""
    finite = np.flatnonzero(np.isfinite(stage.value))
    last = finite[len(finite) // 2:]
    centre, width = np.median(stage.value[last]), np.ptp(np.percentile(stage.value[last], (1, 99)))
    width = max(4 * width, 8 * float(np.nanmedian(stage.stddev[last])), 1e-9 * abs(centre))
    outside = finite[np.abs(stage.value[finite] - centre) > width]
    first = outside[-1] + 1 if len(outside) else finite[0]
    return int(min(max(first, finite[0] + len(finite) // 10), last[0]))


def _parameters(shown: list[_Watched], part: slice, views: list[tuple[float, float]], words: str
                ) -> fig.Figure:
    """Draw parameters one above the other over a part of the record; ``views`` SI."""
    time = _time_side(shown[0].stage.time, part, words)
    panels = tuple(_parameter_panel(one, part, view, time)
                   for one, view in zip(shown, views, strict=True))
    last = [f"{PARAMETER_WORDS[one.name]}, last value " + quantity(
        one.stage.value[np.isfinite(one.stage.value)][-1], one.stage.estimate.unit)
        for one in shown]
    return fig.Figure(panels, f"{' and '.join(last)}: against time with the one-sigma band and "
                              f"the limits, {words}", (1.0,) * len(panels), on_time=True,
                      stretch="" if part.start else _SHARED)


def _time_side(time: np.ndarray, part: slice, words: str) -> fig.Side:
    """Return the axis of a part of (n,) times, s, in the unit that suits all of it."""
    t = time[part]
    return fig.Side("time", fig.time_scale(float(time[-1] - time[0])), words,
                    (float(t[0]), float(t[-1])) if len(t) > 1 and t[-1] > t[0] else None)


def _parameter_panel(one: _Watched, part: slice, view: tuple[float, float], time: fig.Side
                     ) -> fig.Panel:
    """Return the curve, its band and the limits that fall into ``view``, SI."""
    stage, unit = one.stage, one.stage.estimate.unit
    t, value = stage.time[part], stage.value[part]
    spread = fig.stated(value, stage.stddev[part])
    low, high = fig.padded(*view, 0.12)
    panel = fig.Panel(time, fig.Side(SYMBOLS[one.name], fig.axis_scale(max(map(abs, view)), unit),
                                     limits=(low, high)))
    band = traces.band_envelope(t, np.clip(value - spread, low - 9 * (high - low), None),
                                np.clip(value + spread, None, high + 9 * (high - low)))
    if len(band[0]):
        thin = 2 * np.nanmedian(spread) < 0.006 * (high - low)
        panel.add(fig.Band(*band, "± 1σ (mostly thinner than the line)" if thin else "± 1σ",
                           one.colour))
    panel.signal(t, value, f"{SYMBOLS[one.name]} estimated", one.colour, width=1.8)
    if len(one.beside):
        at, known, stddev = one.beside.T
        panel.add(fig.Curve(at + stage.time[0], known, "least squares, judged by the alarms",
                            fig.OTHER, 0.0, marker="circle", size=5.0, y_error=stddev,
                            error_colour=fig.OTHER))
    add_limits(panel, value, one.limits, unit)
    return panel


def add_limits(panel: fig.Panel, value: np.ndarray, lines: list[tuple[float, str]], unit: str,
               along: np.ndarray | None = None) -> None:
    """Add the limits that fall into a panel, each with its name where ``value`` leaves most room.

    Parameters
    ----------
    panel : with limits of its y axis.
    value : (n,) what is shown, SI, in order of time.
    lines : limit, SI, and its words; ``unit`` is theirs.
    along : (n,) where each is shown, as a share of the width; evenly spread without it.
    """
    if along is None:
        along = np.linspace(0.0, 1.0, len(value))
    bottom, top = panel.ends("y")
    taken: list[float] = []  # heights of labels, share of the picture
    for place, label in lines:
        if not bottom < place < top:
            continue
        warn = label.startswith("WARN")
        colour = fig.WARN_LINE if warn else fig.ERROR_LINE
        panel.add(fig.Level(place, "", colour, 1.3, "dash" if warn else "dot"))
        # Labels stand apart where a WARN and an ERROR limit lie close together.
        usual = label in ("WARN below", "ERROR above", "limit, above")
        share_up, places = (place - bottom) / (top - bottom), []
        for above, left in ((usual, False), (usual, True), (not usual, False), (not usual, True)):
            height = share_up + (0.025 if above else -0.025)
            if 0.0 < height < 1.0 and not any(abs(height - other) < 0.045 for other in taken):
                hidden = _hidden(value - place, along, top - bottom, above, left)
                places.append((hidden, len(places), height, above, left))
        if not places:
            continue
        *_, height, above, left = min(places)
        taken.append(height)
        panel.add(fig.Text(0.0 if left else 1.0, place, f"{label} {quantity(place, unit)}", colour,
                           "left" if left else "right", "bottom" if above else "top", x_share=True,
                           shift=(4 if left else -4, 4 if above else -4)))


LABEL = (0.55, 0.09)  # of width and height of a picture on a phone, that a limit's name takes


def _hidden(over: np.ndarray, along: np.ndarray, height: float, above: bool, left: bool) -> float:
    """Return the share of a curve, (n,) ``over`` the limit, that its name would hide."""
    up = (over if above else -over) / height
    with np.errstate(invalid="ignore"):
        there = (up > -0.01) & (up < LABEL[1]) & (
            along < LABEL[0] if left else along > 1.0 - LABEL[0])
    return round(float(there.mean()), 2) if len(there) else 0.0


def limits_of(limits: Limits) -> list[tuple[float, str]]:
    """Return the limits that there are, SI, each with its words."""
    return [(getattr(limits, which), words) for which, words in _LIMITS
            if getattr(limits, which) is not None]


def limits_in_words(limits: Limits, unit: str) -> str:
    """Return the limits of a parameter as one phrase."""
    return ", ".join(f"{words} {quantity(limit, unit)}" for limit, words in limits_of(limits)
                     ) or "no limits configured"


# ---- the motion -----------------------------------------------------------------------------

@dataclass(frozen=True)
class _Signal:
    """One line: (n,) SI values on the recording's grid, and how it is drawn."""

    label: str
    values: np.ndarray
    colour: str
    width: float = 1.4
    dash: str = "solid"
    estimated: bool = False

    @property
    def drawable(self) -> bool:
        """Whether there is a finite value to draw."""
        return bool(np.isfinite(self.values).any())


@dataclass(frozen=True)
class _Window:
    """Samples ``start`` to ``stop`` that are shown enlarged, and what they show."""

    start: int
    stop: int
    words: str


@dataclass(frozen=True)
class _Motion:
    """What the figures of the motion are drawn from."""

    estimate: Estimate
    window: _Window

    @property
    def unit(self) -> str:
        """Unit of the position."""
        return "rad" if self.estimate.settings.rig.motion == "rotary" else "m"

    def estimated(self, attribute: str) -> list[_Signal]:
        """Return the states of both stages that have data; nothing where the data have a gap.

        A stage that diverged has no motion to compare with.
        """
        gap = traces.in_gap(self.estimate.recording.get("x"))
        stages = ((self.estimate.stage_one, "stage one", fig.STAGE_ONE, "solid"),
                  (self.estimate.stage_two, "stage two", fig.STAGE_TWO, "dash"))
        found = [_Signal(label, np.where(gap, np.nan, getattr(stage, attribute)), colour, 1.5,
                         dash, True) for stage, label, colour, dash in stages
                 if len(getattr(stage, attribute)) == len(self.estimate.recording)
                 and stage.estimate.status != "diverged"]
        return [one for one in found if one.drawable]

    def pictures(self, signals: list[_Signal], residuals: list[_Signal], name: str, unit: str
                 ) -> tuple[fig.Figure, ...]:
        """Return the whole record and the window, each with the signals above their residuals."""
        n = len(self.estimate.recording)
        signals = [one for one in signals if one.drawable]
        residuals = sorted((one for one in residuals if one.drawable), reverse=True,
                           key=lambda one: float(np.nanstd(one.values)))  # small ones on top
        known = [one.values for one in signals if not one.estimated]
        scale = fig.scale_of(np.concatenate(known or [one.values for one in signals]), unit)
        parts = [_Window(0, n, "whole record")]
        if self.window.stop - self.window.start < n:
            parts.append(self.window)
        return tuple(self._picture(part, signals, residuals, (name, unit), scale)
                     for part in parts)

    def _picture(self, part: _Window, signals: list[_Signal], residuals: list[_Signal],
                 named: tuple[str, str], scale) -> fig.Figure:
        """Draw one part of the record; ``named`` is the quantity and its SI unit."""
        recording, (name, unit) = self.estimate.recording, named
        here = slice(part.start, part.stop)
        whole = part.stop - part.start == len(recording)
        t = recording.time[here]
        clock = fig.time_scale(recording.duration if whole else 1.0)
        time = fig.Side("time", clock, part.words,
                        (float(t[0]), float(t[-1])) if len(t) > 1 else None)
        low, high, peak = traces.robust_range(
            [one.values[here] for one in signals if not one.estimated],
            [one.values[here] for one in signals if one.estimated])
        top = fig.Panel(time, fig.Side(name, scale, limits=fig.padded(low, high)))
        if whole and self.window.stop - self.window.start < len(t):
            top.add(fig.Span(t[self.window.start], t[self.window.stop - 1], "", fig.WINDOW, 0.45,
                             True))
        for one in signals:
            top.signal(t, one.values[here], one.label, one.colour, width=one.width, dash=one.dash)
        if peak:
            top.add(fig.cut_note(quantity(peak, unit, 2)))
        panels = [top]
        if residuals:
            panels.append(_residuals(time, t, [(one, one.values[here]) for one in residuals],
                                     (unit, high - low)))
        return fig.Figure(tuple(panels), f"{name} against time, {part.words}: "
                          + ", ".join(one.label for one in signals),
                          (2.0, 1.0)[:len(panels)],
                          (fig.WIDTH, fig.HEIGHT + (60 if residuals else -60)),
                          on_time=True, stretch=_SHARED if whole else "part")


def _residuals(time: fig.Side, t: np.ndarray, signals: list[tuple[_Signal, np.ndarray]],
               size: tuple[str, float]) -> fig.Panel:
    """Return measured minus estimated about zero, and say where single peaks are cut off.

    ``size`` is the SI unit and the height of the panel above, beyond which nothing is followed.
    """
    unit, most = size
    half, peak = traces.robust_peak(np.concatenate([values for _, values in signals]))
    if most > 0:
        half = min(half, most)
    panel = fig.Panel(time, fig.Side("residual", fig.axis_scale(half or 1.0, unit),
                                     limits=fig.padded(-half, half)))
    for one, values in signals:
        panel.signal(t, values, f"{one.label}, residual", one.colour, width=1.0, legend=False)
    panel.add(fig.Level(0.0, width=0.8))
    if peak > 1.01 * half:
        panel.add(fig.cut_note(quantity(peak, unit, 2)))
    return panel


def motion_blocks(estimate: Estimate) -> list[fig.Block]:
    """Return pressure difference, position, velocity and acceleration, in that order."""
    motion = _Motion(estimate, _find_window(estimate))
    return [_pressure_block(motion), _position_block(motion), _derivative_block(motion, 1),
            _derivative_block(motion, 2)]


def _find_window(estimate: Estimate) -> _Window:
    """Choose the enlarged part: where the model fits worst if it does not, else a reversal."""
    recording = estimate.recording
    position = recording.get("x")
    if not np.isfinite(position).any():
        position = recording.get("x_d")
    peak = None
    if estimate.model.status == "mismatch":
        verdicts = [s.consistency for s in (estimate.stage_one, estimate.stage_two)
                    if s.consistency is not None and not s.consistency.consistent]
        peak = next((v.peak_time_s for v in verdicts if np.isfinite(v.peak_time_s)), None)
    start, stop, words = traces.informative_window(position, recording.sample_time, peak)
    return _Window(start, stop, words + ("" if peak is None else " near the worst misfit"))


def _pressure_block(motion: _Motion) -> fig.Block:
    """Return the pressure difference, or the measured force where there is no pressure."""
    recording, rig = motion.estimate.recording, motion.estimate.settings.rig
    p1, p2 = recording.get("p1"), recording.get("p2")
    signals, notes = [_Signal("p₁ − p₂, measured", p1 - p2, fig.STAGE_ONE)], ()
    title = "Pressure difference"
    if signals[0].drawable:
        if rig.area_1 and rig.area_2 and abs(rig.area_2 / rig.area_1 - 1) > 1e-3:
            signals.append(_Signal("load pressure p₁ − p₂·A₂/A₁", p1 - p2 * rig.area_2
                                   / rig.area_1, fig.STAGE_TWO))
            notes = ("The areas differ, so the load pressure is plotted.",)
        pictures = motion.pictures(signals, [], "pressure difference", "Pa")
    elif recording.has("force"):
        unit, word = ("N·m", "torque") if rig.motion == "rotary" else ("N", "force")
        title = f"Driving {word}"
        pictures = motion.pictures([_Signal(f"measured {word}", recording.get("force"),
                                            fig.STAGE_ONE)], [], word, unit)
        notes = (f"The pressures were not both recorded; the measured {word} replaces A·Δp.",)
    else:
        pictures = ()
        notes = ("Neither both pressures nor a force were recorded, so there is nothing to show.",)
    return fig.Block("pressure", title, pictures, notes)


def _position_block(motion: _Motion) -> fig.Block:
    """Return position measured and estimated."""
    word = "angle" if motion.unit == "rad" else "position"
    measured = _Signal("measured", motion.estimate.recording.get("x"), fig.MEASURED, 4.0)
    estimated = motion.estimated("position")
    if not measured.drawable and not estimated:
        return fig.Block("position", word.capitalize(),
                         notes=("No position was recorded and none was estimated.",))
    residuals = [replace(one, values=measured.values - one.values) for one in estimated]
    notes = () if estimated else ("No stage had data, so there is no estimate to compare.",)
    return fig.Block("position", word.capitalize(), motion.pictures(
        [measured, *estimated], residuals, word, motion.unit), notes)


def _derivative_block(motion: _Motion, order: int) -> fig.Block:
    """Return velocity (order 1) or acceleration (order 2), measured and estimated."""
    name, which, per = (("velocity", "derivative", "/s"),
                        ("acceleration", "second derivative", "/s²"))[order - 1]
    recording, estimated = motion.estimate.recording, motion.estimated(name)
    smoother = None
    if order == 1 and recording.has("v"):
        measured = _Signal("measured", recording.get("v"), fig.MEASURED, 4.0)
    else:
        smoother = traces.choose_smoother(recording.get("x"), recording.sample_time, order)
        values = smoother.of(recording.get("x")) if smoother else recording.get("none")
        length = quantity(smoother.window * smoother.dt, "s", 2) if smoother else ""
        measured = _Signal(f"{which} of measured position, over {length}", values,
                           fig.MEASURED, 4.0)
    if not measured.drawable and not estimated:
        return fig.Block(name, name.capitalize(), notes=(
            f"No {name} was measured or estimated, and there are too few position samples to "
            "differentiate.",))
    notes: tuple[str, ...] = ()
    if smoother:
        notes = (f"The {name} was not measured: the grey line is the numerical {which} of the "
                 f"position, smoothed over {length}. For the residual the estimate is smoothed in "
                 "the same way.",)
    if not estimated:
        notes += (f"No stage had data to estimate the {name}.",)
    residuals = [replace(one, values=measured.values - (
        smoother.alike(one.values, recording.get("x")) if smoother else one.values))
        for one in estimated]
    return fig.Block(name, name.capitalize(), motion.pictures(
        [measured, *estimated], residuals, name, motion.unit + per), notes)


# ---- the innovations ------------------------------------------------------------------------

def innovation_block(estimate: Estimate, stage: StageResult) -> fig.Block:
    """Return the innovations of one stage: over time, their memory, and the verdict."""
    key, title = f"innovations-{stage.stage}", f"Innovations of stage {stage.stage}"
    z = whitened(stage.innovation, stage.innovation_stddev)
    z = np.where(np.isfinite(z), z, np.nan)
    if not (count := int(np.isfinite(z).sum())):
        return fig.Block(key, title, notes=(
            f"Stage {stage.stage} had no data, so there are no innovations to judge.",))
    colour = fig.STAGE_ONE if stage.stage == "one" else fig.STAGE_TWO
    memory = _memory(stage, z, colour, estimate.recording.sample_time) if count >= 50 else None
    return fig.Block(key, title, (_innovations(stage, z, colour), *([memory] if memory else [])),
                     _innovation_words(stage, count))


def _innovation_words(stage: StageResult, count: int) -> tuple[str, ...]:
    """Say in plain words what the numbers mean."""
    if stage.consistency is None:
        return (f"{count} innovations; too few or too short to judge.",)
    c = stage.consistency
    spread = 2 * np.sqrt(2 / max(c.samples, 1))
    notes = [c.message,
             f"Mean of the squared standardised innovations (NIS): {number(c.nis)}; expected "
             f"{number(max(0.0, 1 - spread))} to {number(1 + spread)} if the noise levels are "
             f"right ({c.samples} innovations). Above this range the filter underestimates its "
             "error; below it, the noise level is set too high."]
    if np.isfinite(c.variance_ratio):
        notes.append(
            f"Sums over blocks of {quantity(c.block_length_s, 's', 3)} vary "
            f"{number(c.variance_ratio, 3)} times as much as those of white noise (expected "
            "about 1). A large number means that the errors are correlated over time: the model "
            "lacks an effect that acts on the actuator.")
    if not c.consistent and np.isfinite(c.peak_time_s):
        notes.append(f"The misfit is worst near {number(c.peak_time_s)} s.")
    return tuple(notes)


def _innovations(stage: StageResult, z: np.ndarray, colour: str) -> fig.Figure:
    """Draw standardised innovations, and their RMS in windows, against time."""
    t, time = stage.time, _time_side(stage.time, _WHOLE, "whole record")
    half, peak = traces.robust_peak(z)
    half = max(4.5, 1.05 * half)
    top = fig.Panel(time, fig.Side("innovation / its σ", limits=(-half, half)))
    top.signal(t, z, "innovation / its σ", colour, width=0.8, legend=False)
    top.add(fig.Level(-2.0, dash="dash"),
            fig.Level(2.0, "±2: 95 % should lie within", dash="dash"))
    if peak > half:
        top.add(fig.cut_note(number(peak, 2)))
    middle, rms = traces.running_rms(z)
    bottom = fig.Panel(time, fig.Side(
        "running RMS,\nexpected 1", limits=(0.0, max(2.0, 1.1 * np.nanmax(rms, initial=0.0)))))
    bottom.add(fig.Curve(np.interp(middle, np.arange(len(t)), t), rms, "running RMS", colour, 1.5,
                         marker="circle" if len(rms) < 4 else "", legend=False),
               fig.Level(1.0, dash="dash"))
    return fig.Figure((top, bottom), f"standardised innovations of stage {stage.stage} against "
                      "time, and their running RMS", (2.0, 1.0), (fig.WIDTH, fig.HEIGHT + 40),
                      on_time=True, stretch=_SHARED)


def _memory(stage: StageResult, z: np.ndarray, colour: str, dt: float) -> fig.Figure | None:
    """Draw the autocorrelation with its 95 % bounds, and the variance of block sums."""
    correlation, used = traces.autocorrelation(z, min(200, len(z) // 4))
    judged = z[np.isfinite(z)]
    lengths, ratios = variance_ratios(judged)
    if not len(correlation) or len(lengths) < 2:
        return None
    lag = np.arange(1, len(correlation) + 1) * dt
    bound = 1.96 / np.sqrt(used)
    reach = max(3 * bound, 1.1 * float(np.nanmax(np.abs(correlation))))
    top = fig.Panel(fig.Side("lag", Scale(1e3, "ms"), limits=(0.0, lag[-1] + 0.5 * dt)),
                    fig.Side("autocorrelation", limits=(-reach, reach)))
    top.add(fig.Span(-bound, bound, "95 % of the lags of white noise"),
            fig.Curve(lag, correlation, "autocorrelation", colour, 0.0, error_width=1.2,
                      legend=False, y_error=np.maximum([correlation, -correlation], 0.0)),
            fig.Level(0.0, width=0.8))
    block, chance = lengths * dt, 2 * np.sqrt(2 / (len(judged) // lengths))
    positive = ratios[ratios > 0]
    bottom = fig.Panel(fig.Side("length of a block", Scale(1.0, "s"), log=True,
                                limits=(block[0], block[-1])),
                       fig.Side("block variance /\nwhite noise", log=True, limits=(
                       min(0.3, 0.7 * positive.min(initial=1.0)),
                       max(3.0, 1.5 * positive.max(initial=1.0)))))
    bottom.add(fig.Band(block, np.maximum(1 - chance, 1e-3), 1 + chance, "95 % of white noise",
                        fig.OTHER, 0.25),
               fig.Curve(block, np.where(ratios > 0, ratios, np.nan), "block variance", colour,
                         marker="circle", size=5.0, legend=False))
    return fig.Figure((top, bottom), "autocorrelation and block variance of the innovations of "
                      f"stage {stage.stage}", (1.0, 1.0), (fig.WIDTH, fig.HEIGHT + 40),
                      shared=False)
