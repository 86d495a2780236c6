"""``estimate`` and ``diagnose`` on a folder of bags: one table, resumed, here or on a cluster.

A row is made in a process of the pool or of a cluster; every column comes from the JSON tree of
the single-bag command, so that a row says what that says.
"""

import hashlib
import os
import time
import traceback
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from eha_monitor.api.config import Config
from eha_monitor.api.estimate import answer, estimate
from eha_monitor.archive import run
from eha_monitor.archive.find import Place, find_bags, stamp_of
from eha_monitor.archive.store import (
    INDICATORS,
    PARAMETERS,
    Store,
    check_parquet,
    iso_time,
    misfits,
)
from eha_monitor.commands.common import Archive, end_as_on_interrupt, progress_bar
from eha_monitor.errors import InputError
from eha_monitor.health.judge import NO_LIMIT, NOT_JUDGED, SEVERITY, Alarm
from eha_monitor.indicators.indicator import (
    AVAILABLE,
    Indicator,
    limits_of_indicator,
    passed,
)
from eha_monitor.output import PACKAGE, finite, source_digest, write_text
from eha_monitor.settings import Settings, load_settings

if TYPE_CHECKING:
    from eha_monitor.estimation.results import Estimate

OUT = Path("archive")
MOST = 20  # recordings shown; all are in the table
ALIKE = 4  # models that do not fit for one reason are one line
# What has no part in an answer, nor in the row that is made of it; all else in the package has.
_APART = ("commands", "concealed", "dashboard", "draft", "exports", "prove", "reports", "ros",
          "cli.py", "demo.py", "__main__.py")
_DIAGNOSIS = ("mismatch",)  # nor this in one of ``estimate``
_EFFECT = ("name", "balance", "size", "statement", "probability", "log_evidence",
           "intervals_s", "indistinguishable_from")
_RIG = ("key", "configured", "probability", "statement", "indistinguishable_from")


@dataclass(frozen=True)
class Task:
    """What a process needs to make a row: name in the table, path, and how to answer.

    ``report`` is the page of this bag, to be written beside the row; ``machine`` the file of the
    healthy machine that it is judged against; None for none.
    """

    name: str
    path: Path
    command: str
    settings: Settings
    stamp: str
    made_with: str
    report: Path | None = None
    machine: Path | None = None


def answer_folder(command: str, folder: Path, config: Path | None, options: Archive,
                  machine: Path | None = None) -> bool:
    """Bring the table of a folder up to date; tell whether any bag is not well.

    With ``machine``, a file, ``diagnose`` judges each bag against it.  Raises InputError if no bag
    of the folder could be answered, the table cannot be written, or there is no such machine.
    """
    end_as_on_interrupt()
    check_parquet()
    settings = load_settings(config)
    if machine is not None:
        from eha_monitor.balances.machine import load

        load(machine, settings.rig)
        machine = machine.absolute()
    made_with = digest_of(command, settings, machine)
    with ExitStack() as open_ones:
        cluster = None if options.scheduler is None else open_ones.enter_context(
            connected(options.scheduler, command))
        store = open_ones.enter_context(Store(options.out or OUT, command, folder))
        todo, failed = plan(store, find_bags(folder), command, settings, made_with,
                            options.keep or "same", bool(options.reports), machine)
        for row in failed:
            store.add(row)
        try:
            if todo:
                work(store, todo, cluster, options.jobs)
        finally:  # also on Ctrl-C: what is answered is in the table
            store.write()
            from eha_monitor.reports.archive_report import archive_page

            write_text(store.page, archive_page(list(store.rows.values()), command, settings,
                                                folder, made_with, store.reports(), machine))
    rows = list(store.rows.values())
    show(rows, command, settings, made_with, folder, len(todo), [store.table, store.page])
    here = [row for row in rows if not row.get("gone")]
    broken = [row for row in here if row.get("error")]
    if len(broken) == len(here):
        raise InputError(f"{folder}: none of its {len(here)} bags has an answer; "
                         f"{broken[0]['bag']}: {broken[0]['error']}")
    return any(unhealthy(row) for row in here)


