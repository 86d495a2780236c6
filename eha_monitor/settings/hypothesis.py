"""A hypothesis of the user's: an expression whose parameters a diagnosis is to fit.

    name: worn_spot
    adds: force
    expression: "F*exp(-((x - x_0)/w)**2)*tanh(v/1e-3)"
    parameters:
      F: {start: 20.0, lower: 0.0, upper: 500.0, unit: N}
      x_0: {start: 0.0, lower: -0.03, upper: 0.03, unit: m}
      w: {start: 3.0e-3, lower: 1.0e-4, upper: 0.05, unit: m}
    sentence: "the cylinder is worn at {x_0}: the seal grips with up to {F}"

All numbers are SI; the sentence may name parameters in braces.  An installed package gives the
same as a mapping under an entry point of the group ``eha_monitor.effects``.
"""

from importlib.metadata import entry_points
from pathlib import Path
from string import Formatter

from pydantic import BaseModel, ConfigDict, Field, model_validator

from eha_monitor.errors import InputError
from eha_monitor.physics.own_term import ADDED
from eha_monitor.settings.load import tree_of, validated
from eha_monitor.settings.own_terms import checked

MOST_PARAMETERS = 8
GROUP = "eha_monitor.effects"  # of the entry points of installed packages


class Fitted(BaseModel):
    """A parameter that is fitted, SI: where a fit begins, and its bounds."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    start: float
    lower: float
    upper: float
    unit: str = Field("", max_length=20)

    @model_validator(mode="after")
    def _inside(self):
        if not self.lower < self.upper:
            raise ValueError(f"upper: expected more than lower, {self.lower:g}, "
                             f"got {self.upper:g}")
        if not self.lower <= self.start <= self.upper:
            raise ValueError(f"start: expected {self.lower:g} to {self.upper:g}, "
                             f"got {self.start:g}")
        return self

    @property
    def log(self) -> bool:
        """Whether it is fitted as a logarithm: only its order of size is known."""
        return self.lower > 0.0 and self.upper / self.lower >= 10.0


class Hypothesis(BaseModel):
    """What is suspected; keys as in the module's head."""

    model_config = ConfigDict(extra="forbid")

    name: str
    adds: str
    expression: str
    parameters: dict[str, Fitted] = Field(min_length=1, max_length=MOST_PARAMETERS)
    sentence: str = Field("", max_length=300)
    check: str = Field("", max_length=300)

    @model_validator(mode="after")
    def _sound(self):
        checked(self.name, self.entry({key: one.start for key, one in self.parameters.items()}))
        try:
            parts = list(Formatter().parse(self.sentence))
        except ValueError:
            parts = [("", "{", "", None)]
        if any(name is not None and (name not in self.parameters or form or turned)
               for _, name, form, turned in parts):
            raise ValueError("sentence: expected only names of its parameters in braces, "
                             f"{', '.join(self.parameters)}")
        return self

    def entry(self, values: dict[str, float]) -> dict:
        """Return it as an entry of a config's ``effects``, with values of its parameters, SI."""
        return {"adds": self.adds, "expression": self.expression, **values}

    @property
    def balance(self) -> str:
        """Balance in which it acts."""
        return {"force": "force", "speed": "drive"}.get(self.adds, "flow")


def load_hypothesis(path: str | Path) -> Hypothesis:
    """Return the hypothesis of a YAML file, or of an installed package by its name.

    Raises InputError, one line: file or name, key, what was expected.
    """
    return hypothesis_of(installed(str(path)) if not Path(path).exists() and Path(
        path).suffix == "" else tree_of(path, "a hypothesis"), path)


def installed(name: str):
    """Return what an installed package has under a name of the group :data:`GROUP`.

    Raises InputError if no package has it, or its module cannot be imported.
    """
    known = {one.name: one for one in entry_points(group=GROUP)}
    if name not in known:
        raise InputError(f"{name}: expected a file with a hypothesis, or the name of one that an "
                         f"installed package has ({GROUP}: {', '.join(known) or 'none'})")
    try:
        return known[name].load()
    except Exception as problem:  # whatever a stranger's module does when it is imported
        raise InputError(f"{name}: {known[name].value} cannot be loaded: {problem}") from problem


def hypothesis_of(tree, source: str | Path) -> Hypothesis:
    """Return a hypothesis of a parsed tree; ``source`` names it in errors."""
    if not isinstance(tree, dict) or not tree.keys() & Hypothesis.model_fields.keys():
        raise InputError(f"{source}: expected a hypothesis: name, adds ({', '.join(ADDED)}), "
                         "expression, parameters")
    return validated(Hypothesis, tree, source)
