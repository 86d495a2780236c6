"""The form of one entry of the catalogue of left-out physics."""

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Parameter:
    """One parameter of an effect.

    Attributes
    ----------
    name : symbol as it stands in configs and results, e.g. ``F_c``.
    unit : SI unit, e.g. ``N``.
    description : one phrase.
    lower, upper : bounds in ``unit``; values outside are refused by the config.
    scale : typical size in ``unit``; the prior's standard deviation.
    default : value that the config takes when the parameter is not given; None means required.
    """

    name: str
    unit: str
    description: str
    lower: float
    upper: float
    scale: float
    default: float | None = None


@dataclass(frozen=True)
class Effect:
    """One piece of physics beyond the linear model: equation, parameters, words.

    Attributes
    ----------
    name : name in the interface contract, e.g. ``coulomb_friction``.
    balance : ``force``, ``flow``, ``drive`` or ``sensor``.
    equation : the equation as text for the report.
    source : where the equation comes from.
    parameters : at most ``signals.MAX_PARAMETERS`` of them.
    term : compiled ``term(s, p, c)``; reads signals ``s`` and parameters ``p`` and adds to the
        contributions ``c`` (indices in :mod:`eha_monitor.physics.signals`).
    statement : sentence with ``{symbol}`` places for the report.
    rig_check : what to look at on the rig.
    """

    name: str
    balance: str
    equation: str
    source: str
    parameters: tuple[Parameter, ...]
    term: Callable
    statement: str
    rig_check: str