def digest_of(command: str, settings: Settings, machine: Path | None = None) -> str:
    """Return a digest of everything beside the bag that has a part in a row."""
    parts = (command, settings.model_dump_json(), source_of(command),
             *([] if machine is None else [machine.read_text(encoding="utf-8")]))
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]


def plan(store: Store, places: list[Place], command: str, settings: Settings,
         made_with: str, keep: str, reports: bool = False, machine: Path | None = None
         ) -> tuple[list[Task], list[dict]]:
    """Return the bags that are to be answered, and rows of those that cannot even be looked at.

    A row stays where the bag's files have the same names, sizes and times, and config, options
    and source are the same.  A bag that was moved keeps its row.  Rows of bags that are no
    longer there stay, marked as gone: nobody could make them again.  With ``reports`` a row that
    has none is made again, and its report with it.
    """
    by_stamp = {row["stamp"]: row for row in sorted(
        store.rows.values(), key=lambda row: row["made_with"] == made_with)}
    names, stamps = {place.name for place in places}, set()
    todo, failed = [], []
    for place in places:
        problem = place.problem
        try:
            stamp = stamp_of(place.path) if not problem else ""
        except OSError as reason:
            stamp, problem = "", f"{place.path}: cannot read bag: {reason.strerror}"
        task = Task(place.name, place.path, command, settings, stamp, made_with,
                    store.report_of(place.name).absolute() if reports else None, machine)
        if problem:
            failed.append(error_row(task, problem))
            continue
        stamps.add(stamp)
        row = store.rows.get(place.name)
        if row is None or row["stamp"] != stamp:
            row = by_stamp.get(stamp)
        lacks = reports and row is not None and not row.get("error") and not store.has_report(row)
        if row is None or lacks or keep == "none" or (
                keep == "same" and row["made_with"] != made_with):
            todo.append(task)
        elif row["bag"] != place.name or row.get("gone"):
            store.add(row | {"bag": place.name, "gone": False})
    for name, row in list(store.rows.items()):
        if name not in names:
            if row["stamp"] in stamps:  # it was moved, and has its row under the new name
                del store.rows[name]
            else:
                store.rows[name] = row | {"gone": True}
    return todo, failed


def connected(address: str, command: str) -> run.Cluster:
    """Return a cluster whose workers have this source of the program."""
    cluster = run.Cluster(address)
    try:
        cluster.check(partial(source_of, command), source_of(command), "source of eha_monitor")
    except BaseException:
        cluster.close()
        raise
    return cluster


def work(store: Store, todo: list[Task], cluster: run.Cluster | None, jobs: int | None) -> None:
    """Answer what is to be answered; every row is kept as soon as it is there."""
    if cluster is not None:
        # The workers have the same files, and another working directory.
        answers = cluster.answers(row_of, [
            replace(task, path=Path(os.path.abspath(task.path))) for task in todo])
    else:
        from eha_monitor.compiled import FIRST_RUN

        answers = run.on_this_machine(row_of, todo, jobs or len(os.sched_getaffinity(0)),
                                  alone=int(FIRST_RUN))
    broken = 0
    with progress_bar() as told, closing(answers):
        told(f"0 of {len(todo)} bags", 0.0)
        for done, (task, row, error) in enumerate(answers, 1):
            row = error_row(task, f"{task.path}: {error}") if error else row
            store.add(row)
            broken += bool(row.get("error"))
            told(f"{done} of {len(todo)} bags" + (
                f", {broken} failed" if broken else ""), done / len(todo))


def source_of(command: str) -> str:
    """Return a digest of the source that has a part in the rows of a command."""
    apart = _APART + _DIAGNOSIS * (command == "estimate")
    return source_digest(("",), lambda path: path == Path(__file__) or path.relative_to(
        PACKAGE).parts[0] not in apart)


def row_of(task: Task) -> dict:
    """Return the row of a bag; where there is no answer, the reason is in ``error``."""
    started = time.perf_counter()
    row: dict = {}
    try:
        _fill(row, task)
    except InputError as problem:
        row["error"] = " ".join(str(problem).split())
    except Exception as problem:  # noqa: BLE001  a defect must not cost the other bags
        row["error"] = f"defect of eha_monitor: {_where(problem)}"
    return finite(_begun(task) | row | {"wall_s": time.perf_counter() - started})


