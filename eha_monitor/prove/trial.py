"""The concealed-effect trial: recordings made, key sealed, diagnosed by others, opened, scored.

The diagnosis of each case is a process of its own, the public ``diagnose`` command, under a guard
(:mod:`eha_monitor.prove.blind`) that lets it open its bag and its nominal config only.

A trial's folder::

    trial.json            seed, number of cases, digest of the draws, SHA-256 of the key
    key/made/c001.json    what was concealed in a case, and the digest of its recording
    key/key.json          all of these: the sealed key
    recordings/c001       bag; c001.yaml its nominal config
    answers/c001.json     what diagnose said; c001.run.json how it ran
    oracles/c001.json     what a fit reaches that knows the effects, not the true rig
    proof.json            the result
"""

import hashlib
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path

from eha_monitor.compiled import FIRST_RUN
from eha_monitor.concealed.cases import CONFIG_KEYS, TOLERANCES, Case, truth_of
from eha_monitor.concealed.draws import SETS, draw_cases, misconfigured
from eha_monitor.errors import InputError
from eha_monitor.output import PACKAGE, environment, source_digest, write_text
from eha_monitor.progress import Report, silent
from eha_monitor.prove import score
from eha_monitor.settings.monitor import Settings

LONGEST = 1800.0  # s that a diagnosis may take


@dataclass(frozen=True)
class Questions:
    """Questions of one kind."""

    module: str  # what is run, as by ``python -m``
    folder: Path  # of the answers, ``NAME.json``, and of how they ran, ``NAME.run.json``
    source: str  # digest of what has a part in the answers
    arguments: Callable[[str], list[str]]  # name of a question -> arguments of the module
    what: str  # the work in words


def children(questions: Questions, names: Sequence[str], jobs: int, say: Report) -> None:
    """Have each name answered by a process of its own, ``jobs`` at a time, each on its cores."""
    jobs = max(1, min(jobs, len(names)))
    cores = sorted(os.sched_getaffinity(0))
    shares = [cores[i::jobs] for i in range(jobs)]
    running: set[subprocess.Popen] = set()
    stop = threading.Event()

    def one(name: str) -> None:
        if stop.is_set():
            return
        share = shares.pop()
        target = questions.folder / f"{name}.json"
        target.unlink(missing_ok=True)
        started = time.perf_counter()
        os.sched_setaffinity(0, share)  # of this thread; its child inherits it
        process = begun(questions.module, questions.arguments(name))
        running.add(process)
        status, complaint = ended(process)
        running.discard(process)
        shares.append(share)
        if stop.is_set():
            return
        fine = status == 0 and read_json(target) is not None
        write_json(questions.folder / f"{name}.run.json", {
            "status": status, "seconds": time.perf_counter() - started, "source": questions.source,
            "cores": len(share),
            "error": "" if fine else (complaint.splitlines() or ["no answer"])[-1]})

    head = 1 if FIRST_RUN else 0  # it compiles; the others would all do so at the same time
    with ThreadPoolExecutor(jobs) as pool:
        try:
            done = 0
            for batch in (names[:head], names[head:]):
                for future in as_completed([pool.submit(one, name) for name in batch]):
                    future.result()
                    done += 1
                    say(f"{questions.what}, {done} of {len(names)}", done / len(names))
        except BaseException:
            stop.set()
            for process in list(running):
                process.terminate()
            raise


def begun(module: str, arguments: Sequence[str]) -> subprocess.Popen:
    """Start a module of this very source with arguments; what it complains of is kept."""
    return subprocess.Popen([sys.executable, "-m", module, *arguments], env=environment(),
                            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
                            stderr=subprocess.PIPE, text=True, errors="replace")


def ended(process: subprocess.Popen, seconds: float = LONGEST) -> tuple[int, str]:
    """Return a process' exit status, and what it complained of, once it has ended."""
    try:
        _, complaint = process.communicate(timeout=seconds)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        return process.returncode, f"took more than {seconds:.0f} s"
    return process.returncode, complaint.strip()


def kept(questions: Questions, name: str, keep: str) -> bool:
    """Tell whether an answer is there that may stay: of the ``same`` source, ``all``, ``none``."""
    run = read_json(questions.folder / f"{name}.run.json") or {}
    if keep == "none" or run.get("status") != 0 or (
            keep == "same" and run.get("source") != questions.source):
        return False
    return read_json(questions.folder / f"{name}.json") is not None


def digest_of(content: bytes) -> str:
    """Return the SHA-256 in hexadecimal."""
    return hashlib.sha256(content).hexdigest()


