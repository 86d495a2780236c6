"""What the live estimator does when stage two must be run over the buffered rows again."""

import numpy as np

from eha_monitor.filters import run_two
from eha_monitor.filters.engine import engine_of
from eha_monitor.filters.inputs import StageInputs, model_for, moved_mass
from eha_monitor.filters.live_stages import LiveStageTwo, check
from eha_monitor.filters.status import units_of
from eha_monitor.quantity import with_uncertainty


class RunAgain:
    """Hand-over, and the runs of stage two over the buffer; a part of :class:`LiveEstimator`."""

    def _hand_over(self, since_start: float) -> None:
        """Give stage two a damping, and run it again when that is worth it."""
        told = self._told_hold() if self._two is not None else False
        why = None if self._changing() and self._two is not None else self._handover.decide(
            self._time_of(self._taken), self._parameters()["B"], self._two, waited=since_start,
            stale=self._stale_piece, fits=not self._tester.standing("two"))
        if why is None and not told:
            return
        if self._two is None:
            self._told_hold()
        why = why or "as before"
        again = "runs" if self._two is None else "re-run"
        self._stale_piece = False
        self._run_two_again()
        given = with_uncertainty(*self._handover.damping, units_of(self.settings.rig.motion)["B"])
        self._tell("two", f"{again} with B = {given} {why}")

    def _told_hold(self) -> bool:
        """Ask the buffered rows, while they have not told, whether the drive holds its command."""
        now, buffer = self._time_of(self._taken), self._buffer
        if not self._hold.due(now) or not self._hold.ask(
                now, buffer.recording(buffer.first, self._taken)):
            return False
        self.settings = self._hold.settings
        self._model = model_for(buffer.channels(buffer.first, self._taken), self.settings)
        if self._one is not None:
            self._one.use(self._model, moved_mass(self._model, self.dt))
        self._tell("two", self._hold.sentence)
        return True

    def _run_two_again(self) -> None:
        """Run stage two over the buffer with the present damping, and go on from there."""
        buffer = self._buffer
        start, stop = max(buffer.first, self._clean), self._taken
        b, variance = buffer.column("b", start, stop), buffer.column("b_variance", start, stop)
        edge = max(self._piece - start, 0)  # from where the last change was first at work
        value, stddev = self._handover.damping
        b[edge:], variance[edge:] = value, stddev**2
        b[np.isnan(b)], variance[np.isnan(variance)] = value, stddev**2
        found = run_two.run_stage_two_kernel(self._inputs(start, stop), self.settings, b, variance)
        check(found.out, LiveStageTwo.sigma)
        self._hold.compare(found, buffer.recording(start, stop), b, variance)
        before, status = self._two, self._parameters()["beta_e"].status
        self._two = LiveStageTwo.after(
            found, engine_of(self.settings)[1], self._model, self.dt, self._r,
            run_two.force_noise_variance(self.settings), run_two.prior_variance(self.settings))
        self._two.b_variance = variance[-1]
        if status == "converged" and self._two.held:
            self._two = before  # the buffer, begun anew after a gap, tells less
            return
        buffer.column("nu_two", start, stop)[:] = found.out[6]
        buffer.column("sd_two", start, stop)[:] = found.out[7]
        self._changes["two"] = [(start + int(row[0]), row[1], row[2], int(row[3]))
                                for row in found.changes]

    def _inputs(self, start: int, stop: int) -> StageInputs:
        """Return the stages' inputs of rows that were filtered."""
        # The rows after them are needed to read late channels.
        recording = self._buffer.recording(start, self._buffer.end)
        inputs = StageInputs.of(
            recording, self.settings, self._known(start), self._time_of(start) - self._began)
        return inputs.part(0, stop - start)
