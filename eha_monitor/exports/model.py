"""The identified model as the exports take it: settings, where they come from, what is lost."""

from dataclasses import dataclass

from eha_monitor.errors import InputError
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.settings.monitor import Settings
from eha_monitor.settings.own_terms import is_own


@dataclass(frozen=True)
class Model:
    """A config to be exported.

    Attributes
    ----------
    settings : rig, effects and simulation.
    source : name of the config's file, in comments and errors.
    """

    settings: Settings
    source: str

    @property
    def rotary(self) -> bool:
        """Whether the rig turns: read m as rad, N as N·m, kg as kg·m²."""
        return self.settings.rig.motion == "rotary"

    @property
    def effects(self) -> dict[str, dict]:
        """Effects of the catalogue by name, with their parameters in SI."""
        return {name: values for name, values in self.settings.effects.items()
                if not is_own(values)}

    @property
    def own_terms(self) -> dict[str, dict]:
        """Terms of the rig's own by name."""
        return {name: values for name, values in self.settings.effects.items() if is_own(values)}

    @property
    def provenance(self) -> str:
        """Which numbers a recording determined, and that the others are the config's own."""
        found = self.settings.rig.identified
        return f"identified: {found}; the rest as configured" if found else (
            "as configured: no number in it was identified from a recording")

    def require(self, what: str, *keys: str) -> None:
        """Raise InputError if a number of the rig that an export needs is null."""
        for key in keys:
            if getattr(self.settings.rig, key) is None:
                raise InputError(f"{self.source}: rig.{key}: {what} needs a value, got null")

    def of_balance(self, *balances: str) -> list[str]:
        """Return the effects of the catalogue that act in some balances."""
        return [name for name in self.effects if CATALOGUE[name].balance in balances]


@dataclass(frozen=True)
class Exported:
    """A file in another program's format.

    Attributes
    ----------
    content : text or bytes of the file.
    lost : one line for each piece of the model that the format does not hold.
    """

    content: str | bytes
    lost: tuple[str, ...] = ()


def lost_of_simulation(model: Model) -> tuple[str, ...]:
    """Return what a free-running model leaves out of the config: noise, faults, rounding."""
    simulation, lost = model.settings.simulation, []
    lost.append("sensor noise: the outputs are free of it")
    if simulation.faults:
        lost.append(f"simulation.faults ({', '.join(simulation.faults)}): parameters do not "
                    "change over time")
    if simulation.noise.position_resolution or "position_quantisation" in model.effects:
        lost.append("position_quantisation: the position is continuous")
    return tuple(lost)