def error_row(task: Task, error: str) -> dict:
    """Return the row of a bag that nobody could answer."""
    return _begun(task) | {"error": error}


def _begun(task: Task) -> dict:
    return {"bag": task.name, "stamp": task.stamp, "made_with": task.made_with,
            "answered": iso_time(time.time_ns())}


def _fill(row: dict, task: Task) -> None:
    config = Config.of(task.settings)
    found = last = estimate(task.path, config)
    if found.recording.dated:
        row["start"] = iso_time(found.recording.start_ns)
    row.update(estimate_columns(answer(found, found.alarms, found.alarm_history)),
               **_at_reference(found))
    if task.command == "diagnose":
        from eha_monitor.api.diagnose import diagnose

        last = diagnose(found.recording, config, machine=task.machine)
        row.update(diagnosis_columns(last.to_dict()))
    row.update(indicator_columns(last.indicators))
    judged = limit_columns(last.indicators, task.settings)
    if SEVERITY.index(judged.get("alarm", "OK")) >= SEVERITY.index(row.get("alarm", "OK")):
        row.update(judged)
    if task.report is not None:
        task.report.parent.mkdir(parents=True, exist_ok=True)
        last.report(task.report)


def indicator_columns(indicators: tuple[Indicator, ...]) -> dict:
    """Return the columns of the indicators of health."""
    told = {one.name: one for one in indicators}
    row: dict = {}
    for column, name in INDICATORS.items():
        one = told[name]
        row |= {column: one.value, f"{column}_stddev": one.stddev, f"{column}_noise": one.noise,
                f"{column}_status": "in_doubt" if one.doubtful else one.status}
    return row


def limit_columns(indicators: tuple[Indicator, ...], settings: Settings) -> dict:
    """Return the columns of the alarm that indicators with a limit are; none without one."""
    judged = [one for one in indicators if one.status == AVAILABLE and not one.doubtful
              and limits_of_indicator(one.name, settings) != (None, None)]
    beyond = [f"{one.words} of {one.shown} is beyond its limit" for one in judged
              if passed(one, settings)]
    return {} if not judged else {
        "alarm": "ERROR" if beyond else "OK", "alarm_message": "; ".join(beyond) or None}


def estimate_columns(tree: dict) -> dict:
    """Return the columns that the answer of ``estimate`` holds."""
    row: dict = {"duration_s": tree["duration_s"], "samples": tree["samples"]}
    for name in PARAMETERS:
        one = tree["parameters"][name]
        taint = tree["model"]["tainted"].get(name)
        if taint and taint["instead"]:
            one, taint = taint["instead"], None
        row |= {name: one["value"], f"{name}_stddev": one["stddev"], f"{name}_unit": one["unit"],
                f"{name}_status": one["status"], f"{name}_doubt": taint and taint["reason"]}
    alarms = [Alarm(**alarm) for alarm in tree["alarms"] if alarm["message"] != NO_LIMIT]
    row |= {alarm.name: alarm.word for alarm in alarms}
    if alarms:
        worst = max(alarms, key=lambda alarm: SEVERITY.index(alarm.word))
        row |= {"alarm": worst.word,
                "alarm_message": None if worst.word == "OK" else worst.message}
    balances = dict.fromkeys(one["balance"] for one in tree["model"]["mismatches"])
    return row | {"model": tree["model"]["status"], "model_message": tree["model"]["message"],
                  "model_balance": "; ".join(balances) or None,
                  "losses": "; ".join(tree["losses"]) or None}


def _at_reference(found: "Estimate") -> dict:
    """Return the temperature, and B carried to the reference one as the alarms do it."""
    import numpy as np

    from eha_monitor.indicators.laws import at_reference

    warmth = found.recording.get("temperature")
    warmth, damping = warmth[np.isfinite(warmth)], found.parameters["B"]
    if not len(warmth):
        return {}
    row = {"temperature_C": float(warmth[-1])}
    if np.isfinite(damping.value):
        row["B_reference"], row["B_reference_stddev"] = map(float, at_reference(
            found.settings.viscosity, row["temperature_C"], damping.value, damping.stddev))
    return row


