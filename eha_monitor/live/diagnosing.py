"""A diagnosis in another process, what is said of it, and the model that a running monitor adopts.

Adopted without losing a row: the running estimator goes on until the other one, which has first
taken the rows of its buffer in small slices, has caught up.
"""

import json
import math
import os
import re
import signal
import subprocess
import sys
import threading
import time
import weakref
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from eha_monitor.errors import InputError
from eha_monitor.estimation.results import STAGES, LiveSnapshot
from eha_monitor.health.alarms import ADVICE, WATCHED
from eha_monitor.health.judge import DIAGNOSIS, INDICATOR, MACHINE, MODEL_IN_FORCE, Finding
from eha_monitor.live.estimator import LiveEstimator
from eha_monitor.live.ingest import Columns
from eha_monitor.output import environment, write_json
from eha_monitor.quantity import with_uncertainty
from eha_monitor.settings.load import annotated, load_settings, settings_from_tree
from eha_monitor.settings.monitor import Settings
from eha_monitor.words import listed

SCHEMA = "eha_monitor/adopted/1"
STAMPED = re.compile(r"_(\d{8}T\d{6})_\d+Z")  # names of bags that the monitor saves
MODEL = ("rig", "effects", "command_hold")  # sections and keys of the config that are the model


class Candidate:
    """An estimator that is to take the place of the running one.

    It knows no row yet; ``past`` are those to begin with, (times in s, columns), in order.
    """

    def __init__(self, estimator: LiveEstimator, past: Iterable[tuple[np.ndarray, Columns]]):
        self.estimator = estimator
        self._waiting = deque(past)
        self.first_s = self._waiting[0][0][0] if self._waiting else math.nan

    def push(self, times: np.ndarray, columns: Columns) -> None:
        """Take rows as :meth:`LiveEstimator.push_rows` does; they wait for their slice."""
        if not self._waiting and math.isnan(self.first_s) and len(times):
            self.first_s = float(times[0])
        self._waiting.append((times, columns))

    def advance(self, seconds: float) -> bool:
        """Work for at most about ``seconds``; True once all rows have been taken."""
        until = time.monotonic() + seconds
        while self._waiting and time.monotonic() < until:
            self.estimator.push_rows(*self._waiting.popleft())
        return not self._waiting

    def withdraw(self, channel: str, since_s: float) -> None:
        """Take back what a channel gave from ``since_s`` on, also in rows that wait."""
        for place, (times, columns) in enumerate(self._waiting):
            if channel in columns and len(times) and times[-1] >= since_s:
                kept = np.where(times < since_s, columns[channel], math.nan)
                self._waiting[place] = times, {**columns, channel: kept}
        if not math.isnan(self.first_s):
            self.estimator.withdraw(channel, since_s)

    def reset(self, reason: str) -> None:
        """Begin anew with the rows that come."""
        self._waiting.clear()
        self.first_s = math.nan
        self.estimator.reset(reason)


def model_of(settings: Settings) -> dict:
    """Return what of a config is the model, as JSON's plain types."""
    return settings.model_dump(mode="json", include=set(MODEL))


@dataclass(frozen=True)
class Adopted:
    """A model that was put in place of that of the config."""

    who: str  # ``service`` or ``automatic``
    time_utc: str  # when, ISO 8601
    words: str  # the effects, for people
    report: str  # where its diagnosis is described
    base: dict  # the model of the config then; for another one it is not valid
    model: dict  # as :func:`model_of`
    # relative standard deviations of ``B`` and ``beta_e`` in the diagnosis
    spread: dict = field(default_factory=dict)

    def applied(self, settings: Settings) -> Settings:
        """Return settings with this model in place of theirs."""
        made = settings_from_tree(self.model, "the adopted model")
        return settings.model_copy(update={key: getattr(made, key) for key in MODEL})

    def widened(self, snapshot: LiveSnapshot, settings: Settings) -> LiveSnapshot:
        """Return estimates that are no surer than the diagnosis was.

        A filter of the adopted model knows its noise alone, the diagnosis also what the form of
        a friction and the numbers of the rig leave open.
        """
        parameters = dict(snapshot.parameters)
        for stage in STAGES.values():
            one, spread = parameters[stage.parameter], self.spread.get(stage.parameter, 0.0)
            least = spread * abs(one.value)
            if one.status == "converged" and one.stddev < least:
                parameters[stage.parameter] = stage.judged(settings, one.value, least)
        return replace(snapshot, parameters=parameters)

    def save(self, path: Path) -> None:
        """Write it, for the next start; raises InputError if the place cannot be written."""
        write_json(path, {"schema": SCHEMA} | asdict(self))


