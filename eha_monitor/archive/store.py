"""The table of an archive on disk: Parquet, and beside it a journal while work goes on.

    OUT/estimate.parquet     the table
    OUT/estimate.html        the page (made by the command)
    OUT/estimate_reports/    the report of each bag, if they are asked for
    OUT/.estimate.journal    rows that are not in the table yet, one JSON text a line
    OUT/.estimate.lock       held by the run that writes

A row reaches the journal when it is answered, so that no end of the program costs it.
docs/archive.md is held to the columns.
"""

import fcntl
import io
import json
import os
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from urllib.parse import quote

from eha_monitor.errors import InputError, optional
from eha_monitor.indicators.indicator import WORDS
from eha_monitor.output import write_bytes

SCHEMA = "eha_monitor/archive/1"
PARAMETERS = ("B", "beta_e")
# Column -> indicator of the health (:mod:`eha_monitor.indicators`), whose unit it ends with.
INDICATORS = {"leakage_mL_min": "leakage", "free_air_percent": "free_air",
              "friction_N": "friction", "pump_efficiency_percent": "pump_efficiency",
              "drive_lag_ms": "drive_lag"}


@dataclass(frozen=True)
class Column:
    """One column; ``kind``: text, number, count, flag, time, effects or rig.

    ``only`` names the command whose table has it; both have it where it is empty.
    """

    name: str
    kind: str
    words: str
    only: str = ""


def _of_parameter(name: str) -> tuple[Column, ...]:
    return (
        Column(name, "number", f"{name}, SI, as `estimate` reports it"),
        Column(f"{name}_stddev", "number", "its standard deviation"),
        Column(f"{name}_unit", "text", "unit of both"),
        Column(f"{name}_status", "text", "converged, not_excited, diverged or no_data"),
        Column(f"{name}_doubt", "text", "why a model mismatch biases it; empty if none does"),
    )


def _of_diagnosis(name: str) -> tuple[Column, ...]:
    return tuple(
        Column(f"{name}_{when}{end}", "number", words, "diagnose")
        for when, said in (("before", f"{name} without the named effects, SI"),
                           ("after", f"{name} with the named effects, SI"))
        for end, words in (("", said), ("_stddev", "its standard deviation")))


def _of_indicator(name: str, indicator: str) -> tuple[Column, ...]:
    return (
        Column(name, "number", f"{WORDS[indicator]} at the conditions of the config's `health`; "
               "also where a single recording is too uncertain to report it"),
        Column(f"{name}_stddev", "number", "its standard deviation"),
        Column(f"{name}_noise", "number", "the part of it that differs from one recording to "
               "the next"),
        Column(f"{name}_status", "text", "available, in_doubt, none_named, cannot_be_told or "
               "needs_config"),
    )


COLUMNS = (
    Column("bag", "text", "path of the bag below the folder"),
    Column("start", "time", "first sample by the stamps of the messages, UTC; empty where "
           "they are no dates"),
    Column("duration_s", "number", "length of the recording"),
    Column("samples", "count", "samples on the grid"),
    *_of_parameter("B"),
    *_of_parameter("beta_e"),
    Column("temperature_C", "number", "oil at the end of the recording, where it is measured"),
    Column("B_reference", "number", "B at `viscosity.reference_temperature`, where the "
           "temperature is measured"),
    Column("B_reference_stddev", "number", "its standard deviation"),
    *(column for name, indicator in INDICATORS.items()
      for column in _of_indicator(name, indicator)),
    Column("alarm", "text", "worst level of the four alarms at the end of the recording, and "
           "of the limits of the indicators: OK, STALE, not judged, WARN, ERROR"),
    Column("viscous_damping_high", "text", "level of this alarm"),
    Column("viscous_damping_low", "text", "level of this alarm"),
    Column("bulk_modulus_high", "text", "level of this alarm"),
    Column("bulk_modulus_low", "text", "level of this alarm"),
    Column("alarm_message", "text", "message of the worst alarm"),
    Column("model", "text", "consistent, mismatch or not_judged"),
    Column("model_balance", "text", "what the mismatch points to"),
    Column("model_message", "text", "the same in a sentence"),
    Column("verdict", "text", "verdict of `diagnose`", "diagnose"),
    Column("verdict_message", "text", "the same in a sentence", "diagnose"),
    *(Column(f"balance_{name}", "number", f"share of the {name} in the disagreement",
             "diagnose") for name in ("force", "flow", "drive", "sensor")),
    Column("regime", "text", "in which regime they disagree", "diagnose"),
    *(Column(f"probability_{name}", "number", f"probability that {words}, 0 to 1", "diagnose")
      for name, words in (("consistent", "nothing is missing"),
                          ("unexplained", "an unidentified effect is missing"))),
    Column("rig_data", "rig", "numbers of the rig that the recording contradicts: key, "
           "configured, value, stddev, unit, probability, statement, indistinguishable_from",
           "diagnose"),
    Column("effects", "effects", "what was left out: name, balance, size, statement, "
           "probability, log_evidence, intervals_s, indistinguishable_from, parameters (name, "
           "value, stddev, unit)", "diagnose"),
    *_of_diagnosis("B"),
    *_of_diagnosis("beta_e"),
    Column("losses", "text", "what was lost or repaired in reading"),
    Column("error", "text", "why processing failed; empty where it did not"),
    Column("wall_s", "number", "processing time"),
    Column("answered", "time", "time of processing, UTC"),
    Column("gone", "flag", "the bag is no longer in the folder"),
    Column("stamp", "text", "digest of names, sizes and times of the bag's files"),
    Column("made_with", "text", "digest of config, options and source of the program"),
)


