"""The catalogue: every :class:`Effect` that a module of this folder has, in the order of names."""

import importlib
import pkgutil

from eha_monitor.physics.effect import Effect


def _load() -> dict[str, Effect]:
    modules = (importlib.import_module(f"{__name__}.{info.name}")
               for info in pkgutil.iter_modules(__path__))
    found = {entry.name: entry for module in modules for entry in vars(module).values()
             if isinstance(entry, Effect)}
    return dict(sorted(found.items()))  # the order of their places in theta


CATALOGUE: dict[str, Effect] = _load()
NAMES: tuple[str, ...] = tuple(CATALOGUE)
# Laws of dry friction: together they are one force.
DRY_LAWS: tuple[str, ...] = tuple(n for n, entry in CATALOGUE.items() if entry.family == "dry")
# Times, "effect.parameter" -> the signal that each makes late.
LATE: dict[str, str] = {f"{name}.{one.name}": one.late for name, entry in CATALOGUE.items()
                        for one in entry.parameters if one.late}
