"""``estimate`` and ``diagnose`` on a folder of bags: one table, resumed, here or on a cluster."""

from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from eha_monitor.archive.find import Place, find_bags, is_archive, of_a_bag, stamp_of
from eha_monitor.commands.common import end_as_on_interrupt
from eha_monitor.errors import InputError

if TYPE_CHECKING:
    from eha_monitor.archive.run import Cluster
    from eha_monitor.archive.store import Store
    from eha_monitor.commands.archive_row import Task
    from eha_monitor.settings import Settings

OUT = Path("archive")


@dataclass(frozen=True)
class Archive:
    """What the command line says of a folder of bags; None where it says nothing."""

    out: Path | None = None
    jobs: int | None = None
    scheduler: str | None = None
    keep: str | None = None
    reports: bool | None = None

    def covers(self, bag: Path) -> bool:
        """Tell whether ``bag`` is a folder of bags; refuse these options for a single one."""
        given = [f"--{name}" for name in ("out", "jobs", "scheduler", "keep", "reports")
                 if getattr(self, name) is not None]
        if is_archive(bag, wanted=bool(given)):
            if self.jobs is not None and self.scheduler is not None:
                raise InputError("--jobs: with --scheduler the cluster sets how many bags are "
                                 "processed at a time, expected one of the two")
            return True
        if given and bag.exists():
            kind = "a folder without bags" if bag.is_dir() and not any(
                map(of_a_bag, bag.iterdir())) else "one bag"
            raise InputError(f"{bag}: {given[0]} is for a folder that holds bags, found {kind}")
        return False


def archive_options(function: Callable) -> Callable:
    """Add the options that only a folder of bags has use for."""
    for option in reversed((
            click.option("--out", type=click.Path(path_type=Path, file_okay=False),
                         metavar="DIR", help="For a folder of bags: folder of the table; "
                                 "default: archive/ in the current folder."),
            click.option("--jobs", type=click.IntRange(1, 1024), default=None,
                         help="For a folder of bags: number of processes; default: all cores."),
            click.option("--scheduler", metavar="ADDRESS", help="For a folder of bags: process "
                         "them on the Dask cluster with this scheduler, e.g. tcp://host:8786."),
            click.option("--reports", is_flag=True, default=None,
                         help="For a folder of bags: also write the report of each bag, linked "
                              "from its row."),
            click.option("--keep", type=click.Choice(("same", "all", "none")), default=None,
                         help="For a folder of bags: which rows of unchanged bags are kept: "
                              "those made with this config and program source (same, the "
                              "default), all, or none."))):
        function = option(function)
    return function


def refuse(bag: Path, **options: object) -> None:
    """Refuse options that make sense for a single bag only."""
    for name, value in options.items():
        if value:
            raise InputError(f"{bag}: is a folder that holds bags; --{name.replace('_', '-')} is "
                             "for a single bag, and the table goes to --out")


def answer_folder(command: str, folder: Path, config: Path | None, asked: Archive) -> bool:
    """Bring the table of a folder up to date; tell whether any bag is not well.

    Raises
    ------
    InputError
        If no bag of the folder could be answered, or the table cannot be written.
    """
    end_as_on_interrupt()
    from eha_monitor.archive.store import Store, check_parquet
    from eha_monitor.settings import load_settings

    check_parquet()
    settings = load_settings(config)
    made_with = digest_of(command, settings)
    with ExitStack() as open_ones:
        cluster = None if asked.scheduler is None else open_ones.enter_context(
            connected(asked.scheduler, command))
        store = open_ones.enter_context(Store(asked.out or OUT, command, folder))
        todo, failed = plan(store, find_bags(folder), command, settings, made_with,
                            asked.keep or "same", bool(asked.reports))
        for row in failed:
            store.add(row)
        try:
            if todo:
                work(store, todo, cluster, asked.jobs)
        finally:  # also on Ctrl-C: what is answered is in the table
            store.write()
            from eha_monitor.reports.archive_report import write_archive_report

            write_archive_report(store.page, list(store.rows.values()), command, settings,
                                 folder, made_with, store.reports())
    from eha_monitor.commands.archive_table import show, unhealthy

    rows = list(store.rows.values())
    show(rows, command, settings, made_with, folder, len(todo), [store.table, store.page])
    here = [row for row in rows if not row.get("gone")]
    broken = [row for row in here if row.get("error")]
    if len(broken) == len(here):
        raise InputError(f"{folder}: none of its {len(here)} bags has an answer; "
                         f"{broken[0]['bag']}: {broken[0]['error']}")
    return any(unhealthy(row) for row in here)


def digest_of(command: str, settings: "Settings") -> str:
    """Return a digest of everything beside the bag that has a part in a row."""
    import hashlib

    from eha_monitor.commands.archive_row import source_of

    parts = (command, settings.model_dump_json(), source_of(command))
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]


def plan(store: "Store", places: list[Place], command: str, settings: "Settings",
         made_with: str, keep: str, reports: bool = False) -> tuple[list["Task"], list[dict]]:
    """Return the bags that are to be answered, and rows of those that cannot even be looked at.

    A row stays where the bag's files have the same names, sizes and times, and config, options
    and source are the same.  A bag that was moved keeps its row.  Rows of bags that are no
    longer there stay, marked as gone: nobody could make them again.  With ``reports`` a row that
    has none is made again, and its report with it.
    """
    from eha_monitor.commands.archive_row import Task, error_row

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
                    store.report_of(place.name).absolute() if reports else None)
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


def connected(address: str, command: str) -> "Cluster":
    """Return a cluster whose workers have this source of the program."""
    from functools import partial

    from eha_monitor.archive.run import Cluster
    from eha_monitor.commands.archive_row import source_of

    cluster = Cluster(address)
    try:
        cluster.check(partial(source_of, command), source_of(command), "source of eha_monitor")
    except BaseException:
        cluster.close()
        raise
    return cluster


def work(store: "Store", todo: list["Task"], cluster: "Cluster | None", jobs: int | None) -> None:
    """Answer what is to be answered; every row is kept as soon as it is there."""
    import os
    from dataclasses import replace

    from eha_monitor.archive.run import on_this_machine
    from eha_monitor.commands.archive_row import error_row, row_of
    from eha_monitor.commands.diagnose import progress_bar

    if cluster is not None:
        # The workers have the same files, and another working directory.
        answers = cluster.answers(row_of, [
            replace(task, path=Path(os.path.abspath(task.path))) for task in todo])
    else:
        from eha_monitor.compiled import FIRST_RUN

        answers = on_this_machine(row_of, todo, jobs or len(os.sched_getaffinity(0)),
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
