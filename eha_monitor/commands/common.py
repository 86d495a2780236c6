"""What the commands share: options, progress, output files."""

import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import click

from eha_monitor.errors import InputError

config_option = click.option(
    "--config", "config", type=click.Path(path_type=Path), metavar="FILE",
    help="Config (YAML); without it the paper's EHA.")


class Several(click.Command):
    """A command with options that take all words up to the next option: ``--reference A B C``."""

    several: tuple[str, ...] = ("--reference", "--without")

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

    try:
        return importlib.import_module(f"eha_monitor.ros.{name}")
    except ImportError as problem:
        if (problem.name or "").startswith("eha_monitor"):
            raise  # a defect of ours is no missing ROS
        raise InputError(f"this command needs ROS 2, and rclpy cannot be imported ({problem}); "
                         "install eha_monitor[ros] or source a ROS 2 set-up") from problem


def on_terminal() -> bool:
    """Tell whether somebody watches; progress is shown there only."""
    return sys.stderr.isatty()


@contextmanager
def working(what: str) -> Iterator[Callable[[str], None]]:
    """Show on a terminal that something of unknown length is going on; yields ``told(what)``."""
    if not on_terminal():
        yield lambda what: None
        return
    from rich.console import Console
    from rich.markup import escape

    with Console(stderr=True).status(escape(what)) as status:
        yield lambda what: status.update(escape(what))


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
        for bag in bags:
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
