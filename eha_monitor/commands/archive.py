"""The options of ``estimate`` and ``diagnose`` on a folder of bags.

What they do is in :mod:`eha_monitor.commands.archive_rows`, which takes longer to import.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import click

from eha_monitor.archive.find import is_archive, of_a_bag
from eha_monitor.errors import InputError


@dataclass(frozen=True)
class Archive:
    """What the command line says of a folder of bags; None where it says nothing."""

    out: Path | None = None
    jobs: int | None = None
    scheduler: str | None = None
    keep: str | None = None
    reports: bool | None = None

    def covers(self, bag: Path, **single: object) -> bool:
        """Tell whether ``bag`` is a folder of bags; refuse these options for a single one.

        ``single`` : options that make sense for a single bag only, refused for a folder.
        """
        given = [f"--{name}" for name in ("out", "jobs", "scheduler", "keep", "reports")
                 if getattr(self, name) is not None]
        if is_archive(bag, wanted=bool(given)):
            if self.jobs is not None and self.scheduler is not None:
                raise InputError("--jobs: with --scheduler the cluster sets how many bags are "
                                 "processed at a time, expected one of the two")
            for name, value in single.items():
                if value:
                    raise InputError(f"{bag}: is a folder that holds bags; "
                                     f"--{name.replace('_', '-')} is for a single bag, and the "
                                     "table goes to --out")
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