def adopted_before(path: Path, settings: Settings) -> Adopted | None:
    """Return the model that an earlier run adopted for this config, None where none did.

    Raises InputError if the file is none, or its model was adopted for another config.
    """
    try:
        tree = json.loads(path.read_text(encoding="utf-8"))
        if tree.pop("schema", None) != SCHEMA:
            raise ValueError(f"expected schema {SCHEMA}")
        found = Adopted(**tree)
        found.applied(settings)
    except FileNotFoundError:
        return None
    except (OSError, ValueError, TypeError, AttributeError, InputError) as problem:
        raise InputError(f"{path}: expected an adopted model: {problem}") from problem
    if found.base != model_of(settings):
        raise InputError(f"{path}: adopted on {found.time_utc} for another rig or other effects "
                         "than the config now has: left out")
    return found


WALL = 10.0  # times its processor time: then it hangs
QUANTISATION = "position_quantisation"
_NO_MEMORY = ("MemoryError", "Memory allocation", "Cannot allocate memory")


class Turn:
    """Whose turn it is: one at a time in a process, for all its actuators.

    Whoever is collected without giving it back holds it no longer.
    """

    def __init__(self):
        self._holder: weakref.ref | None = None

    @property
    def holder(self) -> object | None:
        """Who has it, None where it is free."""
        return None if self._holder is None else self._holder()

    def take(self, whose: object) -> None:
        """Take it; to be asked for first."""
        self._holder = weakref.ref(whose)

    def give_back(self, whose: object) -> None:
        """Give it back, if it was taken."""
        if self.holder is whose:
            self._holder = None


# A comparison takes some seconds, a diagnosis minutes: the one does not wait for the other.
TURN, COMPARING = Turn(), Turn()


@dataclass(frozen=True)
class Answer:
    """What came of a diagnosis."""

    problem: str  # why there is no answer, as a sentence; "" where there is one
    folder: Path  # of the report, the JSON and the config; ``bags`` that were diagnosed
    bags: tuple[Path, ...]
    tree: dict = field(default_factory=dict)  # the JSON of ``diagnose``; empty without an answer
    completed: Settings | None = None  # the config with what was found, None where nothing was
    wall_s: float = math.nan  # duration, s

    @property
    def verdict(self) -> str:
        """The verdict, or ``failed``."""
        return self.tree.get("verdict", "failed")

    @property
    def words(self) -> str:
        """Verdict and message in one line."""
        return f"{self.verdict}: {self.message}"

    @property
    def message(self) -> str:
        """What it says in one line, and the numbers of the rig that it knows better."""
        return "; ".join([self.tree.get("message", ""), *(
            one["statement"] for one in self.tree.get("rig_within", []))])

    @property
    def until(self) -> str:
        """When the newest of its rows came, HH:MM:SS UTC by its bag's name; "" where not known."""
        found = [STAMPED.search(bag.name) for bag in self.bags]
        times = sorted(one.group(1) for one in found if one is not None)
        return f"{times[-1][9:11]}:{times[-1][11:13]}:{times[-1][13:15]} UTC" if times else ""

    @property
    def spread(self) -> dict[str, float]:
        """Relative standard deviations of ``B`` and ``beta_e`` with what was found."""
        after = (self.tree.get("parameters") or {}).get("after") or {}
        return {name: abs(one["stddev"] / one["value"]) for name, one in after.items()
                if name in ("B", "beta_e") and one.get("value") and one.get("stddev")}

    @property
    def probability(self) -> float:
        """Least probability of what is named, one less that of what has no name.

        A learned term has no name, so no probability either: NaN.
        """
        found = [one.get("probability") for one in self._named]
        if None in found or self.tree.get("learned"):
            return math.nan
        unnamed = (self.tree.get("probability") or {}).get("unexplained") or 0.0
        return min([*found, 1.0 - unnamed])

    @property
    def names(self) -> bool:
        """Whether it names why the model does not fit, or has learned it."""
        return bool(self._named or self.tree.get("learned"))

    @property
    def _named(self) -> list[dict]:
        """Effects and numbers of the rig; a resolution is read off the samples and no reason."""
        return [one for kind in ("effects", "rig_data") for one in self.tree.get(kind, [])
                if one.get("name") != QUANTISATION]