def read_json(path: Path) -> dict | None:
    """Return what a JSON file holds; None where there is none that can be read."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) else None


def write_json(path: Path, content: dict) -> None:
    """Write a JSON file whole."""
    write_text(path, json.dumps(content, indent=1, ensure_ascii=False) + "\n")


DRAWS = ("mixed", "outside")


def cases_of(draw: str, count: int, seed: int, rig: str = "mixed",
             settings: Settings | None = None, source: str = "") -> tuple[Case, ...]:
    """Return the cases of a trial; fewer of the same seed are a head of more.

    Parameters
    ----------
    draw : ``mixed`` (rigs, motions, sets of 0 to 3 effects, outside the catalogue) or
        ``outside`` (rigs and motions; what no catalogue has, alone).
    rig : what the nominal configs say of the rig, one of :data:`KINDS`.
    settings : config on whose rig all cases are, ``source`` its name; drawn rigs without it.
    """
    cases = tuple(draw_cases(count, seed, rig="exact", sets=(
        SETS if draw == "mixed" else {"outside": 1.0})))
    if settings is not None:
        cases = on_rig(cases, settings, source)
    return tuple(misconfigured(cases, seed, rig))


def on_rig(cases: tuple[Case, ...], settings: Settings, source: str) -> tuple[Case, ...]:
    """Return the cases on the rig of a config in place of the drawn ones, with its tolerances.

    Raises
    ------
    InputError
        If the generator cannot be that rig: it is a linear actuator with equal areas and volumes
        whose position loop is closed.
    """
    rig = settings.rig
    if rig.motion != "linear" or rig.area_1 != rig.area_2 or rig.volume_1 != rig.volume_2:
        raise InputError(f"{source}: expected a linear actuator with equal areas and volumes: no "
                         "other can be made for the trial")
    constants = {symbol: getattr(rig, keys[0]) for symbol, keys in CONFIG_KEYS.items()}
    for symbol, value in constants.items():
        if value is None:
            raise InputError(f"{source}: rig.{CONFIG_KEYS[symbol][0]}: expected a value, the "
                             "trial simulates the rig")
    spreads = {symbol: rig.tolerance.log_spread(CONFIG_KEYS[symbol][0]) for symbol in TOLERANCES}
    own = {symbol: spread for symbol, spread in spreads.items() if spread != TOLERANCES[symbol]}
    return tuple(replace(case, rig={symbol: float(value) for symbol, value in constants.items()},
                         nominal={"B": float(rig.viscous_damping),
                                  "beta_e": float(rig.bulk_modulus)},
                         tolerances=own) for case in cases)


SCHEMA = "eha_monitor/proof/1"
# What has a part in an answer.
ROOMS = ("physics", "estimation", "balances", "mismatch", "recordings", "settings", "plausibility",
         "api", "commands/answers.py", "prove/blind.py", "words.py")
FEW = 4  # cases that are made without processes of their own


@dataclass(frozen=True)
class Question:
    """One process that answers, with what it is handed."""

    name: str  # of the answer
    bags: tuple[str, ...]  # names of the recordings; the config is that of the first
    command: str = "diagnose"  # or ``advise``
    held_out: str = ""  # name of a recording on which the fit is shown


@dataclass(frozen=True)
class Trial:
    """What is tried, and how."""

    cases: tuple[Case, ...]  # what is concealed
    seed: int  # of the draws
    work: Path  # folder of the trial
    # Also fit each case with a model that knows the effects, not the true rig.
    oracle: bool = False
    jobs: int = 0  # processes at a time; each gets its share of the cores
    # Answers of an earlier run that stay: of the ``same`` source, ``all``, ``none``.
    keep: str = "same"
    questions: tuple[Question, ...] = ()  # without them one diagnosis of each recording by itself
    # Writes the recording of a case into a folder and returns what is true of it.
    conceal: Callable[[Case, Path], dict] | None = None
    # Given the opened key, returns it with what lies elsewhere and was sealed by digest.
    complete: Callable[[dict], dict] | None = None

    def all_questions(self) -> tuple[Question, ...]:
        """Return the questions, one for each recording unless given."""
        return self.questions or tuple(Question(case.name, (case.name,)) for case in self.cases)


def prove(trial: Trial, announce: Callable[[str], None] = print,
          progress: Report | None = None) -> dict:
    """Run a trial, or what is left of it, and return its result.

    Parameters
    ----------
    announce : called with the key's SHA-256 before any recording is read.
    progress : called with what is done and how far it is, 0 to 1.

    Raises
    ------
    InputError
        If the folder holds another trial, or its key is not the one that was sealed.
    """
    say = progress or silent
    started = time.perf_counter()
    begin(trial)
    made(trial, lambda text, share: say(text, 0.1 * share))
    sealed = seal(trial)
    announce(f"sealed key: SHA-256 {sealed}")
    end = 0.75 if trial.oracle else 1.0
    answer(trial, lambda text, share: say(text, 0.1 + (end - 0.1) * share))
    key = opened(trial, sealed)
    if trial.oracle:
        ask_oracle(trial, lambda text, share: say(text, end + (1.0 - end) * share))
    found = result(trial, trial.complete(key) if trial.complete else key, sealed)
    found["wall_s"] = time.perf_counter() - started
    write_json(trial.work / "proof.json", found)
    return found


def begin(trial: Trial) -> None:
    """Make the trial's folder, or check that it is this trial's."""
    for name in ("", "key/made", "recordings", "answers", "oracles"):
        (trial.work / name).mkdir(parents=True, exist_ok=True)
    wanted = {"schema": "eha_monitor/trial/1", "seed": trial.seed, "cases": len(trial.cases),
              "draws": digest_of(repr(trial.cases).encode() + b"".join(
                  path.read_bytes() for path in sorted((PACKAGE / "concealed").rglob("*.py"))))}
    path = trial.work / "trial.json"
    if not path.exists():
        write_json(path, wanted)
        return
    there = read_json(path) or {}
    for name, words in (("seed", "seed"), ("cases", "number of cases"),
                        ("draws", "generator of cases")):
        if there.get(name) != wanted[name]:
            raise InputError(f"{path}: belongs to a trial with another {words} "
                             f"({there.get(name)}), expected {wanted[name]}; name another "
                             "folder for this one")


def made(trial: Trial, say: Report) -> None:
    """Write the recordings that are not there yet."""
    todo = [case for case in trial.cases
            if read_json(trial.work / "key" / "made" / f"{case.name}.json") is None]
    jobs = min(jobs_of(trial), len(todo))
    if len(todo) <= FEW or jobs < 2:
        for i, case in enumerate(todo):
            say(f"concealing, {i} of {len(todo)}", i / len(todo))
            make(case, trial.work, trial.conceal)
        return
    with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
        futures = [pool.submit(make, case, trial.work, trial.conceal) for case in todo]
        for i, future in enumerate(as_completed(futures)):
            future.result()
            say(f"concealing, {i + 1} of {len(todo)}", (i + 1) / len(todo))


def make(case: Case, work: Path, conceal: Callable[[Case, Path], dict] | None = None) -> None:
    """Write one recording with its nominal config, then what is true of it."""
    folder = work / "recordings"
    truth = (conceal or concealed)(case, folder)
    bag, config = folder / case.name, folder / f"{case.name}.yaml"
    digests = {path.name: digest_of(path.read_bytes())
               for path in sorted([*bag.iterdir(), config])}
    write_json(work / "key" / "made" / f"{case.name}.json",
               {**truth, "case": case.name, "recording_sha256": digests})


def concealed(case: Case, folder: Path) -> dict:
    """Write a recording of the independent plant; returns its entry in the key."""
    from eha_monitor.concealed.generate import write_case
    write_case(case, folder)
    return {**truth_of(case), "motion": case.motion, "noise": case.noise,
            "channels": list(case.channels), "rig": case.rig, "nominal": case.nominal,
            "seed": case.seed}


def seal(trial: Trial) -> str:
    """Put the key together and return its SHA-256; an older one must be the same."""
    path, about = trial.work / "key" / "key.json", trial.work / "trial.json"
    there = read_json(about) or {}
    if "sealed_key_sha256" not in there:
        cases = [read_json(trial.work / "key" / "made" / f"{case.name}.json")
                 for case in trial.cases]
        write_json(path, {"schema": "eha_monitor/key/1", "seed": trial.seed, "cases": cases})
        there["sealed_key_sha256"] = digest_of(path.read_bytes())
        write_json(about, there)
    opened(trial, there["sealed_key_sha256"])
    return there["sealed_key_sha256"]


def opened(trial: Trial, sealed: str) -> dict:
    """Return the key, if it is still the one that was sealed."""
    path = trial.work / "key" / "key.json"
    try:
        content = path.read_bytes()
    except OSError as problem:
        raise InputError(f"{path}: cannot read the key: {problem.strerror}") from problem
    if digest_of(content) != sealed:
        raise InputError(f"{path}: is not the key that was sealed: expected SHA-256 {sealed}, "
                         f"got {digest_of(content)}")
    return json.loads(content)


def answer(trial: Trial, say: Report, what: str = "diagnosing") -> None:
    """Have every question answered by a process that sees its bags and nominal config only."""
    questions = {question.name: question for question in trial.all_questions()}

    def arguments(name: str) -> list[str]:
        question = questions[name]
        config, answer = places(trial, question.bags[0], "")[1], places(trial, name, "answers")[2]
        bags = [places(trial, bag, "")[0] for bag in question.bags]
        unseen = [places(trial, bag, "")[0] for bag in (question.held_out,) if bag]
        words = [question.command, *bags, "--config", config, "--json", answer,
                 *(["--held-out", *unseen] if unseen else [])]
        return [*map(str, (trial.work, *bags, *unseen, config, answer, "--", *words))]

    ask(trial, tuple(questions), Questions("eha_monitor.prove.blind", trial.work / "answers",
                                           source_digest(ROOMS), arguments, what), say)


def ask_oracle(trial: Trial, say: Report) -> None:
    """Have every case fitted by a process that knows its effects."""
    def arguments(name: str) -> list[str]:
        bag, config, answer = places(trial, name, "oracles")
        return [*map(str, (trial.work / "key" / "key.json", name, bag, config, answer))]

    source = source_digest(ROOMS) + digest_of((PACKAGE / "prove" / "oracle.py").read_bytes())
    names = tuple(case.name for case in trial.cases)
    ask(trial, names, Questions("eha_monitor.prove.oracle", trial.work / "oracles",
                            digest_of(source.encode())[:16], arguments, "asking the oracle"), say)


def ask(trial: Trial, names: Sequence[str], questions: Questions, say: Report) -> None:
    """Have all of these answered that have no answer which may stay."""
    children(questions, [name for name in names if not kept(questions, name, trial.keep)],
             jobs_of(trial), say)


def places(trial: Trial, name: str, folder: str) -> tuple[Path, Path, Path]:
    """Return a case's bag, config and answer."""
    recordings = trial.work / "recordings"
    return recordings / name, recordings / f"{name}.yaml", trial.work / folder / f"{name}.json"


