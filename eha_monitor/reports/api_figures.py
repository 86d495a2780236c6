"""What ``plot()`` of the API draws, and the planned motion of ``identify``."""

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np

from eha_monitor.estimation.results import Estimate
from eha_monitor.mismatch.diagnosis import Diagnosis
from eha_monitor.physics.simulator import demanded_position, total_duration
from eha_monitor.quantity import Scale
from eha_monitor.recordings.columns import sampled
from eha_monitor.recordings.recording import Recording
from eha_monitor.reports import diagnosis_figures as figures
from eha_monitor.reports import estimate_figures
from eha_monitor.reports import figure as fig
from eha_monitor.reports.diagnosis_words import compared
from eha_monitor.reports.still_image import Drawing, drawn, words_drawn
from eha_monitor.reports.traces import robust_range
from eha_monitor.settings.monitor import Experiment
from eha_monitor.settings.rig import Rig, Segment
from eha_monitor.words import PARAMETER_WORDS

# Channels that are drawn on the same axes, and what these are called.
_TOGETHER = {"x": "position", "x_d": "position", "v": "velocity", "omega": "pump speed",
             "omega_d": "pump speed", "p1": "pressure", "p2": "pressure", "force": "force",
             "temperature": "temperature"}
_LABELS = {"x": "x", "x_d": "x_d, demanded", "v": "v", "omega": "ω", "omega_d": "ω_d, demanded",
           "p1": "p₁", "p2": "p₂", "force": "force", "temperature": "temperature"}
_ROW, _FOOT = 150, 60  # CSS pixels
_SAMPLES = 4000  # of a demanded motion
_PLANNED_ROW = 130  # CSS pixels
_X, _V, _P1, _P2 = 0, 1, 2, 3  # columns of a prediction


