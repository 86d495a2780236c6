"""The config as an object: of a file, of a mapping, or a changed copy; always validated."""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Union, get_args, get_origin

from pydantic import BaseModel

from eha_monitor.api.common import Record, calling, frame_of
from eha_monitor.errors import InputError
from eha_monitor.output import write_text
from eha_monitor.settings.load import annotated, load_settings, settings_from_tree
from eha_monitor.settings.monitor import Monitor, Settings, Thresholds
from eha_monitor.settings.rig import Rig, Simulation
from eha_monitor.units import keys_of, unit_of

if TYPE_CHECKING:
    import pandas

GIVEN = "config"  # what errors call a config that is of no file
_SHOWN = ("mass", "area_1", "area_2", "volume_1", "volume_2", "pump_displacement",
          "position_gain", "leakage", "charge_pressure", "sample_time")


@dataclass(frozen=True, init=False, repr=False)
class Config(Record):
    """A config: the rig, its channels, priors, thresholds and modelled effects.

    Every key has a unit, a range and a description: ``Config().to_frame()`` lists them,
    ``config/eha.yaml`` is the same as a file.  Numbers are SI, or strings with a unit.  A config
    cannot be changed; :meth:`changed` returns a changed copy.

    Parameters
    ----------
    **sections : mapping
        What differs from the paper's EHA, by section: ``rig``, ``simulation``, ``channels``,
        ``table``, ``noise``, ``stage_one``, ``stage_two``, ``thresholds``, ``viscosity``,
        ``monitor``, ``effects``, and the single keys ``discretisation``, ``command_hold``,
        ``engine`` and ``implausible``.

    Raises
    ------
    InputError
        One line: the key and what was expected.

    Examples
    --------
    >>> config = em.Config(rig={"mass": "25 kg", "area_1": "5.05 cm^2"})
    >>> config.rig.mass
    25.0
    >>> em.Config(rig={"mass": "25 m"})
    Traceback (most recent call last):
        ...
    eha_monitor.errors.InputError: config: rig.mass: expected a number in kg, got '25 m'
    """

    settings: Settings = field()
    source: str = field(compare=False)

    def __init__(self, **sections: Any):
        self._set(settings_from_tree(_plain(sections), GIVEN), "")

    def _set(self, settings: Settings, source: str) -> "Config":
        object.__setattr__(self, "settings", settings)
        object.__setattr__(self, "source", source)
        return self

    @classmethod
    def load(cls, path: str | os.PathLike) -> "Config":
        """Read a YAML file, in the form of ``config/eha.yaml`` or with the sections at the top.

        Parameters
        ----------
        path : str or path
            The file; ``~`` is the home folder.

        Returns
        -------
        Config
            What the file says; keys that it leaves out keep the paper's value.

        Raises
        ------
        InputError
            One line: file, key, what was expected.

        Examples
        --------
        >>> em.Config.load("config/air_ingress.yaml").simulation.faults["air"].parameter
        'entrained_air.alpha'
        """
        with calling():
            place = path_of(path, "a config")
            return cls.of(load_settings(place), str(place))

    @classmethod
    def from_dict(cls, tree: Mapping[str, Any]) -> "Config":
        """Return the config of a mapping of sections, such as :meth:`to_dict` gives.

        Parameters
        ----------
        tree : mapping
            Section -> key -> number (SI), string with a unit, or mapping.

        Returns
        -------
        Config
            What the mapping says; keys that it leaves out keep the paper's value.

        Raises
        ------
        InputError
            One line: the key and what was expected.

        Examples
        --------
        >>> em.Config.from_dict({"rig": {"mass": "25 kg"}}) == em.Config(rig={"mass": 25})
        True
        """
        if not isinstance(tree, Mapping):
            raise InputError(f"{GIVEN}: expected a mapping of sections, got {_kind(tree)}")
        return cls.of(settings_from_tree(_plain(tree), GIVEN))

    @classmethod
    def of(cls, settings: Settings, source: str = "") -> "Config":
        """Return the config of validated settings; for the commands."""
        return cls.__new__(cls)._set(settings, source)

    def changed(self, **sections: Any) -> "Config":
        """Return a changed copy; this one stays as it is.

        Parameters
        ----------
        **sections : mapping
            What is to be different.  A section is completed key by key; what has names of your
            own (``effects``, ``excitation``, ``faults``) is replaced as a whole.

        Returns
        -------
        Config
            The copy, validated.

        Raises
        ------
        InputError
            One line: the key and what was expected.

        Examples
        --------
        >>> config = em.Config().changed(rig={"mass": "25 kg"})
        >>> config.rig.mass, config.rig.leakage
        (25.0, 5e-13)
        """
        tree = self.settings.model_dump()
        _merge(tree, _plain(sections), Settings)
        return type(self).of(settings_from_tree(tree, self.source or GIVEN), self.source)

    @property
    def rig(self) -> Rig:
        """Constants of the actuator, SI: ``rig.mass``, ``rig.area_1``, ..."""
        return self.settings.rig

    @property
    def simulation(self) -> Simulation:
        """What the simulator does: motion, sensor noise, faults."""
        return self.settings.simulation

    @property
    def thresholds(self) -> Thresholds:
        """Alarm limits of B (N·s/m) and beta_e (Pa)."""
        return self.settings.thresholds

    @property
    def monitor(self) -> Monitor:
        """How the live monitor runs."""
        return self.settings.monitor

    @property
    def effects(self) -> dict[str, dict]:
        """Modelled physics beyond the linear model: effect -> parameter -> value, SI; a copy."""
        return {name: dict(values) for name, values in self.settings.effects.items()}

    def to_dict(self) -> dict[str, Any]:
        """Return every key as nested plain types, SI.

        Returns
        -------
        dict
            Section -> key -> value; :meth:`from_dict` reads it.
        """
        return self.settings.model_dump(mode="json")

    def to_yaml(self, title: str = "") -> str:
        """Return the config as YAML, each key with unit, range and description.

        Parameters
        ----------
        title : str
            A line for its head.

        Returns
        -------
        str
            What ``eha-monitor config`` prints, and every command reads with ``--config``.
        """
        return annotated(self.settings, title)

    def save(self, path: str | os.PathLike) -> Path:
        """Write :meth:`to_yaml` to a file.

        Parameters
        ----------
        path : str or path
            The file; it is replaced when the new one is complete.

        Returns
        -------
        Path
            The file.

        Raises
        ------
        InputError
            If it cannot be written.
        """
        with calling():
            place = path_of(path, "a file to write")
            write_text(place, self.to_yaml())
            return place

    def to_frame(self) -> "pandas.DataFrame":
        """Return a table of every key.

        Returns
        -------
        pandas.DataFrame
            Index ``key``, such as ``rig.mass``; columns value, unit, description.

        Examples
        --------
        >>> em.Config().to_frame().loc["rig.mass", "unit"]
        'kg'
        """
        columns = ("key", "value", "unit", "description")
        return frame_of((dict(zip(columns, row, strict=True)) for row in keys_of(self.settings)),
                        columns, "key")

    def _short(self):
        rows = [[f"rig.{key}", _number(getattr(self.rig, key)), unit_of(Rig, key)]
                for key in _SHOWN]
        rows += [[f"effects.{name}", ", ".join(f"{key} = {value}" for key, value
                                               in given.items()), ""]
                 for name, given in self.effects.items()]
        return (f"config of {self.rig.name}", self.source, ("key", "value", "unit"), rows,
                ("every key: to_frame()",))