def result(trial: Trial, key: dict, sealed: str) -> dict:
    """Score the answers against the opened key; the contract's keys, then what extends it."""
    rows, sources = [], {}
    truths = {truth["case"]: truth for truth in key["cases"]}
    for question in trial.all_questions():
        if question.command != "diagnose":
            continue
        name, truth = question.name, truths[question.bags[0]]
        run = read_json(trial.work / "answers" / f"{name}.run.json") or {}
        sources[run.get("source", "")] = sources.get(run.get("source", ""), 0) + 1
        oracle = read_json(trial.work / "oracles" / f"{name}.json") if trial.oracle else None
        rows.append(score.row_of({**truth, "case": name},
                                 read_json(trial.work / "answers" / f"{name}.json"), oracle, run))
    return {
        "schema": SCHEMA, "sealed_key_sha256": sealed, "cases": len(rows),
        "score": score.score_of(rows), "by_effect": score.by_effect(rows), "rows": rows,
        "by_strength": score.by_group(
            [row for row in rows if row["kind"] == "single"],
            lambda row: score.bin_of(next(iter(row["strength"].values())))),
        "by_kind": score.by_group(rows, lambda row: row["kind"]),
        "by_rig": score.by_group(rows, lambda row: row["rig"]),
        "by_motion": score.by_group(rows, lambda row: row["motion"]),
        "by_noise": score.by_group(rows, lambda row: f"{row['noise']:g}"),
        "by_channels": score.by_group(rows, lambda row: ", ".join(row["channels"])),
        "reliability": score.reliability(rows),
        "confusion": score.confusion(rows),
        "failed": sum(row["verdict"] == score.FAILED for row in rows),
        "oracle": trial.oracle, "seed": trial.seed, "commit": commit(),
        "sources": sources,
    }


def jobs_of(trial: Trial) -> int:
    """Return how many processes run at a time: as many as there are cores, unless given."""
    return trial.jobs or len(os.sched_getaffinity(0))


def commit() -> str | None:
    """Return the commit of a checkout, with ``+`` where it was changed; None without one."""
    def git(*words: str) -> str | None:
        try:
            done = subprocess.run(["git", "-C", str(PACKAGE), *words], capture_output=True,
                                  text=True, timeout=20, check=True)
        except (OSError, subprocess.SubprocessError):
            return None
        return done.stdout.strip()

    head = git("rev-parse", "--short=12", "HEAD")
    return f"{head}+" if head and git("status", "--porcelain", "--", ".") else head


def misses(found: dict) -> Sequence[dict]:
    """Return the rows of a result that are neither exact nor in the declared class."""
    return [row for row in found["rows"] if not row["within_class"]]
