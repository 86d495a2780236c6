"""Both stages on a stream of rows: the offline pipeline's decisions, sample by sample.

The compiled stages take the rows in batches, from the state in which the batch before left them.
Hand-over and re-run go over the buffered seconds.  A batch lags by a few samples, because the hold
of an input looks at its neighbours on both sides.
"""

import math

import numpy as np

from eha_monitor.filters import run_two
from eha_monitor.filters.covered import beyond, ranges_of, within
from eha_monitor.filters.engine import engine_of
from eha_monitor.filters.handover import Handover
from eha_monitor.filters.inputs import (
    Known,
    RigModel,
    StageInputs,
    moved_mass,
    position_variance,
    quantum_of,
)
from eha_monitor.filters.live_again import RunAgain
from eha_monitor.filters.live_buffer import LiveBuffer
from eha_monitor.filters.live_hold import LiveHold
from eha_monitor.filters.live_intake import BUFFER_S, Intake
from eha_monitor.filters.live_model import JUDGE_EVERY_S, JUDGED_S, KEPT, Fit, LiveModel
from eha_monitor.filters.live_plausible import LivePlausibility
from eha_monitor.filters.live_stages import Change, LiveStageOne, LiveStageTwo
from eha_monitor.filters.noise import noise_levels
from eha_monitor.filters.results import Event, LiveSnapshot, ParameterEstimate
from eha_monitor.filters.rewind import Checkpoints
from eha_monitor.filters.status import parameters_of, units_of
from eha_monitor.physics import signals as s
from eha_monitor.quantity import SYMBOLS, quantity
from eha_monitor.settings.monitor import Settings

LAG = 6  # rows that the hold looks ahead: five for the instrument, one for its next sample
CONTEXT = 16  # rows that it looks back
NOISE_AGAIN_S = (1.0, 4.0, 10.0)  # after the start; then every 10 s
# Of the position's variance (256 rows give it to 20 %): older innovations then say nothing.
OTHER_NOISE = 0.05
SETTLED_S = 0.5  # B counts as changing for so long after it was seen to change
CHANGING_STDDEV = 0.05  # relative, while it does


