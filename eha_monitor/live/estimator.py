"""Both stages on a stream of rows: the offline pipeline's decisions, sample by sample.

The compiled stages take the rows in batches, from the state in which the batch before left them.
Hand-over and re-run go over the buffered seconds.  A batch lags by a few samples, because the hold
of an input looks at its neighbours on both sides.
"""

import math

import numpy as np

from eha_monitor.balances.parameters import parameters_of
from eha_monitor.breakdown import begins_anew
from eha_monitor.estimation import stages
from eha_monitor.estimation.drive import LONGEST, takes_speed
from eha_monitor.estimation.inputs import (
    REST_S,
    Known,
    StageInputs,
    position_variance,
    quantum_of,
    resting,
)
from eha_monitor.estimation.model_watch import beyond, ranges_of, within
from eha_monitor.estimation.results import (
    LOOK_S,
    ONE,
    STAGES,
    TWO,
    Event,
    LiveSnapshot,
    ParameterEstimate,
)
from eha_monitor.estimation.rig_model import RigModel, missing, model_for, moved_mass
from eha_monitor.estimation.sensors import noise_levels
from eha_monitor.live import checks
from eha_monitor.live.ingest import BATCH, BUFFER_S, LONG_GAP_S, WARM_UP, Columns, Grid
from eha_monitor.live.state import (
    Change,
    Checkpoints,
    LiveStageOne,
    LiveStageTwo,
    LiveState,
    check,
)
from eha_monitor.physics import signals as s
from eha_monitor.quantity import SYMBOLS, quantity, with_uncertainty
from eha_monitor.recordings.recording import LARGEST, Recording
from eha_monitor.settings.monitor import Settings

PAST = 100  # rows of a batch of the past
WARM_S = 60.0  # without data: for longer the oil need not be as warm as it was
LAG = 6  # rows that the hold looks ahead, and spikes; a smoothed speed more
CONTEXT = 16  # rows that they look back
NOISE_AGAIN_S = (1.0, 4.0, 10.0)  # after the start; then every 10 s
# Of the position's variance (256 rows give it to 20 %): older innovations then say nothing.  Less
# than a model's misfit, which begins at 1.6 (:mod:`consistency`).
OTHER_NOISE = 0.25
SETTLED_S = 0.5  # B counts as changing for so long after it was seen to change
CHANGING_STDDEV = 0.05  # relative, while it does
MOST_CHANGES = 200  # of each stage that are kept