def misfits(row: dict) -> bool:
    """Tell whether a model does not fit: of a diagnosis its verdict says it."""
    if row.get("verdict"):
        return row["verdict"] in ("mismatch", "unexplained")
    return row.get("model") == "mismatch"


def columns_of(command: str) -> tuple[Column, ...]:
    """Return the columns of the table of a command."""
    return tuple(column for column in COLUMNS if column.only in ("", command))


def check_parquet() -> None:
    """Say in one line, before the work, that the library for the table is missing."""
    with optional("a table of bags needs pyarrow, which cannot be imported ({}); ", "archive"):
        import pyarrow.parquet  # noqa: F401


class Store:
    """The rows of one table, by bag; a context that one process at a time may enter.

    Parameters
    ----------
    out : folder of the table, made when needed.
    command : ``estimate`` or ``diagnose``.
    folder : of the bags; a table belongs to one folder.
    """

    def __init__(self, out: Path, command: str, folder: Path):
        self.columns = columns_of(command)
        self.folder = str(folder.resolve())
        self.table, self.page = out / f"{command}.parquet", out / f"{command}.html"
        self.rows: dict[str, dict] = {}
        self._out, self._command = out, command
        self._journal_path = out / f".{command}.journal"
        self._lock = self._journal = None

    def __enter__(self) -> "Store":
        try:
            self._out.mkdir(parents=True, exist_ok=True)
            self._lock = (self._out / f".{self._command}.lock").open("w")
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self._read_table()
            self._read_journal()
            new = not self._journal_path.exists()
            self._journal = self._journal_path.open("a", encoding="utf-8")
            if new:
                self._line({"folder": self.folder})
        except BaseException as problem:
            self._close()
            if isinstance(problem, BlockingIOError):
                raise InputError(f"{self.table}: another run is writing it; wait for its end, or "
                                 "name another folder with --out") from problem
            if isinstance(problem, OSError):
                raise InputError(f"{self._out}: cannot write: {problem.strerror}") from problem
            raise
        return self

    def __exit__(self, *exception) -> None:
        self._close()

    def add(self, row: dict) -> None:
        """Take a row in, at once on disk; it replaces that of the same bag."""
        self.rows[row["bag"]] = row
        self._line(row)

    def report_of(self, bag: str) -> Path:
        """Return where the report of a bag lies, if there is one; never outside the folder."""
        parts = [part if part not in ("", ".", "..") else "_" for part in bag.split("/")]
        return self._out.joinpath(f"{self._command}_reports", *parts[:-1], f"{parts[-1]}.html")

    def has_report(self, row: dict) -> bool:
        """Tell whether the report of a row is there and of the same answer."""
        try:
            written = self.report_of(row["bag"]).stat().st_mtime_ns
            begun = nanoseconds_of(row["answered"]) - 1e9 * (1.0 + (row.get("wall_s") or 0.0))
        except (OSError, ValueError, TypeError, KeyError):
            return False
        return written >= begun

    def reports(self) -> dict[str, str]:
        """Return bag -> address of its report, as the page writes it."""
        return {name: quote(str(self.report_of(name).relative_to(self._out)))
                for name, row in self.rows.items() if self.has_report(row)}

    def write(self) -> None:
        """Write the table whole; the journal has then done its work."""
        import pyarrow.parquet

        schema = _schema(self.columns, self.folder)
        rows = [{c.name: _typed(c, row.get(c.name)) for c in self.columns}
                for row in self.rows.values()]
        memory = io.BytesIO()
        pyarrow.parquet.write_table(pyarrow.Table.from_pylist(rows, schema), memory,
                                    compression="zstd")
        write_bytes(self.table, memory.getvalue())
        self._journal_path.unlink(missing_ok=True)

    def _line(self, content: dict) -> None:
        self._journal.write(json.dumps(content, allow_nan=False) + "\n")
        self._journal.flush()

    def _read_table(self) -> None:
        if self.table.exists():
            rows, folder = read_table(self.table)
            self._check(folder)
            self.rows = {row["bag"]: row for row in rows}

    def _read_journal(self) -> None:
        if not self._journal_path.exists():
            return
        text = self._journal_path.read_text(encoding="utf-8", errors="replace")
        for line in text.splitlines(keepends=True):
            try:
                content = json.loads(line)
            except ValueError:
                content = None
            if not isinstance(content, dict) or not line.endswith("\n"):
                continue  # the line in which the program was killed
            if "folder" in content:
                self._check(content["folder"])
            elif "bag" in content:
                self.rows[content["bag"]] = content
        if text and not text.endswith("\n"):
            with self._journal_path.open("a", encoding="utf-8") as file:
                file.write("\n")

    def _check(self, folder: str) -> None:
        if folder != self.folder:
            raise InputError(f"{self.table}: is the table of {folder}, expected another --out "
                             f"for {self.folder}")

    def _close(self) -> None:
        for file in (self._journal, self._lock):
            if file is not None:
                file.close()
        self._journal = self._lock = None