class Diagnosing:
    """One run of ``diagnose`` on bags of one machine in one state, the newest first.

    ``settings`` are what it diagnoses with, and ``settings.diagnosis`` is its budget.  Raises
    InputError if the folder cannot be written, OSError if no process can be started.
    """

    def __init__(self, bags: Sequence[Path], settings: Settings, folder: Path,
                 further: Sequence[str] = ()):
        self._budget, self._folder = settings.diagnosis, folder.absolute()
        self._model = model_of(settings)
        self._bags = tuple(bag.absolute() for bag in bags)
        config, self._log = self._folder / "config.yaml", self._folder / "diagnose.log"
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            config.write_text(annotated(settings, "The config of the monitor."), encoding="utf-8")
            log = self._log.open("wb")
        except OSError as problem:
            raise InputError(f"{folder}: cannot write: {problem.strerror}") from problem
        budget = (os.getpid(), self._budget.niceness, math.ceil(self._budget.processor_time),
                  round(1e9 * self._budget.memory_gigabytes))
        self._started = time.monotonic()
        with log:
            # By this thread: the process ends with the thread that began it.
            self._process = subprocess.Popen(
                [sys.executable, "-m", "eha_monitor.limited", *map(str, budget), "diagnose",
                 *map(str, self._bags), "--config", str(config),
                 "--json", str(self._folder / "diagnosis.json"),
                 "--report", str(self._folder / "report.html"),
                 "--write-config", str(self._folder / "completed.yaml"), *further],
                env=environment(), stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=log)
        self.answer: Answer | None = None  # once there is one
        # To read the answer takes a tenth of a second: rows must not wait for it.
        self._reader = threading.Thread(target=self._read, daemon=True, name="diagnosis")
        self._reader.start()

    @property
    def seconds(self) -> float:
        """For how long it has run."""
        return time.monotonic() - self._started

    def end(self) -> None:
        """End the process, if it still runs."""
        self._process.kill()
        self._reader.join()

    def _read(self) -> None:
        """Wait for the process and read what it wrote."""
        longest = WALL * self._budget.processor_time
        try:
            status = self._process.wait(longest)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
            self.answer = self._failed(f"had not ended after {longest:.0f} s")
            return
        if status:
            self.answer = self._failed(self._why(status))
            return
        try:
            tree = json.loads((self._folder / "diagnosis.json").read_text(encoding="utf-8"))
            completed = load_settings(self._folder / "completed.yaml")
            if model_of(completed) == self._model:
                completed = None
        except (OSError, ValueError, KeyError, InputError) as problem:
            self.answer = self._failed(f"left no answer: {problem}")
            return
        self.answer = Answer("", self._folder, self._bags, tree, completed, self.seconds)

    def _failed(self, why: str) -> Answer:
        return Answer(f"the diagnosis of {self._bags[0]} {why}", self._folder, self._bags,
                      wall_s=self.seconds)

    def _why(self, status: int) -> str:
        """Return why it ended without an answer, as the end of a sentence."""
        said = self._log.read_text(encoding="utf-8", errors="replace").strip()
        if status in (-signal.SIGXCPU, -signal.SIGKILL):
            return (f"used up its {self._budget.processor_time:g} s of processor time "
                    "(diagnosis.processor_time)" if status == -signal.SIGXCPU else "was killed")
        if any(word in said for word in _NO_MEMORY):
            return (f"ran out of its {self._budget.memory_gigabytes:g} GB of memory "
                    "(diagnosis.memory_gigabytes)")
        last = said.splitlines()[-1] if said else f"exit status {status}"
        return f"failed: {last.removeprefix('eha_monitor: ')}"