class LiveEstimator:
    """The monitor's pipeline on live rows, without ROS; ``turns`` are shared within a thread."""

    def __init__(self, settings: Settings, turns: checks.Turns | None = None):
        self._given = settings
        self._turns = turns or checks.Turns()
        self._events: list[Event] = []
        self._now = 0.0
        self.reset("")

    def reset(self, reason: str) -> None:
        """Forget everything, estimates included; ``reason`` goes into the events."""
        self._hold, self._zero = checks.LiveHold(self._given), checks.LiveZero()
        self.settings = self._hold.settings
        self.dt = self.settings.rig.sample_time
        self._early: list[tuple[np.ndarray, Columns]] = []  # rows before there is a grid
        self._grid = None
        self._state = LiveState(self.settings, checks.Handover(self.settings),
                                checks.LiveModel(self.settings), list(NOISE_AGAIN_S))
        self._checkpoints = Checkpoints()
        self._model: RigModel | None = None
        self._no_force = self._no_drive = None
        self._began = 0.0
        self._lag, self._context = LAG, CONTEXT
        self._temperature: float | None = None
        self._channels, self._news = frozenset(), 0  # set up for; rows with others
        self._plausible = checks.LivePlausibility(self.settings)
        self._ranges, self._beyond = ranges_of(self.settings), ("", math.nan)
        self._shown: tuple = (None, {})  # the last parameters and what they were judged from
        if reason:
            self._events.append(Event(self._now, "monitor", f"estimates reset: {reason}"))

    # ---- rows ----------------------------------------------------------------------------------

    @begins_anew
    def push_rows(self, times: np.ndarray, columns: Columns) -> None:
        """Take aligned rows at rising times, at most some tenths of a second of them.

        ``columns`` : channel -> (n,) SI, NaN where it has no value.
        """
        if not len(times):
            return
        self._now = float(times[-1])
        warm = columns.get("temperature", np.empty(0))
        warm = warm[np.abs(warm) <= LARGEST["temperature"]]
        if len(warm):
            self._temperature = float(warm[-1])
        if self._grid is None:
            self._wait(times, columns)
            if sum(len(part) for part, _ in self._early) >= WARM_UP:
                self._start()
        elif not self._other_channels(columns):
            self._place(times, columns)
            if self._grid.buffer.end - self._state.taken >= BATCH + self._lag:
                self._take()

    def _wait(self, times: np.ndarray, columns: Columns) -> None:
        """Let rows wait: without a model nothing is carried over a long gap."""
        last = self._early[-1][0][-1] if self._early else times[0]
        gaps = np.flatnonzero(np.diff(times, prepend=last) > LONG_GAP_S)
        if len(gaps):
            self._early.clear()
            times = times[gaps[-1]:]
            columns = {name: values[gaps[-1]:] for name, values in columns.items()}
        self._early.append((times, columns))

    def _other_channels(self, columns: Columns) -> bool:
        """Begin anew where channels have come, to stay, that let a further stage run."""
        news = {name: given for name, values in columns.items()
                if name not in self._channels and (given := np.isfinite(values)).any()}
        if not news:
            return False
        self._news += int(np.count_nonzero(np.any([*news.values()], axis=0)))
        if self._news < WARM_UP:
            return False
        before, self._channels, self._news = self._channels, self._channels | set(news), 0
        begin = missing(self.settings, before) != missing(self.settings, self._channels)
        if begin:
            self.reset(f"{' and '.join(sorted(set(news) - before))} arrived after the start")
        return begin

    def _place(self, times: np.ndarray, columns: Columns) -> None:
        """Put rows to their places; over a long gap parameters stay, states and buffer do not."""
        while (done := self._grid.place(times, columns, self._state.taken)) < len(times):
            times, columns = times[done:], {name: values[done:]
                                            for name, values in columns.items()}
            start, buffer = float(times[0]), self._grid.buffer
            gap = start - self._grid.time_of(buffer.end)
            self._events.append(Event(start, "monitor", f"no data for {gap:.2f} s"))
            if gap > WARM_S:
                self._temperature = None
            self._take(everything=True)
            self._grid = Grid(start, self.dt, frozenset(buffer.seen))
            self._grid.buffer.zero = buffer.zero
            self._state.restart_rows()
            self._checkpoints.clear()

    def past(self, since_s: float) -> list[tuple[np.ndarray, Columns]]:
        """Return the buffered rows from ``since_s`` on, in batches that are soon taken."""
        if self._grid is None:
            return []
        buffer = self._grid.buffer
        first = max(buffer.first, math.ceil(
            min((since_s - self._grid.origin) / self.dt, buffer.end)))
        found = []
        for start in range(first, buffer.end, PAST):
            stop = min(start + PAST, buffer.end)
            columns = buffer.channels(start, stop)
            came = np.any(np.isfinite([*columns.values()]), axis=0)
            found.append((self._grid.time_of(np.arange(start, stop)[came]),
                          {name: values[came] for name, values in columns.items()}))
        return [batch for batch in found if len(batch[0])]

    def withdraw(self, channel: str, since_s: float) -> None:
        """Take back what a channel gave from ``since_s`` on: it was no measurement."""
        if self._grid is None:
            self._early.clear()
            return
        row = max(round((since_s - self._grid.origin) / self.dt), 0)
        before = self._checkpoints.before(row)
        if before is None:
            self.reset(f"{channel} has been invalid since the start")
            return
        self._state = before
        self._grid.buffer.column(channel, row, self._grid.buffer.end)[:] = math.nan
        self._take()

    # ---- start ---------------------------------------------------------------------------------

    def _start(self) -> None:
        """Measure the sample time and the noise on the first rows, then take them."""
        early, self._early = self._early, []
        times = np.concatenate([part for part, _ in early])
        spacing = float(np.median(np.diff(times)))
        if not abs(spacing / self.dt - 1.0) < 0.05 and spacing > 0:
            self._events.append(Event(self._now, "monitor", f"rows come every {spacing * 1e3:.3g} "
                                      f"ms, not every {self.dt * 1e3:.3g} ms as configured"))
            self.dt = spacing
        self._began = float(times[0])
        self._grid = Grid(self._began, self.dt)
        for part in early:
            self._place(*part)
        self._set_up()
        self._take()

    def _set_up(self) -> None:
        settings, buffer = self.settings, self._grid.buffer
        inputs = StageInputs.of(buffer.recording(0, buffer.end), settings)
        self._no_force, self._no_drive = inputs.no_force, inputs.no_drive
        self._channels = frozenset(buffer.seen)
        self._model = inputs.model
        # A late channel waits for the samples that show the present.
        circuit = self._model.circuit
        lead = max(circuit[s.POSITION_DELAY], circuit[s.PRESSURE_DELAY])
        beside = LONGEST if takes_speed(self._model, self._channels) else 0
        self._lag = LAG + beside + math.ceil(lead / self.dt)
        self._context = CONTEXT + beside + math.ceil(
            max(circuit[s.COMMAND_DELAY], circuit[s.FEEDBACK_DELAY]) / self.dt)
        self._measure_noise()
        if self._no_force is None:
            constants = stages.constants_one(inputs, settings)._replace(R=self._state.r)
            self._state.one = LiveStageOne.new(stages.engine_of(settings)[0], self._model,
                                               constants, settings.stage_one.prior)

    def _measure_noise(self) -> None:
        state, buffer = self._state, self._grid.buffer
        recording = buffer.recording(buffer.first, buffer.end)
        state.noise = noise_levels(recording, self.settings.noise)
        state.quantum = quantum_of(recording.channels)
        state.r = (position_variance(state.noise, state.quantum)
                   / (1.0 + self._model.circuit[s.POSITION_SCALE]) ** 2)
        for stage in state.stages:
            stage.set_noise(state.r)

    # ---- filtering -----------------------------------------------------------------------------

    def _take(self, everything: bool = False) -> None:
        """Filter the rows whose neighbours have come."""
        state, buffer = self._state, self._grid.buffer
        stop = buffer.end if everything else buffer.end - self._lag
        if stop <= state.taken:
            return
        context = max(state.taken - self._context, buffer.first)
        inputs = self._inputs_from(context)
        state.damping = self._follow()
        first, end = state.taken - context, stop - context
        for stage, damping in ((state.one, ()), (state.two, state.damping)):
            if stage is None:
                continue
            try:
                out, changes = stage.take(inputs, first, end, *damping)
            except FloatingPointError as problem:
                if stage is state.one:
                    raise
                self._lose_two(problem, stop)
                continue
            self._note(context, ONE if stage is state.one else TWO, out[-2:, first:], changes)
        if inputs.kept.shape[1]:
            buffer.column("kept", state.taken, stop)[:] = inputs.kept[first:end, 0]
        if state.two is not None:
            for name, value in zip(("b", "b_variance"), state.damping, strict=True):
                buffer.column(name, state.taken, stop)[:] = value
        state.taken = stop
        self._supervise()

    def _lose_two(self, problem: FloatingPointError, stop: int) -> None:
        """Go on without stage two, which broke down on rows before ``stop``."""
        state, buffer = self._state, self._grid.buffer
        state.two = None
        buffer.column("nu_two", max(buffer.first, state.taken), stop)[:] = math.nan
        pause = state.handover.lost(self._grid.time_of(stop))
        state.clean = stop + round(0.5 * pause / self.dt)  # what broke it may last for a while
        self._report("two", f"begins anew later: {problem}", stop)

    def _inputs_from(self, start: int) -> StageInputs:
        """Return the stages' inputs of the rows from ``start`` to the end of the buffer."""
        state, buffer = self._state, self._grid.buffer
        before = max(start - math.ceil(REST_S / self.dt), buffer.first)
        rest = resting(buffer.channels(before, buffer.end), state.noise, self.dt, state.quantum)
        return StageInputs.of(
            buffer.recording(start, buffer.end), self.settings,
            Known(self._model, state.noise, state.quantum, self._no_force, self._no_drive,
                  buffer.column("kept", start, start + 1), rest=rest[start - before:]),
            self._grid.time_of(start) - self._began)

    def _inputs(self, start: int) -> StageInputs:
        """Return the inputs of filtered rows from ``start`` on; later rows show late channels."""
        return self._inputs_from(start).part(0, self._state.taken - start)

    def _rows(self, seconds: float) -> Recording:
        """Return the rows of the last seconds, or as many as there are."""
        buffer, taken = self._grid.buffer, self._state.taken
        return buffer.recording(max(buffer.first, taken - round(seconds / self.dt)), taken)

    def _follow(self) -> tuple[float, float]:
        """Return the damping that stage two takes now, and its variance.

        Once handed over it follows stage one from batch to batch.  While B is seen to change it
        lags by up to a block; its variance says so, and stage two looks for no change of its own.
        """
        state = self._state
        if state.handover.damping is None:
            return math.nan, math.nan
        value, stddev = state.handover.damping
        if state.one is not None and self._parameters()["B"].status == "converged":
            value, stddev = state.one.value, state.one.stddev
        if self._changing() and state.two is not None:
            stddev = max(stddev, CHANGING_STDDEV * abs(value))
            state.two.forget_scores()
        return value, stddev**2

    def _changing(self) -> bool:
        """Tell whether B was seen to change within the last moments."""
        changes = self._state.changes["one"]
        return bool(changes) and (self._state.taken - changes[-1][0]) * self.dt < SETTLED_S

    def _note(self, context: int, stage, innovations: np.ndarray, changes: list[Change]) -> None:
        """Keep a batch's innovations and their sigmas, (2, n), and report its changes."""
        state, buffer = self._state, self._grid.buffer
        stop = state.taken + innovations.shape[1]
        for column, values in zip(("nu", "sd"), innovations, strict=True):
            buffer.column(f"{column}_{stage.key}", state.taken, stop)[:] = values
        unit = stage.unit(self.settings)
        for sample, before, after, window in changes:
            number = context + sample
            state.changes[stage.key].append((number, before, after, window))
            del state.changes[stage.key][:-MOST_CHANGES]
            if not state.tester.standing(stage.key):  # else it makes up for what the model lacks
                self._report(stage.key, f"{SYMBOLS[stage.parameter]} changed from "
                             f"{quantity(before, unit)} to {quantity(after, unit)}", number)
            if stage is TWO and abs(after / before - 1.0) > stages.LARGE:
                state.stale_piece = True  # run again from the bank once some seconds show it
            if stage is ONE:
                state.piece = max(number - window, buffer.first)
                state.stale_piece = True

    def _report(self, stage: str, text: str, number: int | None = None) -> None:
        at = self._grid.time_of(self._state.taken if number is None else number)
        self._events.append(Event(at, stage, text))

    # ---- supervision ---------------------------------------------------------------------------

    def _supervise(self) -> None:
        state, buffer = self._state, self._grid.buffer
        since_start = state.taken * self.dt
        if state.noise_at and since_start >= state.noise_at[0]:
            before = state.r
            self._measure_noise()
            if abs(state.r / before - 1.0) > OTHER_NOISE:
                state.tester.judge_from(state.taken)
            state.noise_at = state.noise_at[1:] or [state.noise_at[0] + 10.0]
        if self._no_drive is None and self._turns.free(self):
            self._hand_over(since_start)
        self._checkpoints.keep(state, self.dt)
        if self._plausible.due(self._now, (buffer.end - buffer.first) * self.dt) and (
                self._turns.free(self)):
            news = self._plausible.examine(self._now, buffer.recording(buffer.first, buffer.end))
            if news is not None:
                self._turns.took(self)
            if news:
                self._report("monitor", news)
        if (state.taken - state.tester.judged_at) * self.dt >= checks.JUDGE_EVERY_S:
            self._judge()
        estimates = self._parameters()
        state.tester.follow(self._now, estimates)
        for stage in STAGES.values():
            estimate = estimates[stage.parameter]
            if estimate.status == "converged" and stage.parameter not in state.announced:
                state.announced.add(stage.parameter)
                self._report(stage.key,
                             f"{SYMBOLS[stage.parameter]} converged at {estimate.shown}")

    def _judge(self) -> None:
        """Test the model on the last window; while it does not fit, see whether it does again."""
        state, tester = self._state, self._state.tester
        now = self._grid.time_of(state.taken)
        for found in tester.judge(self._grid.buffer, state.taken, state.changes,
                                  self._parameters(), state.quantum, self._grid.time_of):
            self._report(found.stage, f"mismatch: {found.message.partition(': ')[2]}")
        for stage in state.stages:
            stage.forget(*checks.KEPT)
        standing = [stage for stage in STAGES if tester.standing(stage)]
        if standing:
            tester.look_beside(self._now, self._rows)
        start = state.taken - round(checks.JUDGED_S / self.dt)
        self._look_beyond(start, now)
        if not standing or start < self._grid.buffer.first or not tester.trying.due(now) or (
                standing[0] == "two" and state.two is None):
            return
        # Stage two's misfit may be a wrong B's: it is tried once stage one fits.
        fit, ended = tester.try_again(standing[0], self._inputs(start), state.damping, now)
        # To try stage two costs much where the answer is no: it is tried less and less often.
        tester.trying.answered(now, yes=fit.fits or standing[0] == "one")
        if ended:
            self._adopt(standing[0], fit, start)

    def _look_beyond(self, start: int, now: float) -> None:
        """See whether the last window left the range of what was learned; report it once."""
        words = beyond(self._ranges, self._grid.buffer.channels(start, self._state.taken), self.dt,
                       self.settings.rig.position_gain) if self._ranges else ""
        if words and not self._beyond[0]:
            self._report("monitor", words)
        since = self._beyond[1] if words and self._beyond[0] else now - checks.JUDGED_S
        self._beyond = words, since if words else math.nan

    def rehearse(self) -> None:
        """Do once what a mismatch will ask for, so that its compiled code is loaded."""
        parameters_of(self._rows(LOOK_S), self.settings)
        state, buffer = self._state, self._grid.buffer
        start = max(buffer.first, state.taken - round(BUFFER_S / self.dt))
        for stage in STAGES:
            state.tester.try_again(stage, self._inputs(start), state.damping, self._now)

    def _adopt(self, stage: str, fit: checks.Fit, start: int) -> None:
        """Carry on from a window that fits: what came before it no longer counts."""
        state, buffer = self._state, self._grid.buffer
        self._report(stage, "the model fits again since t = "
                     f"{self._grid.time_of(start):.1f} s")
        if stage == "one":
            state.one.carry_on(fit.value, fit.stddev)
            buffer.column("nu_one", start, state.taken)[:] = fit.innovation
            buffer.column("sd_one", start, state.taken)[:] = fit.innovation_stddev
            state.changes["one"] = []
            state.tester.first["one"] = start
            state.handover.give((fit.value, fit.stddev), self._grid.time_of(state.taken))
            state.piece, state.stale_piece = start, False
        if state.two is not None:
            state.clean = state.tester.first["two"] = start
            self._run_two_again()

    # ---- stage two over the buffer -------------------------------------------------------------

    def _hand_over(self, since_start: float) -> None:
        """Give stage two a damping, and run it again when that is worth it."""
        state = self._state
        decided = (self._decide_hold() or self._move_zero()) if state.two is not None else False
        why = None if self._changing() and state.two is not None else state.handover.decide(
            self._grid.time_of(state.taken), self._parameters()["B"], state.two,
            waited=since_start, stale=state.stale_piece, fits=not state.tester.standing("two"))
        if why is None and not decided:
            return
        if state.two is None:
            self._decide_hold()
        again = "runs" if state.two is None else "re-run"
        given = with_uncertainty(*state.handover.damping, ONE.unit(self.settings))
        state.stale_piece = False
        self._run_two_again()
        if state.two is not None:
            self._report("two", f"{again} with B = {given} {why or 'as before'}")

    def _decide_hold(self) -> bool:
        """Examine the rows, until they decide it, for whether the drive holds its command."""
        state, buffer = self._state, self._grid.buffer
        now = self._grid.time_of(state.taken)
        if not self._hold.due(now):
            return False
        self._turns.took(self)
        if not self._hold.examine(now, buffer.recording(buffer.first, state.taken)):
            return False
        self.settings = self._hold.settings
        self._model = model_for(buffer.channels(buffer.first, state.taken), self.settings)
        if state.one is not None:
            state.one.use(self._model, moved_mass(self._model, self.dt))
        self._report("two", self._hold.sentence)
        return True

    def _move_zero(self) -> bool:
        """Examine the rows for the zero of the setpoint; tell whether it has moved."""
        state, buffer = self._state, self._grid.buffer
        now = self._grid.time_of(state.taken)
        if not self._zero.due(now):
            return False
        self._turns.took(self)
        moved, said = self._zero.examine(
            now, buffer.recording(buffer.first, state.taken), self.settings)
        if not moved:
            return False
        buffer.zero += moved
        self._report("two", said)
        return True

    def _run_two_again(self) -> None:
        """Run stage two over the buffer with the present damping, and go on from there."""
        state, buffer = self._state, self._grid.buffer
        self._turns.took(self)
        start, stop = max(buffer.first, state.clean), state.taken
        b, variance = buffer.column("b", start, stop), buffer.column("b_variance", start, stop)
        edge = max(state.piece - start, 0)  # from where the last change was first at work
        value, stddev = state.handover.damping
        b[edge:], variance[edge:] = value, stddev**2
        b[np.isnan(b)], variance[np.isnan(variance)] = value, stddev**2
        inputs = self._inputs(start)
        found = stages.run_stage_two_kernel(inputs, self.settings, b, variance)
        try:
            check(found.out, LiveStageTwo.sigma)
        except FloatingPointError as problem:
            self._lose_two(problem, stop)
            return
        self._hold.compare(found, buffer.recording(start, stop), b, variance)
        constants = stages.constants_two(inputs, self.settings)._replace(R=state.r)
        two = LiveStageTwo(run=stages.engine_of(self.settings)[1], model=self._model,
                           constants=constants, state=found.state, b_variance=variance[-1])
        if two.held and self._parameters()["beta_e"].status == "converged":
            return  # the buffer, begun anew after a gap, tells less
        state.two = two
        buffer.column("nu_two", start, stop)[:] = found.out[TWO.innovation]
        buffer.column("sd_two", start, stop)[:] = found.out[TWO.innovation_stddev]
        state.changes["two"] = [(start + int(row[0]), row[1], row[2], int(row[3]))
                                for row in found.changes]

    # ---- answers -------------------------------------------------------------------------------

    def _parameters(self) -> dict[str, ParameterEstimate]:
        state = self._state
        lacking = ("no data yet",) * 2 if self._grid is None else (
            self._no_force or "no data yet", self._no_drive or state.handover.waits)
        values = tuple((stage.value, stage.stddev) if stage else None
                       for stage in (state.one, state.two))
        key = values, lacking, self._hold.apart, id(self.settings)
        if key != self._shown[0]:
            shown = {}
            for stage, value, reason in zip((ONE, TWO), values, lacking, strict=True):
                if value is None:
                    shown[stage.parameter] = stage.no_data(self.settings, reason)
                    continue
                # What two holds differ in beta_e while nothing tells them apart.
                apart = self._hold.apart * value[0] if stage is TWO else 0.0
                shown[stage.parameter] = stage.judged(
                    self.settings, value[0], math.hypot(value[1], apart))
            self._shown = key, shown
        return self._shown[1]

    def snapshot(self) -> LiveSnapshot:
        """Return the present estimates; the events are handed out once."""
        state = self._state
        events, self._events = tuple(sorted(self._events, key=lambda e: e.time_s)), []
        estimates = self._parameters()
        model = within(state.tester.status(self._now, estimates), *self._beyond)
        runs = state.one or state.two
        position, velocity = map(float, runs.state.x[:2]) if runs else (math.nan, math.nan)
        return self._plausible.applied(LiveSnapshot(
            self._now, estimates, position, velocity, model, events, self._temperature,
            dict(state.tester.verdicts),
            self._grid.time_of(state.taken - 1) if state.taken else math.nan))
