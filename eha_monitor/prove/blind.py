"""Runs a command that can see what it was handed of a trial, and nothing else of it.

    python -m eha_monitor.prove.blind TRIAL ALLOWED... -- diagnose BAG ...

An audit hook, which Python cannot take off again, refuses to open or list anything below TRIAL
but the ALLOWED files and folders, to load the generator of the cases, and to start a process that
the hook does not reach.
"""

import os
import runpy
import sys
from collections.abc import Callable, Sequence

GENERATOR = "eha_monitor.concealed"
_PLACES = ("open", "os.listdir", "os.scandir", "os.chdir")
_PROCESSES = ("subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "os.fork",
              "os.forkpty")


def guard(trial: str, allowed: Sequence[str]) -> Callable[[str, tuple], None]:
    """Return the audit hook.

    ``trial`` : folder of the trial.
    ``allowed`` : files and folders in it that may be used; a file also by the name of its
        temporary copy, ``.NAME.*``, under which it is written.
    """
    fence = os.path.realpath(trial)
    free = [os.path.realpath(path) for path in allowed]

    def let_through(path: str) -> bool:
        folder, name = os.path.split(path)
        for one in free:
            beside, own = os.path.split(one)
            if path == one or path.startswith(one + os.sep) or (
                    folder == beside and name.startswith(f".{own}.")):
                return True
        return False

    def hook(event: str, arguments: tuple) -> None:
        if event == "import":
            name = arguments[0]
            if name == GENERATOR or name.startswith(GENERATOR + "."):
                raise PermissionError(f"{name}: a diagnosis of the trial must not know it")
        elif event in _PLACES:
            place = arguments[0]
            if not isinstance(place, str | bytes | os.PathLike):
                return  # a descriptor: it was opened before, and judged then
            path = os.path.realpath(os.fsdecode(place))
            inside = path == fence or path.startswith(fence + os.sep)
            if inside and not let_through(path):
                raise PermissionError(f"{path}: a diagnosis of the trial must not see it")
        elif event in _PROCESSES:
            raise PermissionError(f"{event}: a diagnosis of the trial must not start a process")

    return hook


def main(arguments: list[str]) -> None:
    """Set the guard and run ``python -m eha_monitor`` with what follows ``--``."""
    end = arguments.index("--")
    trial, *allowed = arguments[:end]
    if known := [name for name in sys.modules if f"{name}.".startswith(f"{GENERATOR}.")]:
        raise PermissionError(f"{known[0]}: a diagnosis of the trial must not know it")
    sys.addaudithook(guard(trial, allowed))
    sys.argv = ["eha_monitor", *arguments[end + 1:]]
    runpy.run_module("eha_monitor", run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main(sys.argv[1:])
