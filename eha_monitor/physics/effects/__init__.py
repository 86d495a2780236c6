"""The catalogue: every module of this folder is one effect; adding a file adds the physics."""

import importlib
import pkgutil

from eha_monitor.physics.effect import Effect


def _load() -> dict[str, Effect]:
    found = {}
    for info in sorted(pkgutil.iter_modules(__path__), key=lambda item: item.name):
        effect = importlib.import_module(f"{__name__}.{info.name}").EFFECT
        found[effect.name] = effect
    return found


CATALOGUE: dict[str, Effect] = _load()
NAMES: tuple[str, ...] = tuple(CATALOGUE)
