"""Health against the machine file of healthy recordings: when to compare, and what has changed."""

import shutil
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from eha_monitor.balances.policy import POLICY
from eha_monitor.errors import InputError
from eha_monitor.estimation.model_watch import MOVED
from eha_monitor.estimation.results import ModelStatus, ParameterEstimate
from eha_monitor.health.judge import Finding
from eha_monitor.live.diagnosing import COMPARING, Answer, Diagnosing, comparison_findings
from eha_monitor.recordings.ring import Saved
from eha_monitor.ros.keeper import Keeper
from eha_monitor.settings import Settings

BEGINS = "the model does not fit"
EVERY_S = 60.0  # at least: a leak, or what changes slowly, moves nothing
# What has moved may still move at the first rows: they say nothing of the state since, and a
# second look, at a change without a name, is without them.
MOVES_S = 6.0
LATEST_S = 60.0  # of rows at most, where other comparisons were waited for: of one state


class Comparison:
    """Compares the last rows with the machine, in another process, where something has moved.

    Something has moved where the model begins or ceases to fit, or B or beta_e, by least squares
    where it does not fit, differ surely and by more than ``MOVED`` from what they were at the
    comparison before; and every ``EVERY_S`` anyway. Whether that is a change is for the spread of
    the healthy recordings to say; a change without a name must also show in a recording twice as
    long.  Raises InputError if the file is none, or of a rig of other areas, mass or pump.

    Parameters
    ----------
    settings : ``diagnosis.machine`` is the file.
    keeper : saves the rows that are compared.
    tell : takes an event and its level.
    log_ns : gives the log time, ns, of a row's time, s.
    """

    def __init__(self, settings: Settings, keeper: Keeper, tell: Callable[[str, str], None],
                 log_ns: Callable[[float], int]):
        from eha_monitor.balances.machine import load

        self._file, self._settings = Path(settings.diagnosis.machine), settings
        self._keeper, self._tell, self._log_ns = keeper, tell, log_ns
        known = load(self._file, settings.rig)
        self.findings: list[Finding] = comparison_findings(None, "", len(known.sources))
        self._healthy = len(known.sources)
        self._running: Diagnosing | None = None
        self.saving = False  # its recording
        self._compared = (0.0, 0, "")  # as what was due
        self._begins = 0  # log time of the rows that are compared, ns
        self._changed: set[str] = set()
        self._beyond: set[str] = set()  # indicators beyond their limits
        self._unfit_ns = 0  # until when rows contradicted their config
        self.reset()

    @property
    def under_way(self) -> bool:
        """Whether it compares now."""
        return COMPARING.holder is self

    def reset(self) -> None:
        """Count time anew."""
        self._due: tuple[float, int, str] | None = None  # since when: s of the rows, ns of the log
        # since the model began or ceased to fit: the last answer, and "" or a verdict
        self.answer: Answer | None = None
        self.verdict = ""
        self._fits_now: bool | None = None
        self._fitted: bool | None = None  # when the rows that are compared were saved
        self._again = False
        self._last_s = -EVERY_S
        self._fits: bool | None = None
        self._values: dict[str, tuple[float, float]] = {}  # with their deviations

    def note(self, model: ModelStatus, parameters: Mapping[str, ParameterEstimate], now_s: float
             ) -> None:
        """Look whether something has moved since the comparison before."""
        if model.status not in ("consistent", "mismatch"):
            return
        fits = not model.mismatches
        if fits != self._fits_now:
            self._fits_now, self.answer, self.verdict = fits, None, ""
        if self._due is not None:
            return
        known = {
            name: (one.value, one.stddev) for name, one in model.best(parameters).items()
            if one.status == "converged" and not model.in_doubt(name)}
        moved = [name for name, now in known.items()
                 if name in self._values and _moved(self._values[name], now)]
        why = ("the monitor began" if self._fits is None
               else ("the model fits again" if fits else BEGINS) if fits != self._fits
               else f"{' and '.join(moved)} moved" if moved
               else "the last comparison was long ago" if now_s - self._last_s > EVERY_S else "")
        self._fits = fits
        if why:
            # A mismatch that stood at the comparison before is not when something moved.
            since_s = min((one.since_s for one in model.mismatches), default=now_s) if (
                why == BEGINS) else now_s
            self._due = since_s, self._log_ns(since_s), why
        self._values |= {name: value for name, value in known.items()
                         if why or name not in self._values}

    def leave_out(self, until_ns: int) -> None:
        """Compare none of the rows until a log time, ns."""
        self._unfit_ns = until_ns
        if not self.under_way:
            self._due = None

    def begin_if_due(self, now_s: float) -> None:
        """Save what came since something moved, once that is enough, and compare it.

        Not while another actuator's comparison is under way.
        """
        if COMPARING.holder is not None:
            return
        enough = self._settings.diagnosis.after * (2.0 if self._again else 1.0)
        if self._due is not None and now_s - self._due[0] >= enough:
            COMPARING.take(self)
            self.saving, self._last_s, self._compared = True, now_s, self._due
            self._fitted = self._fits_now
            latest = self._log_ns(now_s - max(LATEST_S, enough))
            begins = self._due[1] + (round(1e9 * MOVES_S) if self._again else 0)
            self._begins = max(begins, latest, self._unfit_ns)
            self._keeper.save_since(self._begins, self._saved)

    def _saved(self, bag: Saved) -> None:
        if not self.saving:
            return
        self.saving = False
        try:
            if bag.problem is not None:
                raise InputError(bag.problem)
            self._running = Diagnosing(
                [bag.path], self._settings, bag.path.with_name(f"{bag.path.name}_comparison"),
                ["--machine", str(self._file)])
        except (InputError, OSError) as problem:
            COMPARING.give_back(self)
            self._due = None
            self._tell(str(problem), "WARN")

    def poll(self) -> bool:
        """Take the result of a comparison; True where there is one."""
        answer = self._running.answer if self._running is not None else None
        if answer is None:
            return False
        self._running, (_, since_ns, why) = None, self._compared
        COMPARING.give_back(self)
        if answer.verdict == "unexplained" and not self._again:
            self._again = True  # a short recording may lack the motion of the healthy ones
            forget(answer)
            return False
        self._due, self._again = None, False
        if self._fitted == self._fits_now and answer.verdict != "insufficient_data":
            self.verdict, self.answer = answer.verdict, None if answer.problem else answer
        if answer.problem:
            if self.findings[0].level == "STALE":  # what was found before stands
                self.findings = comparison_findings(None, "", self._healthy, answer.problem)
            self._tell(answer.problem, "WARN")
            return True
        if answer.verdict == "insufficient_data":  # a pause: again with the rows that come
            self._last_s = -EVERY_S
            forget(answer)
            return False
        # What has changed within the rows has changed there, and not where they begin.
        points = [one["since_s"] for one in answer.tree["change_points"]]
        begins = _iso(self._begins)
        since = _iso(self._begins + 1e9 * max(points)) if points else _iso(since_ns)
        changed = {one["what"] for one in answer.tree["changes"]}
        if answer.verdict == "unexplained":
            changed = {"unexplained"}
        news, self._changed = changed != self._changed, changed
        kept = news and bool(changed)  # what says nothing new must not fill the disk
        self.findings = comparison_findings(answer, since, self._healthy, why, kept,
                                            begins if points else "")
        if news:
            self._tell(self.findings[0].message, self.findings[0].level)
        beyond = {one.name: one.message for one in self.findings if one.level == "ERROR"}
        for name, message in beyond.items():
            if name not in self._beyond:
                self._tell(f"{message}, in the rows since {since}", "ERROR")
        self._beyond = set(beyond)
        if not kept:
            forget(answer)
        return True

    def stop(self) -> None:
        """End what is under way."""
        if self._running is not None:
            self._running.end()
        COMPARING.give_back(self)
        self._running, self.saving, self._due, self._again = None, False, None, False


def _moved(before: tuple[float, float], now: tuple[float, float]) -> bool:
    """Tell whether a value (and its deviation) is surely another, and by more than ``MOVED``."""
    return abs(now[0] - before[0]) > max(
        MOVED * abs(before[0]), POLICY.varied * float(np.hypot(before[1], now[1])))


def _iso(stamp_ns: float) -> str:
    return datetime.fromtimestamp(1e-9 * stamp_ns, UTC).isoformat(timespec="seconds")


def forget(answer: Answer) -> None:
    """Remove the recordings and the report of an answer."""
    for folder in (*answer.bags, answer.folder):
        shutil.rmtree(folder, ignore_errors=True)