@dataclass(frozen=True)
class Cause:
    """What is known of why the model does not fit: a verdict, or "", and what to say of it."""

    verdict: str = ""
    words: str = ADVICE

    @classmethod
    def of(cls, kind: str, answer: Answer) -> "Cause":
        """Return what an answer says, its ``kind`` being that of what gave it."""
        rows = f" of the rows until {answer.until}" if answer.until else ""
        return cls(answer.verdict, f"{kind}{rows}: {answer.words}")


UNKNOWN = Cause()

EFFECT = "effect "
_LEVELS = {"consistent": "OK", "mismatch": "WARN", "unexplained": "WARN"}


def effects_in_words(answer: Answer) -> str:
    """Return what an answer puts into the model: names with their sizes, and what it cannot.

    Names are those of the catalogue, so that programs read them too.
    """
    tree, completed = answer.tree, answer.completed
    lacking = [] if completed is None else [
        one["name"] for one in tree.get("effects", []) if one["name"] not in completed.effects]
    words = listed([
        *(f"{one['name']} ({one['size']})" if one.get("size") else one["name"]
          for one in tree.get("effects", []) if one["name"] not in lacking),
        *(f"rig.{one['key']}" for one in tree.get("rig_data", [])),
        *(f"a learned term of the {one['balance']} balance" for one in tree.get("learned", []))
    ]) or "the numbers of the config as fitted"
    return words + (f" (without {listed(lacking)}, which no config holds)" if lacking else "")


def model_finding(adopted: Adopted | None) -> Finding:
    """Return which model is in force, who put it there and when."""
    if adopted is None:
        return Finding(MODEL_IN_FORCE, "OK", "the model of the config is in force", {"adopted": 0})
    return Finding(MODEL_IN_FORCE, "OK", f"the config's model with {adopted.words} is in force: "
                   f"adopted by {adopted.who} at {adopted.time_utc}", {
                       "adopted": 1, "who": adopted.who, "time_utc": adopted.time_utc,
                       "effects": ", ".join(adopted.model["effects"]), "report": adopted.report})


def answer_findings(answer: Answer | None) -> list[Finding]:
    """Return the verdict, each effect and each number of the rig, then B and beta_e."""
    if answer is None:
        return [Finding(DIAGNOSIS, "STALE", "nothing has been diagnosed yet")]
    tree = answer.tree
    where = tree["location"]
    found = [Finding(DIAGNOSIS, _LEVELS.get(answer.verdict, "STALE"), answer.message, {
        "verdict": answer.verdict,
        **{f"share_{name}": share for name, share in where["balance"].items()},
        "regime": where["regime"],
        **{f"probability_{name}": p for name, p in (tree.get("probability") or {}).items()
           if p is not None},
        "bag": ", ".join(map(str, answer.bags)), "report": str(answer.folder / "report.html"),
        "json": str(answer.folder / "diagnosis.json"),
        "config": str(answer.folder / "completed.yaml"), "wall_s": answer.wall_s})]
    for one in (*tree.get("effects", []), *tree.get("rig_data", []), *tree.get("rig_within", [])):
        values: dict[str, float | int | str] = {}
        if one.get("probability") is not None:
            values["probability"] = float(one["probability"])
        if one.get("size"):
            values["size"] = one["size"]
        for name, value in one.get("parameters", {}).items():
            values |= _number(name, value)
        if one.get("indistinguishable_from"):
            values["indistinguishable_from"] = ", ".join(one["indistinguishable_from"])
        name = f"{EFFECT}{one['name']}" if "name" in one else f"rig.{one['key']}"
        found.append(Finding(name, "WARN", one["statement"], values))
    for one in tree.get("learned", []):
        found.append(Finding(f"learned {one['balance']}", "WARN", one["statement"]))
    found += _parameters(tree)
    return found


