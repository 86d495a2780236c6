"""The command line: the group, and what becomes of every kind of failure.

Exit status: 0 done; 1 the answer is "unhealthy" or "mismatch", only with ``--exit-code``; 2 bad
usage or bad input, told in one line; 70 a defect of this program, with its traceback; 130
interrupted; 141 the reader of a pipe has gone.
"""

import io
import os
import sys
import traceback

import click

from eha_monitor import __version__
from eha_monitor.commands.answers import advise, diagnose, estimate
from eha_monitor.commands.experiments import identify, prove
from eha_monitor.commands.files import config, export, import_table, simulate
from eha_monitor.commands.init import init
from eha_monitor.commands.live import dashboard, monitor, record, replay, simulator
from eha_monitor.commands.thresholds import thresholds
from eha_monitor.errors import InputError, refused

# Those that know what to do with ROS arguments.
_NODES = ("simulator", "monitor", "dashboard", "replay", "record", "identify")
BAD_INPUT, DEFECT, INTERRUPTED, BROKEN_PIPE = 2, 70, 130, 141


class _InOrder(click.Group):
    """A group that lists its commands in the order in which they were added."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self.commands)


@click.group(cls=_InOrder, context_settings={
    "help_option_names": ["-h", "--help"], "max_content_width": 99})
@click.version_option(__version__, message="%(version)s")
@click.pass_context
def cli(context: click.Context) -> None:
    """Condition monitor for electrohydraulic actuators.

    Estimates viscous damping B and effective bulk modulus from live ROS 2 topics or from a
    recorded bag, and raises health alarms.
    """
    ros_args = context.ensure_object(list)
    if ros_args and context.invoked_subcommand not in _NODES:
        raise click.UsageError(f"{context.invoked_subcommand} is no ROS node: "
                               "expected no --ros-args")


for _command in (init, simulator, monitor, dashboard, replay, record, simulate, estimate, diagnose,
                 advise, identify, prove, import_table, thresholds, export, config):
    cli.add_command(_command)


def main(arguments: list[str] | None = None) -> int:
    """Run one command and return its exit status; ``sys.argv`` is read by default."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    # What is ours, and what is ROS's: everything from --ros-args on.
    place = arguments.index("--ros-args") if "--ros-args" in arguments else len(arguments)
    own, ros_args = arguments[:place], arguments[place:]
    for stream in (sys.stdout, sys.stderr):
        # Names of files may hold bytes that are no text, and not every terminal has a ±.
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    try:
        # Not cli.main(), which gives interruptions and broken pipes meanings of its own.
        with cli.make_context("eha_monitor", own, obj=ros_args) as context:
            status = cli.invoke(context)
        sys.stdout.flush()
        return status if isinstance(status, int) else 0
    except click.exceptions.Exit as done:  # --help and --version
        return done.exit_code
    except click.exceptions.NoArgsIsHelpError as problem:
        click.echo(problem.ctx.get_help(), err=True)
        return BAD_INPUT
    except click.ClickException as problem:
        return _complain(_usage(problem))
    except InputError as problem:
        return _complain(str(problem))
    except BrokenPipeError:
        # The interpreter flushes stdout at exit; let it flush into nothing.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return BROKEN_PIPE
    except OSError as problem:
        return _complain(refused(problem))
    except (KeyboardInterrupt, click.Abort):
        return INTERRUPTED
    except Exception:  # noqa: BLE001  shown in full, with a status that no answer has
        traceback.print_exc()
        return DEFECT


def _usage(problem: click.ClickException) -> str:
    context = getattr(problem, "ctx", None)
    command = f"{context.info_name}: " if context and context.parent else ""
    return f"{command}{problem.format_message()}"


def _complain(message: str) -> int:
    print(f"eha_monitor: {' '.join(message.split())}", file=sys.stderr)
    return BAD_INPUT
