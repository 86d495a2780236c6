"""The record of a diagnosis."""

import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from eha_monitor.api.answer import finite
from eha_monitor.api.calls import calling
from eha_monitor.api.config import Config, path_of
from eha_monitor.api.diagnosis_answer import answer, completed
from eha_monitor.api.indicators import trees
from eha_monitor.api.plausible import finding_tree
from eha_monitor.api.record import Record, chosen, frame_of, read_only
from eha_monitor.indicators.indicator import Indicator
from eha_monitor.mismatch.diagnosis import (
    Change,
    LearnedTerm,
    Location,
    NamedEffect,
    RigFinding,
    SignalFit,
    Value,
)
from eha_monitor.mismatch.diagnosis import Diagnosis as Inner
from eha_monitor.quantity import SYMBOLS
from eha_monitor.recordings.finding import ChannelFinding
from eha_monitor.reports.diagnosis_words import probability, value_words
from eha_monitor.words import effect_words, listed

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure

_EFFECT = ("name", "probability", "balance", "size", "statement", "log_evidence",
           "indistinguishable_from", "rig_check")
_VALUE = ("name", "symbol", "value", "stddev", "unit")
_RIG = ("key", "configured", "value", "stddev", "unit", "probability", "statement")
_CHANGE = ("what", "symbol", "balance", "reference", "reference_stddev", "now", "now_stddev",
           "unit", "statement")
_FIT = ("signal", "unit", "before_rms", "after_rms", "noise_rms", "before_whiteness",
        "after_whiteness", "signal_rms")
_CURVE = ("balance", "against", "against_unit", "unit", "x", "measured", "spread", "modelled")