def comparison_findings(answer: Answer | None, since: str, healthy: int, why: str = "",
                        kept: bool = False, begins: str = "") -> list[Finding]:
    """Return what has changed from the healthy recordings, and the indicators of health.

    Parameters
    ----------
    answer : of a comparison, None before the first.
    since : from when on the compared rows are, or the machine is as it is now, ISO 8601.
    healthy : number of healthy recordings.
    why : what moved then; without an answer, why there is none.
    kept : whether its recording and its report are.
    begins : when the rows begin, ISO 8601, where a change within them is dated.
    """
    if answer is None:
        return [Finding(MACHINE, "STALE", f"not yet compared with {healthy} healthy recordings"
                        + (f": {why}" if why else ""))]
    tree, values = answer.tree, {"since_utc": since, "why": why, "verdict": answer.verdict}
    if begins:
        values["begins_utc"] = begins
    if kept:
        values |= {"bag": str(answer.bags[0]), "report": str(answer.folder / "report.html")}
    if answer.verdict == "consistent":
        found = [Finding(MACHINE, "OK", tree["message"], values)]
    else:
        head = (f"changed at {since}, in the recording that begins at {begins}" if begins
                else f"the rows since {since} ({why}) show a change")
        found = [Finding(MACHINE, "WARN", f"{head}: {tree['message']}", values)]
    for one in tree["changes"]:
        before, now = one["reference"]["value"], one["now"]["value"]
        found.append(Finding(
            f"changed {one['what']} {one['parameter']}".strip(), "WARN",
            f"{one['statement']}, in the rows since {since}",
            _number("healthy", one["reference"]) | _number("now", one["now"])
            | {"unit": one["unit"], "since_utc": since}
            | ({"change_percent": 100.0 * (now / before - 1.0)} if before and now and abs(
                before) > 3.0 * (one["reference"]["stddev"] or 0.0) else {})))
    return found + [_indicator(one) for one in tree["indicators"]
                    if one.get("value") is not None and one.get("stddev") is not None]


def _indicator(one: dict) -> Finding:
    """Return an indicator of health; ERROR beyond its limit."""
    unit, limit, beyond = one["unit"], one.get("limit"), one.get("beyond_limit")
    words = f"{one['words']} {with_uncertainty(one['value'], one['stddev'], '')} {unit}"
    return Finding(f"{INDICATOR}{one['name']}", "ERROR" if beyond else "OK",
                   f"{words}, beyond its limit of {limit:g} {unit}" if beyond else words,
                   _number("value", one) | {"unit": unit} | (
                       {} if limit is None else {"limit": limit}))


def _parameters(tree: dict) -> Iterator[Finding]:
    """Yield what the effects did to B and beta_e: before and after, each with deviation."""
    for watched in WATCHED:
        before, after = (tree["parameters"][when].get(watched.symbol)
                         for when in ("before", "after"))
        values = _number("before", before) | _number("after", after)
        shown = [with_uncertainty(one["value"], one["stddev"], one["unit"])
                 for one in (before, after) if one and None not in one.values()]
        if len(shown) == 2:
            words = f"{watched.words} reads {shown[0]} without, {shown[1]} with what was found"
            yield Finding(watched.section, "OK", words, values)


def _number(name: str, value: dict | None) -> dict[str, float]:
    """Return a number and its deviation under a name, as far as they are known."""
    return {} if not value else {
        key: float(value[part]) for key, part in ((name, "value"), (f"{name}_stddev", "stddev"))
        if value.get(part) is not None}