def diagnosis_columns(tree: dict) -> dict:
    """Return the columns that the answer of ``diagnose`` holds."""
    row = {"verdict": tree["verdict"], "verdict_message": tree["message"],
           "regime": tree["location"]["regime"],
           "rig_data": [{key: one[key] for key in _RIG} | one["found"]
                        for one in tree["rig_data"]],
           "effects": [{key: one[key] for key in _EFFECT}
                       | {"parameters": [{"name": name} | value
                                         for name, value in one["parameters"].items()]}
                       for one in tree["effects"]]}
    row |= {f"probability_{name}": value for name, value in tree["probability"].items()}
    row |= {f"balance_{name}": share for name, share in tree["location"]["balance"].items()}
    for when in ("before", "after"):
        for name in PARAMETERS:
            value = tree["parameters"][when].get(name) or {"value": None, "stddev": None}
            row |= {f"{name}_{when}": value["value"], f"{name}_{when}_stddev": value["stddev"]}
    return row


def _where(problem: Exception) -> str:
    """Return a defect in one line: what, and at which line of which file."""
    at = "".join(f" at {Path(place.filename).name}:{place.lineno}"
                 for place in traceback.extract_tb(problem.__traceback__)[-1:])
    return " ".join(f"{type(problem).__name__}: {problem}{at}".split())[:300]


def unhealthy(row: dict) -> bool:
    """Tell whether a row has an alarm, or a model that does not fit; a broken bag has neither."""
    return row.get("alarm") in ("WARN", "ERROR") or misfits(row)


def show(rows: Sequence[dict], command: str, settings: Settings, made_with: str, folder: Path,
         answered: int, written: list[Path]) -> None:
    """Print what was done, which recordings need a look, and the trends."""
    from rich.markup import escape

    from eha_monitor.commands.table import coloured, console, print_end, table
    from eha_monitor.quantity import NOTE
    from eha_monitor.reports import archive_report as report

    to = console()
    gone = sum(bool(row.get("gone")) for row in rows)
    to.print(f"{escape(str(folder))}: {len(rows) - gone} bags, {answered} processed now, "
                  f"{len(rows) - gone - answered} unchanged"
                  + (f"; {gone} more no longer in the folder" if gone else ""))
    to.print(escape(report.summary_words(rows, command)))
    newest = sorted(rows, key=lambda row: (bool(row.get("error")), row.get("start") or "",
                                           row["bag"]), reverse=True)
    alike = Counter(_why(row) for row in newest if _only_misfits(row))
    if looked := [row for row in newest if row.get("error") or (
            unhealthy(row) and alike[_why(row)] < ALIKE)]:
        shown = table("recording", "start", "alarm", "why")
        for row in looked[:MOST]:
            shown.add_row(escape(row["bag"]), (row.get("start") or "–")[:16].replace("T", " "),
                          coloured(row.get("alarm") or ""), escape(_why(row)))
        to.print(shown)
        if len(looked) > MOST:
            to.print(f"and {len(looked) - MOST} more")
    for why, count in alike.items():
        if count >= ALIKE:
            to.print(escape(f"{count} recordings: {why}"))
    for one in report.histories_of(rows, command, made_with, settings):
        to.print(escape(" ".join(filter(None, (report.trend_words(one),
                                               report.outlook_words(one))))))
    print_end(to, NOTE, written)


def _why(row: dict) -> str:
    """Return what is wrong with a recording, the worst first."""
    from eha_monitor.reports.archive_report import phrases

    alarmed = row.get("alarm") in ("WARN", "ERROR", NOT_JUDGED)
    misfit = f"the model does not fit: {row.get('model_balance')}"
    said = [row["alarm_message"]] if alarmed and row.get("alarm_message") else []
    return row.get("error") or "; ".join([*said, *phrases(row)]) or (
        row.get("verdict_message") or (misfit if row.get("model_balance") else "")
        or row.get("model_message") or "")


def _only_misfits(row: dict) -> bool:
    """Tell whether a row is looked at for a model only that does not fit, without an alarm."""
    return not row.get("error") and not row.get("verdict") and misfits(row) and (
        row.get("alarm") not in ("WARN", "ERROR"))