def config_of(given: Any) -> Config:
    """Return the config that an argument means: a Config, a file, a mapping, or None."""
    if given is None:
        return Config()
    if isinstance(given, Config):
        return given
    if isinstance(given, (str, os.PathLike)):
        return Config.load(given)
    if isinstance(given, Mapping):
        return Config.from_dict(given)
    raise InputError(f"{GIVEN}: expected an em.Config, a YAML file, a mapping or None, got "
                     f"{_kind(given)}")


def path_of(given: Any, what: str) -> Path:
    """Return a path that an argument means; ``~`` is the home folder."""
    if not isinstance(given, (str, os.PathLike)) or not os.fspath(given):
        raise InputError(f"path: expected {what}, got {given!r}"[:200])
    place = Path(os.fsdecode(given))
    try:
        return place if place.exists() else place.expanduser()
    except RuntimeError as problem:  # a home that is not there
        raise InputError(f"{os.fsdecode(given)}: {problem}") from problem


def _kind(given: Any) -> str:
    return type(given).__name__


def _number(value: float | None) -> str:
    return "none" if value is None else f"{value:g}"


def _plain(given: Any) -> Any:
    """Return a tree with plain numbers and mappings in place of numpy's and of sections."""
    if isinstance(given, BaseModel):
        return given.model_dump()
    if isinstance(given, Mapping):
        return {str(key): _plain(value) for key, value in given.items()}
    if isinstance(given, (list, tuple)):
        return [_plain(value) for value in given]
    return given.item() if hasattr(given, "item") and getattr(given, "ndim", 0) == 0 else given


def _merge(tree: dict, given: dict, section: type[BaseModel] | None) -> None:
    """Complete a tree with what is given, in place; whatever is wrong, validation reports."""
    for key, value in given.items():
        annotation = section.model_fields[key].annotation if (
            section is not None and key in section.model_fields) else None
        inner = annotation if isinstance(annotation, type) and issubclass(
            annotation, BaseModel) else None
        if isinstance(value, dict) and isinstance(tree.get(key), dict) and (
                inner is not None or not _names_of_ones_own(annotation)):
            _merge(tree[key], value, inner)
        else:
            tree[key] = value


def _names_of_ones_own(annotation: Any) -> bool:
    """Tell whether a mapping has names that the user chooses, such as the effects."""
    if get_origin(annotation) is Union:
        return any(map(_names_of_ones_own, get_args(annotation)))
    return get_origin(annotation) is dict and get_args(annotation)[0] is str
