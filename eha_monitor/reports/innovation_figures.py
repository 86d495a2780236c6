"""Whether the innovations are what the filter expects: small, and without memory."""

import numpy as np
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from eha_monitor.estimation.consistency import variance_ratios, whitened
from eha_monitor.estimation.results import Estimate, StageResult
from eha_monitor.quantity import number, quantity
from eha_monitor.reports.axes import time_scale
from eha_monitor.reports.drawing import (
    HEIGHT,
    INK,
    OTHER,
    STAGE_ONE,
    STAGE_TWO,
    Block,
    Picture,
    draw,
    legend_above,
    new_figure,
    picture,
)
from eha_monitor.reports.traces import autocorrelation, running_rms


def standardised(stage: StageResult) -> np.ndarray:
    """Return innovation over its expected standard deviation; (n,), NaN where there is none."""
    z = whitened(stage.innovation, stage.innovation_stddev)
    return np.where(np.isfinite(z), z, np.nan)


def innovation_block(estimate: Estimate, stage: StageResult) -> Block:
    """Return the innovations of one stage: over time, their memory, and the verdict."""
    key, title = f"innovations-{stage.stage}", f"Innovations of stage {stage.stage}"
    z = standardised(stage)
    count = int(np.isfinite(z).sum())
    if not count:
        return Block(key, title, notes=(
            f"Stage {stage.stage} had no data, so there are no innovations to judge.",))
    colour = STAGE_ONE if stage.stage == "one" else STAGE_TWO
    dt = estimate.recording.sample_time
    pictures = [_over_time(stage, z, colour)]
    memory = _memory(stage, z, colour, dt) if count >= 50 else None
    if memory:
        pictures.append(memory)
    return Block(key, title, pictures=tuple(pictures), notes=_words(stage, count))


def _words(stage: StageResult, count: int) -> tuple[str, ...]:
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


def _over_time(stage: StageResult, z: np.ndarray, colour: str) -> Picture:
    """Standardised innovations, and their RMS in windows, against time."""
    clock = time_scale(float(stage.time[-1] - stage.time[0]))
    t = stage.time * clock.factor
    figure, (top, bottom) = new_figure(2, (2.0, 1.0), HEIGHT + 40)
    draw(top, t, z, color=colour, linewidth=0.8)
    for level in (-2, 2):
        top.axhline(level, color=INK, linewidth=1.0, linestyle=(0, (4, 3)),
                    label="±2: 95 % should lie within" if level == 2 else None)
    top.set_ylabel("innovation / its σ")
    reach = max(4.5, 1.05 * np.nanmax(np.abs(z)))
    top.set_ylim(-reach, reach)
    legend_above(top)
    middle, rms = running_rms(z)
    bottom.plot(np.interp(middle, np.arange(len(t)), t), rms, color=colour, linewidth=1.5,
                marker="o" if len(rms) < 4 else None)
    bottom.axhline(1.0, color=INK, linewidth=1.0, linestyle=(0, (4, 3)))
    bottom.set_ylim(0, max(2.0, 1.1 * np.nanmax(rms, initial=0.0)))
    bottom.set_ylabel("running RMS,\nexpected 1")
    bottom.set_xlabel(f"time, {clock.unit} — whole record")
    if len(t) > 1:
        bottom.set_xlim(t[0], t[-1])
    return picture(figure, f"standardised innovations of stage {stage.stage} against time, "
                           "and their running RMS", clock.factor, "record")


def _memory(stage: StageResult, z: np.ndarray, colour: str, dt: float) -> Picture | None:
    """Autocorrelation with its 95 % bounds, and the variance of block sums."""
    correlation, used = autocorrelation(z, min(200, len(z) // 4))
    judged = z[np.isfinite(z)]
    lengths, ratios = variance_ratios(judged)
    if not len(correlation) or len(lengths) < 2:
        return None
    figure, (top, bottom) = new_figure(2, (1.0, 1.0), HEIGHT + 40, share=False)
    lag = np.arange(1, len(correlation) + 1) * dt * 1e3
    bound = 1.96 / np.sqrt(used)
    top.vlines(lag, 0, correlation, color=colour, linewidth=1.2)
    top.axhspan(-bound, bound, color=OTHER, alpha=0.25, linewidth=0,
                label="95 % of the lags of white noise")
    top.axhline(0, color=INK, linewidth=0.8)
    reach = max(3 * bound, 1.1 * float(np.nanmax(np.abs(correlation))))
    top.set_ylim(-reach, reach)
    top.set_xlim(0, lag[-1] + 0.5 * dt * 1e3)
    top.set_ylabel("autocorrelation")
    top.set_xlabel("lag, ms")
    legend_above(top)
    block = lengths * dt
    blocks = len(judged) // lengths
    chance = 2 * np.sqrt(2 / blocks)
    bottom.fill_between(block, np.maximum(1 - chance, 1e-3), 1 + chance, color=OTHER, alpha=0.25,
                        linewidth=0, label="95 % of white noise")
    bottom.plot(block, ratios, color=colour, marker="o", markersize=4, linewidth=1.4)
    bottom.set_xscale("log")
    bottom.set_yscale("log")
    positive = ratios[ratios > 0]
    bottom.set_ylim(min(0.3, 0.7 * positive.min(initial=1.0)),
                    max(3.0, 1.5 * positive.max(initial=1.0)))
    for side, many in ((bottom.xaxis, 4), (bottom.yaxis, 3)):
        low, high = side.get_view_interval()
        short = high / max(low, 1e-300) < 10**many
        side.set_major_locator(LogLocator(10, (1.0, 3.0) if short else (1.0,), numticks=8))
        side.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        side.set_minor_formatter(NullFormatter())
    bottom.set_xlim(block[0], block[-1])
    bottom.set_ylabel("block variance /\nwhite noise")
    bottom.set_xlabel("length of a block, s")
    legend_above(bottom)
    return picture(figure, "autocorrelation and block variance of the innovations of stage "
                           f"{stage.stage}")
