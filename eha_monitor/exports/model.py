"""The identified model as the exports take it: settings, ports, units, what is lost."""

import re
import textwrap
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import jinja2
import numpy as np
from markupsafe import Markup

from eha_monitor.errors import InputError
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.physics.simulator import demanded_position
from eha_monitor.settings.load import scalar
from eha_monitor.settings.monitor import Settings
from eha_monitor.settings.own_terms import is_own
from eha_monitor.units import plain as in_ascii

INPUTS = (("x_d", "m", "demanded position, with closed_loop"),
          ("pump_speed", "rad/s", "shaft speed of the pump, without closed_loop"),
          ("load_force", "N", "external force, positive against positive motion"))
OUTPUTS = (("x", "m", "position"), ("v", "m/s", "velocity"),
           ("p1", "Pa", "absolute pressure of chamber 1"),
           ("p2", "Pa", "absolute pressure of chamber 2"),
           ("omega", "rad/s", "shaft speed of the pump"),
           ("x_measured", "m", "position as its sensor shows it: late, off its scale"),
           ("p1_measured", "Pa", "pressure 1 as its sensor shows it"),
           ("p2_measured", "Pa", "pressure 2 as its sensor shows it"),
           ("force", "N", "pressure force A1 p1 - A2 p2"))
_SI = {"m": {"m": 1}, "s": {"s": 1}, "kg": {"kg": 1}, "rad": {"rad": 1},
       "N": {"kg": 1, "m": 1, "s": -2}, "Pa": {"kg": 1, "m": -1, "s": -2}}
# Numbers of the rig without which there is no whole plant.
_NEEDED = ("area_1", "area_2", "volume_1", "volume_2", "pump_displacement")


@dataclass(frozen=True)
class Model:
    """A config to be exported."""

    settings: Settings
    source: str  # name of the config's file, in comments and errors

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

    @property
    def identifier(self) -> str:
        """The rig's name as C and Modelica allow it."""
        found = re.sub(r"\W", "_", self.settings.rig.name, flags=re.ASCII)
        return found if re.match(r"[A-Za-z_]", found) else f"eha_{found}"

    @property
    def start(self) -> float:
        """Position at the start, m."""
        return float(demanded_position(self.settings.simulation.excitation, np.zeros(1))[0])

    def require(self, what: str) -> None:
        """Raise InputError if a number of the rig that a whole plant needs is null."""
        for key in _NEEDED:
            if getattr(self.settings.rig, key) is None:
                raise InputError(f"{self.source}: rig.{key}: {what} needs a value, got null")

    def of_balance(self, *balances: str) -> list[str]:
        """Return the effects of the catalogue that act in some balances."""
        return [name for name in self.effects if CATALOGUE[name].balance in balances]


@dataclass(frozen=True)
class Exported:
    """A file in another program's format."""

    content: str | bytes
    # One line for each piece of the model that the format does not hold.
    lost: tuple[str, ...] = ()


def lost_of_simulation(model: Model) -> tuple[str, ...]:
    """Return what a free-running model leaves out of the config: noise, faults, rounding."""
    simulation, lost = model.settings.simulation, ["sensor noise: the outputs are free of it"]
    if simulation.faults:
        lost.append(f"simulation.faults ({', '.join(simulation.faults)}): parameters do not "
                    "change over time")
    if simulation.noise.position_resolution or "position_quantisation" in model.effects:
        lost.append("position_quantisation: the position is continuous")
    if model.settings.command_hold == "sampled":
        lost.append("command_hold: the drive's command is continuous")
    return tuple(lost)


def plain(unit: str) -> str:
    """Return a unit in ASCII: ``N*s/m``, ``m^3/(s*Pa)``; empty where there is none."""
    return "" if unit == "1" else in_ascii(unit)


def exponents(unit: str) -> dict[str, int] | None:
    """Return the exponents of kg, m, s and rad in a plain unit; None where they are not whole."""
    above, _, below = unit.partition("/")
    found: dict[str, int] = {}
    for part, sign in ((above, 1), (below.strip("()"), -1)):
        for factor in filter(None, part.split("*")):
            name, _, power = factor.partition("^")
            if name == "1":
                continue
            if name not in _SI or "." in power:
                return None
            for base, exponent in _SI[name].items():
                found[base] = found.get(base, 0) + sign * exponent * int(power or 1)
    return {base: exponent for base, exponent in found.items() if exponent}


@lru_cache(maxsize=1)
def _templates() -> jinja2.Environment:
    made = jinja2.Environment(
        loader=jinja2.PackageLoader("eha_monitor.exports"), undefined=jinja2.StrictUndefined,
        autoescape=lambda name: name.endswith(".xml.j2"), trim_blocks=True, lstrip_blocks=True,
        keep_trailing_newline=True)
    made.filters |= {"six": "{:.6g}".format, "yaml": _yaml,
                     "comment": lambda text: Markup(text.replace("--", "- -"))}
    return made


def rendered(template: str, **facts: Any) -> str:
    """Return a file of ``templates/``; in XML every value is escaped."""
    return _templates().get_template(template).render(facts)


def _yaml(value: np.ndarray | float) -> str:
    """Return a number of seven digits, or a row of numbers or truths in a few lines, as YAML."""
    if np.ndim(value):
        return "[" + textwrap.fill(", ".join(map(_yaml, value)), 85,
                                   subsequent_indent=" " * 8) + "]"
    return scalar(bool(value) if isinstance(value, np.bool_) else float(f"{value:.7g}") + 0.0)