@dataclass(frozen=True, eq=False, repr=False)
class Diagnosis(Record):
    """What :func:`diagnose` found; SI, of a rig that turns in rad and N·m.

    Attributes
    ----------
    config : Config
        The nominal config that it was made with.
    channels : tuple of ChannelFinding
        What the channels say of the config where it may be wrong, or of the hold of the demand.
    losses : tuple of str
        Sentences about what was lost in reading the recordings.
    indicators : tuple of Indicator
        Health in units to act on, leakage to drive lag; told, or why not (docs/health.md).
    """

    inner: Inner
    config: Config
    channels: tuple[ChannelFinding, ...]
    losses: tuple[str, ...] = ()
    indicators: tuple[Indicator, ...] = ()

    def __post_init__(self):
        object.__setattr__(self, "inner", read_only(self.inner))

    def __setstate__(self, state: dict) -> None:
        for key, value in state.items():
            object.__setattr__(self, key, value)
        self.__post_init__()  # a pickle does not keep that arrays cannot be written

    @property
    def verdict(self) -> str:
        """``consistent``, ``mismatch``, ``unexplained`` or ``insufficient_data``."""
        return self.inner.verdict

    @property
    def message(self) -> str:
        """The verdict as a sentence."""
        return self.inner.message

    @property
    def healthy(self) -> bool:
        """Whether the nominal model explains the recording: exit status 0 with ``--exit-code``."""
        return self.verdict not in ("mismatch", "unexplained")

    @property
    def bags(self) -> tuple[str, ...]:
        """What the recordings are called."""
        return self.inner.bags

    @property
    def probability(self) -> Mapping[str, float]:
        """Probability of ``consistent`` and of ``unexplained``, 0 to 1."""
        return self.inner.probability

    @property
    def effects(self) -> tuple[NamedEffect, ...]:
        """The physics that was left out, most important first; see :class:`NamedEffect`."""
        return self.inner.effects

    @property
    def rig_data(self) -> tuple[RigFinding, ...]:
        """Numbers of the rig that the recordings contradict; see :class:`RigFinding`."""
        return self.inner.rig_data

    @property
    def learned(self) -> tuple[LearnedTerm, ...]:
        """A model of what has no name, where one holds on unseen data; :class:`LearnedTerm`."""
        return self.inner.learned

    @property
    def changes(self) -> tuple[Change, ...]:
        """What has changed against the references; see :class:`Change`."""
        return self.inner.changes

    @property
    def location(self) -> Location:
        """Where model and recording disagree: balance, regime, intervals_s."""
        return self.inner.location

    @property
    def before(self) -> Mapping[str, Value]:
        """``B`` and ``beta_e`` as the nominal model reads them: value, stddev, unit."""
        return self.inner.before

    @property
    def after(self) -> Mapping[str, Value]:
        """``B`` and ``beta_e`` with the left-out physics in the model."""
        return self.inner.after

    @property
    def signals(self) -> Mapping[str, SignalFit]:
        """Free-run error of each signal on unseen data, before and after, SI."""
        return self.inner.signals

    @property
    def health(self) -> tuple[str, ...]:
        """Sentences on what the mismatch did to B and beta_e."""
        return self.inner.health

    @property
    def advice(self) -> tuple[str, ...]:
        """Sentences on what to record next."""
        return self.inner.advice

    def to_dict(self) -> dict[str, Any]:
        """Return the answer as JSON's plain types.

        Returns
        -------
        dict
            What ``eha-monitor diagnose --json`` writes (schema ``eha_monitor/diagnosis/1``).

        Examples
        --------
        >>> d.to_dict()["effects"][0]["name"]
        'coulomb_friction'
        """
        return answer(self.inner) | {"channels": finding_tree(self.channels),
                                     "indicators": trees(self.indicators)}

    def to_frame(self, table: str = "effects") -> "pandas.DataFrame":
        """Return a table of the answer.

        Parameters
        ----------
        table : str
            ``effects`` (a row for each), ``values`` (a row for each of their parameters),
            ``rig_data``, ``changes``, ``parameters`` (B and beta_e before and after), ``fit``
            (free-run errors on unseen data), ``considered`` (what was tried and not named) or
            ``curves`` (the missing terms against motion).

        Returns
        -------
        pandas.DataFrame
            SI units.

        Raises
        ------
        InputError
            If there is no such table.

        Examples
        --------
        >>> d.to_frame("values").set_index("symbol").loc["F_c", "value"].round(1)
        np.float64(40.0)
        """
        return chosen(table, {
            "effects": lambda: frame_of(map(asdict, self.effects), _EFFECT, "name"),
            "values": lambda: frame_of(({"name": effect.name, "symbol": symbol} | asdict(value)
                                        for effect in self.effects
                                        for symbol, value in effect.parameters.items()),
                                       _VALUE, "name"),
            "rig_data": lambda: frame_of((asdict(one) | asdict(one.found)
                                          for one in self.rig_data), _RIG, "key"),
            "changes": lambda: frame_of(map(_change, self.changes), _CHANGE, "what"),
            "parameters": lambda: frame_of((
                {"when": when, "parameter": name} | asdict(value)
                for when, values in (("before", self.before), ("after", self.after))
                for name, value in values.items()),
                ("when", "parameter", "value", "stddev", "unit"), "parameter"),
            "fit": lambda: frame_of(({"signal": name} | asdict(fit)
                                     for name, fit in self.signals.items()), _FIT, "signal"),
            "considered": lambda: frame_of(map(asdict, self.inner.considered),
                                           ("name", "gain", "beside", "why"), "name"),
            "curves": lambda: frame_of(
                ({**{key: getattr(curve, key) for key in _CURVE[:4]},
                  **dict(zip(_CURVE[4:], point, strict=True))} for curve in self.inner.curves
                 for point in zip(*(getattr(curve, key) for key in _CURVE[4:]), strict=True)),
                _CURVE)}, "table")()

    def plot(self, what: str = "missing") -> "Figure":
        """Draw the proof.

        Parameters
        ----------
        what : str
            ``missing``: what the recording shows and the model lacks, and what the named physics
            makes; ``fit``: both models running free on unseen data; ``B`` or ``beta_e``: the
            parameter from each part of the recording, before and after.

        Returns
        -------
        matplotlib.figure.Figure
            A notebook shows it; ``figure.savefig("diagnosis.png")`` keeps it.

        Raises
        ------
        InputError
            If there is no such picture.
        """
        from eha_monitor.reports.api_figures import DIAGNOSIS_DRAWINGS

        return chosen(what, DIAGNOSIS_DRAWINGS, "what")(self.inner)

    def completed(self) -> Config:
        """Return the nominal config completed with what was found, as ``--write-config`` does.

        Returns
        -------
        Config
            With the named effects, the corrected numbers of the rig, B and beta_e; ``estimate``
            with it carries no error of the model.  Unchanged where nothing explains the mismatch.

        Examples
        --------
        >>> round(d.completed().effects["coulomb_friction"]["F_c"])
        40
        """
        return Config.of(completed(self.inner, self.config.settings)[0])

    def report(self, path: str | os.PathLike, *, command: str = "") -> Path:
        """Write the self-contained HTML report of ``eha-monitor diagnose --report``.

        Parameters
        ----------
        path : str or path
            The file; it is replaced when the new one is complete.
        command : str
            What made the answer, for its foot.

        Returns
        -------
        Path
            The file.

        Raises
        ------
        InputError
            If it cannot be written.
        """
        from eha_monitor.reports.diagnosis_report import write_diagnosis_report

        with calling():
            place = path_of(path, "a file to write")
            write_diagnosis_report(place, self.inner, self.config.settings, [
                *self.losses, *(finding.finding for finding in self.channels)], command,
                self.indicators)
            return place

    def _short(self):
        rows = [[effect_words(effect.name), probability(effect.probability), effect.size,
                 ", ".join(f"{symbol} = {value_words(value)}"
                           for symbol, value in effect.parameters.items())]
                for effect in self.effects]
        rows += [[f"rig.{one.key}", probability(one.probability), "", one.statement]
                 for one in self.rig_data]
        rows += [["learned", "", term.size, term.statement] for term in self.learned]
        rows += [["changed", "", one.what, one.statement] for one in self.changes]
        rows += [[f"{SYMBOLS.get(name, name)}, before → after", "", "",
                  f"{value_words(self.before.get(name))} → {value_words(self.after.get(name))}"]
                 for name in dict.fromkeys((*self.before, *self.after))]
        return (f"{listed(self.bags)}: {self.verdict}", self.message,
                ("what", "probability", "size", "numbers"), rows, self.health)


def _change(change: Change) -> dict[str, Any]:
    return finite(asdict(change)) | {
        "reference": change.reference.value, "reference_stddev": change.reference.stddev,
        "now": change.now.value, "now_stddev": change.now.stddev}
