"""One bag to one row of an archive's table; runs in a process of the pool or of a cluster.

Every column comes from the JSON tree of the single-bag command, so that a row says what that says.
"""

import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from eha_monitor.api.answer import answer, finite, judged
from eha_monitor.archive.columns import INDICATORS, PARAMETERS
from eha_monitor.archive.store import iso_time
from eha_monitor.errors import InputError
from eha_monitor.health.alarms import SEVERITY, Alarm
from eha_monitor.indicators.indicator import Indicator
from eha_monitor.source import source_digest

if TYPE_CHECKING:
    from eha_monitor.filters.results import Estimate
    from eha_monitor.mismatch.diagnosis import Diagnosis
    from eha_monitor.recordings.recording import Recording
    from eha_monitor.settings import Settings

# What has a part in an answer, and in the row that is made of it.
_ROOMS = {
    "estimate": ("physics", "filters", "recordings", "settings", "health", "plausibility",
                 "indicators", "api/answer.py", "api/plausible.py", "api/estimate.py",
                 "commands/archive_row.py", "quantity.py"),
    "diagnose": ("physics", "filters", "recordings", "settings", "health", "mismatch",
                 "plausibility", "indicators", "api/answer.py", "api/plausible.py",
                 "api/estimate.py", "api/diagnosis_answer.py", "commands/archive_row.py",
                 "quantity.py", "words.py"),
}
_EFFECT = ("name", "balance", "size", "statement", "probability", "log_evidence",
           "intervals_s", "indistinguishable_from")
_RIG = ("key", "configured", "probability", "statement", "indistinguishable_from")
_ONE = threading.Lock()  # a worker of a cluster may have threads, and the filters use all cores


@dataclass(frozen=True)
class Task:
    """What a process needs to make a row: name in the table, path, and how to answer.

    ``report`` is the page of this bag, to be written beside the row; None for none.
    """

    name: str
    path: Path
    command: str
    settings: "Settings"
    stamp: str
    made_with: str
    report: Path | None = None


def source_of(command: str) -> str:
    """Return a digest of the source that has a part in the rows of a command."""
    return source_digest(_ROOMS[command])


def row_of(task: Task) -> dict:
    """Return the row of a bag; where there is no answer, the reason is in ``error``."""
    started = time.perf_counter()
    row: dict = {"bag": task.name, "stamp": task.stamp, "made_with": task.made_with}
    with _ONE:
        try:
            _fill(row, task)
        except InputError as problem:
            row["error"] = " ".join(str(problem).split())
        except Exception as problem:  # noqa: BLE001  a defect must not cost the other bags
            row["error"] = f"defect of eha_monitor: {_where(problem)}"
    row["wall_s"] = time.perf_counter() - started
    row["answered"] = iso_time(time.time_ns())
    return finite(row)


def error_row(task: Task, error: str) -> dict:
    """Return the row of a bag that nobody could answer."""
    return {"bag": task.name, "stamp": task.stamp, "made_with": task.made_with, "error": error,
            "answered": iso_time(time.time_ns())}


def _fill(row: dict, task: Task) -> None:
    from eha_monitor.api.estimate import refuse_short
    from eha_monitor.api.plausible import checked
    from eha_monitor.compiled import load_runtime
    from eha_monitor.filters.pipeline import estimate
    from eha_monitor.indicators.assemble import of_diagnosis, of_estimate
    from eha_monitor.recordings.read import read_recording

    load_runtime()
    recording = read_recording(task.path, task.settings)
    checked([recording], task.settings)
    refuse_short(recording)
    if recording.dated:
        row["start"] = iso_time(recording.start_ns)
    found = estimate(recording, task.settings)
    alarms, history = judged(found)
    row.update(estimate_columns(answer(found, alarms, history)), **_at_reference(found))
    if task.command == "diagnose":
        from eha_monitor.api.diagnosis_answer import answer as diagnosis_answer
        from eha_monitor.mismatch.diagnose import diagnose
        from eha_monitor.quantity import in_units, rig_motion

        with rig_motion(task.settings.rig.motion):
            diagnosis = in_units(diagnose([recording], task.settings))
        row.update(diagnosis_columns(diagnosis_answer(diagnosis)))
        indicators = of_diagnosis(diagnosis, [recording], task.settings)
    else:
        indicators = of_estimate(found)
    row.update(indicator_columns(indicators))
    if task.report is not None:
        task.report.parent.mkdir(parents=True, exist_ok=True)
        if task.command == "diagnose":
            _diagnosis_report(task, recording, diagnosis, indicators)
        else:
            from eha_monitor.filters.observability import observability
            from eha_monitor.reports.estimate_report import write_estimate_report

            write_estimate_report(task.report, found, alarms, history, observability(found),
                                  indicators)