def read_table(path: Path) -> tuple[list[dict], str]:
    """Return the rows of a table, times as ISO text as in the journal, and its folder.

    Raises InputError if the file is no table of this form.
    """
    import pyarrow
    import pyarrow.parquet

    try:
        table = pyarrow.parquet.read_table(path)
        about = table.schema.metadata or {}
        if about.get(b"schema") != SCHEMA.encode():
            raise ValueError(f"its schema is {about.get(b'schema', b'another').decode()}")
        for place, one in enumerate(table.schema):
            if pyarrow.types.is_timestamp(one.type):
                # As numbers: Python's own times end at microseconds.
                table = table.set_column(place, one.name, table.column(place).cast("int64"))
        rows = table.to_pylist()
    except (pyarrow.ArrowException, ValueError, OSError) as problem:
        reason = " ".join(str(problem).split())[:150]
        raise InputError(f"{path}: expected a table of form {SCHEMA} ({reason}); delete it to "
                         "start again") from problem
    for row in rows:
        for name in ("start", "answered"):
            row[name] = None if row.get(name) is None else iso_time(row[name])
    return rows, about[b"folder"].decode()


def iso_time(nanoseconds: int) -> str | None:
    """Return ns since the epoch as ISO 8601 with nanoseconds, UTC; None beyond the calendar.

    >>> iso_time(1_700_000_000_000_000_005)
    '2023-11-14T22:13:20.000000005Z'
    """
    try:
        whole = datetime.fromtimestamp(nanoseconds // 10**9, tz=UTC)
    except (ValueError, OverflowError, OSError):
        return None
    return f"{whole:%Y-%m-%dT%H:%M:%S}.{nanoseconds % 10**9:09d}Z"


def nanoseconds_of(text: str) -> int:
    """Return what :func:`iso_time` was made from."""
    whole, part = text.removesuffix("Z").split(".")
    return int(datetime.fromisoformat(whole + "+00:00").timestamp()) * 10**9 + int(part)


def _schema(columns: Iterable[Column], folder: str):
    import pyarrow as pa

    value = pa.struct([("name", pa.string()), ("value", pa.float64()),
                       ("stddev", pa.float64()), ("unit", pa.string())])
    effect = pa.struct([("name", pa.string()), ("balance", pa.string()), ("size", pa.string()),
                        ("statement", pa.string()), ("probability", pa.float64()),
                        ("log_evidence", pa.float64()),
                        ("intervals_s", pa.list_(pa.list_(pa.float64()))),
                        ("indistinguishable_from", pa.list_(pa.string())),
                        ("parameters", pa.list_(value))])
    number = pa.struct([("key", pa.string()), ("configured", pa.float64()),
                        ("value", pa.float64()), ("stddev", pa.float64()), ("unit", pa.string()),
                        ("probability", pa.float64()), ("statement", pa.string()),
                        ("indistinguishable_from", pa.list_(pa.string()))])
    kinds = {"text": pa.string(), "number": pa.float64(), "count": pa.int64(),
             "flag": pa.bool_(), "time": pa.timestamp("ns", tz="UTC"),
             "effects": pa.list_(effect), "rig": pa.list_(number)}
    return pa.schema([pa.field(c.name, kinds[c.kind], metadata={"description": c.words})
                      for c in columns],
                     metadata={"schema": SCHEMA, "folder": os.fsencode(folder)})


def _typed(column: Column, value):
    """Return a value of the journal as Parquet takes it."""
    if column.kind == "time" and value is not None:
        return nanoseconds_of(value)
    if column.kind == "flag":
        return bool(value)
    return value