def recording_drawing(recording: Recording, names: Sequence[str], units: Mapping[str, str]
                      ) -> Drawing:
    """Draw channels, by name, against time; those of one quantity on the same axes."""
    groups: dict[str, list[str]] = {}
    for name in names:
        groups.setdefault(_TOGETHER[name], []).append(name)
    clock = fig.time_scale(recording.duration)
    step = recording.sample_time
    time = fig.Side("time", clock, limits=(0.0, max(len(recording) - 1, 1) * step))
    panels = []
    for quantity, members in groups.items():
        columns = [sampled(recording.channels[name]) for name in members]
        scale = fig.scale_of(np.concatenate(columns), units[members[0]])
        low, high, _ = robust_range(columns)
        panel = fig.Panel(time, fig.Side(quantity, scale, limits=fig.padded(low, high)))
        for name, values, colour in zip(members, columns, (fig.STAGE_ONE, fig.STAGE_TWO),
                                        strict=False):
            every = -(-len(recording) // max(len(values), 1))
            panel.signal(np.arange(len(values)) * every * step, values,
                         _LABELS[name], colour, width=1.2, legend=len(members) > 1)
        panels.append(panel)
    return drawn(fig.Figure(tuple(panels), "channels against time", (1.0,) * len(panels),
                            (fig.WIDTH, _ROW * len(groups) + _FOOT)))


def estimate_drawing(estimate: Estimate, names: Sequence[str]) -> Drawing:
    """Draw ``B``, ``beta_e`` or both as they converge, with band and limits."""
    figure = estimate_figures.parameter_figure(estimate_figures.presentable(estimate), names)
    return _drawn(figure, "; ".join(
        f"{PARAMETER_WORDS[name]}: {estimate.parameters[name].message or 'no data'}"
        for name in names))


def diagnosis_drawing(found: Diagnosis, what: str) -> Drawing:
    """Draw ``missing``, ``fit``, ``B`` or ``beta_e``.

    ``missing`` is what the recording shows and the model lacks, the head of the report; ``fit``
    the first signal of unseen data with both models running free; ``B`` and ``beta_e`` a
    parameter as each part of the record gives it.
    """
    found = figures.presentable(found)
    if what == "missing":
        curves = figures.informative(found)
        return _drawn(figures.learned_figure(found.learned[0]) if found.learned
                      else figures.curve_figure(found, curves[0], large=True) if curves
                      else None, found.message)
    if what == "fit":
        made = (figures.overlay_figure(one, compared(found)) for one in found.overlays)
        return _drawn(next(filter(None, made), None),
                      "No data were held out to run the models on.")
    return _drawn(figures.agreement_figure(what, found.agreement, found.before.get(what),
                                           found.after.get(what)),
                  f"{PARAMETER_WORDS[what]}: no value from parts of the recording")


DIAGNOSIS_DRAWINGS = {what: partial(diagnosis_drawing, what=what)
                      for what in ("missing", "fit", "B", "beta_e")}


def motion_drawing(proposed: tuple[dict[str, Segment], str] | None, motion: str) -> Drawing:
    """Draw a proposed motion, segments and sentence, of a ``linear`` or ``rotary`` rig."""
    if proposed is None:
        return words_drawn("No motion is proposed: nothing is in doubt, or no motion resolves it.")
    segments, words = proposed
    time = np.linspace(0.0, total_duration(segments), _SAMPLES, endpoint=False)
    values = demanded_position(segments, time)
    scale = fig.scale_of(values, "rad" if motion == "rotary" else "m")
    panel = fig.Panel(fig.Side("time", Scale(1.0, "s")), fig.Side("demanded position", scale))
    panel.signal(time, values, words, fig.OTHER, width=1.5)
    return drawn(fig.Figure((panel,), words, size=(fig.WIDTH, _ROW + 2 * _FOOT)))


def _drawn(figure: fig.Figure | None, otherwise: str) -> Drawing:
    return words_drawn(otherwise) if figure is None else drawn(figure)


def motion_figure(x_d: np.ndarray, shown: np.ndarray, bounds: Experiment, rig: Rig, words: str
                  ) -> fig.Figure:
    """Return position, speed, acceleration and pressures against time, with their limits.

    Parameters
    ----------
    x_d : (n,) demanded position, m, one value to a sample of the rig.
    shown : (n, N_OUTPUTS) what the model predicts, SI.
    words : what the motion is.
    """
    dt, rotary = rig.sample_time, rig.motion == "rotary"
    time = np.arange(len(x_d)) * dt
    length = "rad" if rotary else "m"
    v = shown[:, _V]
    rows = [("position", length, (bounds.lower, bounds.upper),
             ((shown[:, _X], "predicted", fig.STAGE_ONE), (x_d, "demanded", fig.OTHER))),
            ("velocity", f"{length}/s", (-bounds.speed, bounds.speed),
             ((v, "predicted", fig.STAGE_ONE),)),
            ("acceleration", f"{length}/s²", (-bounds.acceleration, bounds.acceleration),
             ((np.gradient(v, dt), "predicted", fig.STAGE_ONE),)),
            ("pressure", "Pa", (bounds.pressure,),
             ((shown[:, _P1], "chamber 1", fig.STAGE_ONE),
              (shown[:, _P2], "chamber 2", fig.STAGE_TWO)))]
    panels = []
    for name, unit, limits, signals in rows:
        every = np.concatenate([np.array(limits), *(values for values, _, _ in signals)])
        panel = fig.Panel(fig.Side("time", Scale(1.0, "s"), limits=(0.0, float(time[-1]))),
                          fig.Side(name, fig.scale_of(every, unit),
                                   limits=fig.padded(float(every.min()), float(every.max()), 0.1)))
        for values, label, colour in signals:
            panel.signal(time, values, label, colour, width=1.3, legend=len(signals) > 1)
        for at in limits:
            named = not panels and at == limits[0]  # once in the legend is enough
            panel.add(fig.Level(at, "limit" if named else "", fig.ERROR_LINE, dash="dash"))
        panels.append(panel)
    return fig.Figure(tuple(panels), words, (1.0,) * len(panels),
                      (fig.WIDTH, _PLANNED_ROW * len(panels) + _FOOT))