class LiveEstimator(Intake, RunAgain):
    """The monitor's pipeline on live rows; knows nothing of ROS."""

    def __init__(self, settings: Settings):
        self._given = settings
        self._events: list[Event] = []
        self._now = 0.0
        self.reset("")

    def reset(self, reason: str) -> None:
        """Forget everything, estimates included; ``reason`` goes into the events."""
        self._hold = LiveHold(self._given)
        self.settings = self._hold.settings
        self.dt = self.settings.rig.sample_time
        self._waiting: list[tuple[float, dict[str, float]]] = []  # rows that came one by one
        self._early: list[tuple[np.ndarray, dict[str, np.ndarray]]] = []
        self._buffer: LiveBuffer | None = None
        self._one: LiveStageOne | None = None
        self._two: LiveStageTwo | None = None
        self._model: RigModel | None = None
        self._taken = 0
        self._origin = self._began = 0.0
        self._lag, self._context, self._off = LAG, CONTEXT, 0.0
        self._temperature: float | None = None
        self._handover = Handover(self.settings)
        self._damping = (math.nan, math.nan)
        self._channels, self._news = frozenset(), 0  # set up for; rows with others
        self._piece = 0  # first row that the present damping holds for
        self._stale_piece = False  # B has changed since stage two was run over the buffer
        self._changes: dict[str, list[tuple[int, float, float, int]]] = {"one": [], "two": []}
        self._tester = LiveModel(self.settings)
        self._clean = 0  # row from which on stage two is run again
        self._noise_at = list(NOISE_AGAIN_S)
        self._checkpoints = Checkpoints()
        self._plausible = LivePlausibility(self.settings)
        self._announced: set[str] = set()
        self._ranges, self._beyond = ranges_of(self.settings), ("", math.nan)
        self._told: tuple = (None, {})  # the last parameters and what they were judged from
        if reason:
            self._events.append(Event(self._now, "monitor", f"estimates reset: {reason}"))

    def _start(self) -> None:
        """Measure the sample time and the noise on the first rows, then take them."""
        times = np.concatenate([part for part, _ in self._early])
        spacing = float(np.median(np.diff(times)))
        if not abs(spacing / self.dt - 1.0) < 0.05 and spacing > 0:
            self._events.append(Event(self._now, "monitor", f"rows come every {spacing * 1e3:.3g} "
                                      f"ms, not every {self.dt * 1e3:.3g} ms as configured"))
            self.dt = spacing
        self._buffer = LiveBuffer(BUFFER_S, self.dt)
        self._origin = self._began = float(times[0])
        while self._early:
            self._place(*self._early.pop(0))
        self._set_up()
        self._take()

    def _set_up(self) -> None:
        settings, buffer = self.settings, self._buffer
        inputs = StageInputs.of(buffer.recording(0, buffer.end), settings)
        self._no_force, self._no_drive = inputs.no_force, inputs.no_drive
        self._channels = frozenset(buffer.seen)
        self._model = inputs.model
        # A late channel waits for the samples that show the present.
        circuit = self._model.circuit
        lead = max(circuit[s.POSITION_DELAY], circuit[s.PRESSURE_DELAY])
        self._lag = LAG + math.ceil(lead / self.dt)
        self._context = CONTEXT + math.ceil(
            max(circuit[s.COMMAND_DELAY], circuit[s.FEEDBACK_DELAY]) / self.dt)
        self._measure_noise()
        if self._no_force is None:
            self._one = LiveStageOne.new(
                engine_of(settings)[0], self._model, moved_mass(self._model, self.dt), self.dt,
                self._r, settings.stage_one.prior, settings.stage_one.prior_stddev,
                settings.discretisation == "euler")

    def _measure_noise(self) -> None:
        recording = self._buffer.recording(self._buffer.first, self._buffer.end)
        self._noise = noise_levels(recording, self.settings.noise)
        self._quantum = quantum_of(recording.channels)
        self._r = (position_variance(self._noise, self._quantum)
                   / (1.0 + self._model.circuit[s.POSITION_SCALE]) ** 2)
        for stage in filter(None, (self._one, self._two)):
            stage.r = self._r

    def _known(self, start: int) -> Known:
        """Return what is known about the rows from ``start`` on."""
        return Known(self._model, self._noise, self._quantum, self._no_force, self._no_drive,
                     self._buffer.column("kept", start, start + 1))

    def _take(self, everything: bool = False) -> None:
        """Filter the rows whose neighbours have come."""
        buffer = self._buffer
        stop = buffer.end if everything else buffer.end - self._lag
        if stop <= self._taken:
            return
        context = max(self._taken - self._context, buffer.first)
        inputs = StageInputs.of(
            buffer.recording(context, buffer.end), self.settings,
            self._known(context), self._time_of(context) - self._began)
        self._damping = self._follow()
        first, end = self._taken - context, stop - context
        if self._one is not None:
            out, changes = self._one.take(inputs, first, end)
            self._note(context, "one", out[4:, first:], changes)
        if self._two is not None:
            out, changes = self._two.take(inputs, first, end, *self._damping)
            self._note(context, "two", out[6:, first:], changes)
        if inputs.kept.shape[1]:
            buffer.column("kept", self._taken, stop)[:] = inputs.kept[first:end, 0]
        if self._two is not None:
            buffer.column("b", self._taken, stop)[:] = self._damping[0]
            buffer.column("b_variance", self._taken, stop)[:] = self._damping[1]
        self._taken = stop
        self._supervise()

    def _follow(self) -> tuple[float, float]:
        """Return the damping that stage two takes now, and its variance.

        Once handed over it follows stage one from batch to batch.  While B is seen to change it
        lags by up to a block; its variance says so, and stage two looks for no change of its own.
        """
        if self._handover.damping is None:
            return math.nan, math.nan
        value, stddev = self._handover.damping
        if self._one is not None and self._parameters()["B"].status == "converged":
            value, stddev = self._one.value, self._one.stddev
        if self._changing() and self._two is not None:
            stddev = max(stddev, CHANGING_STDDEV * abs(value))
            self._two.forget_scores()
        return value, stddev**2

    def _changing(self) -> bool:
        """Tell whether B was seen to change within the last moments."""
        changes = self._changes["one"]
        return bool(changes) and (self._taken - changes[-1][0]) * self.dt < SETTLED_S

    def _note(self, context: int, which: str, innovations: np.ndarray,
              changes: list[Change]) -> None:
        """Keep a batch's innovations and their sigmas, (2, n), and tell its changes."""
        stop = self._taken + innovations.shape[1]
        for column, values in zip(("nu", "sd"), innovations, strict=True):
            self._buffer.column(f"{column}_{which}", self._taken, stop)[:] = values
        name = "B" if which == "one" else "beta_e"
        unit = units_of(self.settings.rig.motion)[name]
        for sample, before, after, window in changes:
            number = context + sample
            self._changes[which].append((number, before, after, window))
            del self._changes[which][:-200]
            self._tell(which, f"{SYMBOLS[name]} changed from {quantity(before, unit)} to "
                       f"{quantity(after, unit)}", number)
            if which == "two" and abs(after / before - 1.0) > run_two.LARGE:
                self._stale_piece = True  # run again from the bank once some seconds show it
            if which == "one":
                self._piece = max(number - window, self._buffer.first)
                self._stale_piece = True

    def _tell(self, stage: str, text: str, number: int | None = None) -> None:
        at = self._time_of(self._taken if number is None else number)
        self._events.append(Event(at, stage, text))

    def _time_of(self, number: int) -> float:
        return self._origin + number * self.dt

    def withdraw(self, channel: str, since_s: float) -> None:
        """Take back what a channel gave from ``since_s`` on: it was no measurement."""
        self._settle()
        if self._buffer is None:
            self._early.clear()
            return
        row = max(round((since_s - self._origin) / self.dt), 0)
        if not self._checkpoints.back(self, row):
            self.reset(f"{channel} has been invalid since the start")
            return
        self._buffer.column(channel, row, self._buffer.end)[:] = math.nan
        self._take()

    def _supervise(self) -> None:
        since_start = self._taken * self.dt
        if self._noise_at and since_start >= self._noise_at[0]:
            before = self._r
            self._measure_noise()
            if abs(self._r / before - 1.0) > OTHER_NOISE:
                self._tester.judge_from(self._taken)
            self._noise_at = self._noise_at[1:] or [self._noise_at[0] + 10.0]
        if self._no_drive is None:
            self._hand_over(since_start)
        self._checkpoints.keep(self, self._taken, self.dt)
        held = (self._buffer.end - self._buffer.first) * self.dt
        if self._plausible.due(self._now, held):
            news = self._plausible.ask(
                self._now, self._buffer.recording(self._buffer.first, self._buffer.end))
            if news:
                self._tell("monitor", news)
        self._tester.go_on(self._time_of(self._taken))
        if (self._taken - self._tester.judged_at) * self.dt >= JUDGE_EVERY_S:
            self._judge()
        for name, estimate in self._parameters().items():
            if estimate.status == "converged" and name not in self._announced:
                self._announced.add(name)
                self._tell("one" if name == "B" else "two",
                           f"{SYMBOLS[name]} converged at {estimate.shown}")

    def _judge(self) -> None:
        """Test the model on the last window; while it does not fit, ask whether it does again."""
        tester, now = self._tester, self._time_of(self._taken)
        for found in tester.judge(self._buffer, self._taken, self._changes, self._parameters(),
                                  self._quantum, self._time_of):
            self._tell(found.stage, f"mismatch: {found.message}")
        for stage in filter(None, (self._one, self._two)):
            stage.forget(*KEPT)
        standing = [stage for stage in ("one", "two") if tester.standing(stage)]
        if standing:
            tester.measure(self._last, self._parameters(), self._damping[0], self._two, now)
        start = self._taken - round(JUDGED_S / self.dt)
        self._look_beyond(start, now)
        if not standing or start < self._buffer.first or not tester.trying.due(now):
            return
        # Stage two's misfit may be a wrong B's: it is asked once stage one fits.
        fit, ended = tester.try_again(standing[0], self._inputs(start, self._taken),
                                      self._damping, now)
        # To ask stage two costs much where the answer is no: it is asked less and less often.
        tester.trying.answered(now, yes=fit.fits or standing[0] == "one")
        if ended:
            self._adopt(standing[0], fit, start)

    def _look_beyond(self, start: int, now: float) -> None:
        """Ask whether the last window left the range of what was learned; say so once."""
        words = beyond(self._ranges, self._buffer.channels(start, self._taken), self.dt,
                       self.settings.rig.position_gain) if self._ranges else ""
        if words and not self._beyond[0]:
            self._tell("monitor", words)
        since = self._beyond[1] if words and self._beyond[0] else now - JUDGED_S
        self._beyond = words, since if words else math.nan

    def _last(self, seconds: float) -> StageInputs:
        """Return the inputs of the last seconds, or of as many as there are."""
        start = max(self._buffer.first, self._taken - round(seconds / self.dt))
        return self._inputs(start, self._taken)

    def rehearse(self) -> None:
        """Do once what a mismatch will ask for, so that its compiled code is loaded."""
        for stage in ("one", "two"):
            self._tester.try_again(stage, self._last(BUFFER_S), self._damping, self._now)

    def _adopt(self, stage: str, fit: Fit, start: int) -> None:
        """Carry on from a window that fits: what came before it no longer counts."""
        self._tell(stage, f"the model fits again since t = {self._time_of(start):.1f} s")
        buffer, stop = self._buffer, self._taken
        if stage == "one":
            self._one.carry_on(fit.value, fit.stddev)
            buffer.column("nu_one", start, stop)[:] = fit.innovation
            buffer.column("sd_one", start, stop)[:] = fit.innovation_stddev
            self._changes["one"] = []
            self._tester.first["one"] = start
            self._handover.give((fit.value, fit.stddev), self._time_of(stop))
            self._piece, self._stale_piece = start, False
        if self._two is not None:
            self._clean = self._tester.first["two"] = start
            self._run_two_again()

    def _parameters(self) -> dict[str, ParameterEstimate]:
        lacking = ("no data yet",) * 2 if self._buffer is None else (
            self._no_force or "no data yet", self._no_drive or "waits for stage one")
        told = tuple((stage.value, stage.stddev) if stage else None
                     for stage in (self._one, self._two))
        key = told, lacking, self._hold.apart, id(self.settings)
        if key != self._told[0]:
            self._told = key, parameters_of(self.settings, self._one, self._two, lacking,
                                            self._hold.apart)
        return self._told[1]

    def snapshot(self) -> LiveSnapshot:
        """Return the present estimates; the events are handed out once."""
        self._settle()
        events, self._events = tuple(sorted(self._events, key=lambda e: e.time_s)), []
        model = within(self._tester.status(self._now, self._parameters(), self._two),
                       *self._beyond)
        state = self._one or self._two
        position, velocity = map(float, state.m[:2]) if state else (math.nan, math.nan)
        return self._plausible.told(LiveSnapshot(
            self._now, self._parameters(), position, velocity, model, events, self._temperature,
            dict(self._tester.verdicts),
            self._time_of(self._taken - 1) if self._taken else math.nan))
