"""What the commands share: options, progress, output files."""

import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from eha_monitor.archive.find import is_archive, of_a_bag
from eha_monitor.errors import InputError, optional
from eha_monitor.progress import Report, silent

if TYPE_CHECKING:
    from eha_monitor.api.config import Config

FILE = click.Path(path_type=Path)  # or folder
SECONDS = click.FloatRange(min=0, min_open=True)

config_option = click.option("--config", type=FILE, metavar="FILE",
                             help="Config (YAML); without it the paper's EHA.")
json_option = click.option("--json", "json_file", type=FILE, metavar="FILE",
                           help="Write the result as JSON.")
report_option = click.option("--report", "report_file", type=FILE, metavar="FILE.html",
                             help="Write a self-contained HTML report.")
overwrite_option = click.option("--overwrite", is_flag=True, help="Replace an existing bag.")
bags_argument = click.argument("bags", type=FILE, nargs=-1, required=True, metavar="BAG [BAG ...]")


def write_config_option(words: str) -> Callable:
    """Return ``--write-config`` with its help."""
    return click.option("--write-config", "config_file", type=FILE, metavar="FILE", help=words)


class Several(click.Command):
    """A command with options that take all words up to the next option: ``--reference A B C``."""

    several = ("--reference", "--without", "--from")

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Give each further word the option's name again, as click takes them."""
        found, option = [], ""
        for word in args:
            if word in self.several:
                option = word
            elif word.startswith("-"):
                option = ""
            elif option and found[-1] != option:
                found.append(option)
            found.append(word)
        return super().parse_args(ctx, found)


def ros_module(name: str):
    """Import a module of ``eha_monitor.ros``, or say in one line that ROS is missing."""
    import importlib

    with optional("this command needs ROS 2, and rclpy cannot be imported ({}); source a ROS 2 "
                  "set-up, or ", "ros"):
        return importlib.import_module(f"eha_monitor.ros.{name}")


@contextmanager
def working(what: str) -> Iterator[Callable[[str], None]]:
    """Show on a terminal that something of unknown length is going on; yields ``told(what)``."""
    if not sys.stderr.isatty():
        yield lambda what: None
        return
    from rich.console import Console
    from rich.markup import escape

    with Console(stderr=True).status(escape(what)) as status:
        yield lambda what: status.update(escape(what))


@contextmanager
def progress_bar() -> Iterator[Report]:
    """Yield ``told(text, share)``, which moves a bar on a terminal and does nothing elsewhere."""
    if not sys.stderr.isatty():
        yield silent
        return
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    with Progress(TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(),
                  console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("", total=1.0)
        reached = 0.0

        def told(text: str, share: float) -> None:
            nonlocal reached
            reached = min(max(reached, share), 1.0)  # a bar that goes back says nothing
            progress.update(task, description=escape(text), completed=reached)

        yield told


def end_as_on_interrupt() -> None:
    """Let SIGTERM end a run as Ctrl-C does: it must take its processes with it."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)


def check_target(path: Path | None, bag: Path | None = None) -> None:
    """Refuse, before the work, an output that could not be written or lies in the bag."""
    if path is None:
        return
    if path.is_dir():
        raise InputError(f"{path}: expected a file to write, found a folder")
    if not path.parent.is_dir():
        raise InputError(f"{path}: the folder {path.parent} does not exist")
    if bag is not None and bag.resolve() in (path.resolve(), path.resolve().parent) and (
            bag.resolve() == path.resolve() or path.suffix in (".mcap", ".yaml")):
        raise InputError(f"{path}: is part of the bag {bag} that is read, expected another file")


def check_outputs(targets: dict[str, Path | None], bags: tuple[Path, ...],
                  config: Path | None) -> None:
    """Refuse, before the work, outputs that cannot be written or would overwrite an input.

    ``targets`` : option (``--json``) -> file, None where it is not given.
    """
    taken: dict[Path, str] = {}
    for option, target in targets.items():
        if target is None:
            continue
        for bag in bags or (None,):
            check_target(target, bag)
        place = target.resolve()
        if config is not None and place == config.resolve():
            raise InputError(f"{target}: is the config that is read, expected another file for "
                             f"{option}")
        regular = not target.exists() or target.is_file()
        if regular and place in taken:
            raise InputError(f"{target}: {taken[place]} and {option} name the same file")
        taken[place] = option


def check_new(bag: Path, overwrite: bool) -> None:
    """Refuse, before the work, a bag that is there already, or anything that is no bag."""
    from eha_monitor.recordings.write import check_bag_target

    check_bag_target(bag, overwrite)


@contextmanager
def refusing(config: "Config", source: Path | None, json_file: Path | None,
             config_file: Path | None, tree: Callable[[InputError], dict]) -> Iterator[None]:
    """Write what was requested where a recording contradicts its config, and say where it is.

    ``source`` is the file of the config; ``tree`` returns the JSON of a refusal.
    """
    from eha_monitor.api.read import ImplausibleError, corrected_config
    from eha_monitor.output import write_json, write_text

    try:
        yield
    except ImplausibleError as problem:
        told = problem
        if config_file is not None and problem.corrected is not None:
            write_text(config_file, corrected_config(problem.channels, config.settings, source))
            told = problem.instead(f"the corrected config is in {config_file}")
        if json_file:
            write_json(json_file, tree(told))
        raise told from None


# ---- a folder of bags ---------------------------------------------------------------------------

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