def _diagnosis_report(task: Task, recording: "Recording", diagnosis: "Diagnosis",
                      indicators: tuple[Indicator, ...]) -> None:
    """Write the page that ``diagnose`` writes of this bag alone."""
    from eha_monitor.reports.diagnosis_report import write_diagnosis_report

    losses = [f"{recording.source}: {loss}" for loss in recording.losses]
    write_diagnosis_report(task.report, diagnosis, task.settings,
                           losses + [finding.finding for finding in diagnosis.channels],
                           indicators=indicators)


def indicator_columns(indicators: tuple[Indicator, ...]) -> dict:
    """Return the columns of the indicators of health."""
    told = {one.name: one for one in indicators}
    row: dict = {}
    for column, name in INDICATORS.items():
        one = told[name]
        row |= {column: one.value, f"{column}_stddev": one.stddev, f"{column}_noise": one.noise,
                f"{column}_status": "in_doubt" if one.doubtful else one.status}
    return row


def estimate_columns(tree: dict) -> dict:
    """Return the columns that the answer of ``estimate`` holds."""
    row: dict = {"duration_s": tree["duration_s"], "samples": tree["samples"]}
    for name in PARAMETERS:
        one = tree["parameters"][name]
        taint = tree["model"]["tainted"].get(name)
        row |= {name: one["value"], f"{name}_stddev": one["stddev"], f"{name}_unit": one["unit"],
                f"{name}_status": one["status"], f"{name}_doubt": taint and taint["reason"]}
    words = [Alarm(**alarm).word for alarm in tree["alarms"]]
    row |= {alarm["name"]: word for alarm, word in zip(tree["alarms"], words, strict=True)}
    if words:
        worst = max(range(len(words)), key=lambda i: SEVERITY.index(words[i]))
        row |= {"alarm": words[worst], "alarm_message": None if words[worst] == "OK" else (
            tree["alarms"][worst]["message"])}
    balances = dict.fromkeys(one["balance"] for one in tree["model"]["mismatches"])
    return row | {"model": tree["model"]["status"], "model_message": tree["model"]["message"],
                  "model_balance": "; ".join(balances) or None,
                  "losses": "; ".join(tree["losses"]) or None}


def _at_reference(found: "Estimate") -> dict:
    """Return the temperature, and B carried to the reference one as the alarms do it."""
    import numpy as np

    from eha_monitor.health.alarms import viscosity_factor

    warmth = found.recording.get("temperature")
    warmth, damping = warmth[np.isfinite(warmth)], found.parameters["B"]
    if not len(warmth):
        return {}
    row = {"temperature_C": float(warmth[-1])}
    if np.isfinite(damping.value):
        factor = viscosity_factor(found.settings.viscosity, row["temperature_C"])
        row["B_reference"] = float(factor * damping.value)
        row["B_reference_stddev"] = float(factor * damping.stddev)
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
    place = problem.__traceback__
    while place is not None and place.tb_next is not None:
        place = place.tb_next
    at = "" if place is None else (
        f" at {Path(place.tb_frame.f_code.co_filename).name}:{place.tb_lineno}")
    return " ".join(f"{type(problem).__name__}: {problem}{at}".split())[:300]
