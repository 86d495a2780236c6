"""``diagnose`` in Python: which physics the model left out, where, and the proof."""

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any

from eha_monitor import __version__
from eha_monitor.api.common import READING, Progress, Record, calling, chosen, frame_of, reporter
from eha_monitor.api.config import Config, path_of
from eha_monitor.api.read import (
    Given,
    ImplausibleError,
    Several,
    checked,
    config_for,
    distinct,
    recordings_of,
    several,
)
from eha_monitor.archive.find import find_bags, is_archive
from eha_monitor.balances.machine import load
from eha_monitor.balances.parameters import leakage_of
from eha_monitor.compiled import load_runtime
from eha_monitor.errors import InputError
from eha_monitor.indicators.assemble import evidence_of_diagnosis, indicators
from eha_monitor.indicators.indicator import Indicator
from eha_monitor.mismatch.compared import beside, compared
from eha_monitor.mismatch.diagnose import diagnose as run
from eha_monitor.mismatch.diagnosis import Change, LearnedTerm, NamedEffect
from eha_monitor.mismatch.diagnosis import Diagnosis as Found
from eha_monitor.output import finite, write_text
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.quantity import NOTE, SYMBOLS, in_units, rig_motion, with_uncertainty
from eha_monitor.reports import diagnosis_words as words
from eha_monitor.settings.hypothesis import Hypothesis, hypothesis_of, load_hypothesis
from eha_monitor.settings.load import annotated, settings_from_tree
from eha_monitor.settings.monitor import Settings
from eha_monitor.settings.own_terms import is_own
from eha_monitor.settings.rig import Rig, corrected, rounded
from eha_monitor.units import LARGEST
from eha_monitor.words import effect_words, listed, probability

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


def diagnose(recordings: Several, config: Config | str | os.PathLike | dict | None = None, *,
             held_out: Given | None = None, references: Several = (),
             hypothesis: Hypothesis | str | os.PathLike | dict | None = None,
             without: str | Sequence[str] = (), vary: str | Sequence[str] = (),
             machine: str | os.PathLike | None = None, progress: Progress = False) -> "Diagnosis":
    """Say where model and recordings differ, which physics that is, and show the fit improve.

    Parameters
    ----------
    recordings : Recording, path, or list of them
        Of one rig, explained together; paths are read with the config.
    config : Config, path, mapping or None
        The nominal rig; its effects are known to 5 %.  Without it what the first recording was
        read or simulated with, and of a path the paper's EHA.
    held_out : Recording or path, optional
        Show the fit on this one; without it on a part that is kept back.
    references : Recording, path, or list of them
        Healthy recordings of the machine, or a folder of their bags: the answer is what has
        changed against these (docs/reference.md).
    hypothesis : path, name or mapping, optional
        Your own suspicion: an expression whose parameters are fitted and ranked beside the
        catalogue (docs/effects.md).
    without : str or list of str
        Effects of the catalogue that are not considered.
    vary : str or list of str
        What is known to differ between several recordings: ``load``.
    machine : path, optional
        A machine that several recordings have shown before: the one recording is judged against
        it, by its balances alone, in a fraction of a second (docs/one_machine.md).
    progress : bool or callable
        True: a line on the standard error; a function is called with (text, share from 0 to 1).

    Returns
    -------
    Diagnosis
        The answer of the command ``diagnose``.

    Raises
    ------
    InputError
        One line: what is wrong with a recording, the config or an argument.
    ImplausibleError
        If a recording's channels contradict the config (signs, units, swapped channels).

    Examples
    --------
    >>> sine = {"kind": "sine", "amplitude": "20 mm", "frequency": "1 Hz", "duration": "2 s"}
    >>> rubbing = em.Config(effects={"coulomb_friction": {"F_c": "40 N"}},
    ...                     simulation={"excitation": {"sine": sine}})
    >>> rub = em.simulate(rubbing, seed=1)
    >>> d = em.diagnose(rub, em.Config())  # the config of the healthy rig
    >>> d.verdict, [effect.name for effect in d.effects]
    ('mismatch', ['coulomb_friction'])
    >>> d.effects[0].statement
    'Coulomb friction of 40.1 N opposes the motion at every speed'
    """
    with calling():
        given, config = several(recordings, "recordings"), config_for(
            recordings, config, "recordings")
        none = not references if isinstance(references, (list, tuple)) else references is None
        healthy = () if none else tuple(
            bag for one in several(references, "references")
            for bag in (bags_of(one) if isinstance(one, Path) else (one,)))
        unseen = several(held_out, "held_out") if held_out is not None else ()
        if len(unseen) > 1:
            raise InputError(f"held_out: expected one recording, got {len(unseen)}")
        distinct(given, *unseen[:1] or (None,), healthy)
        without = known_effects(without, "without")
        vary = (vary,) if isinstance(vary, str) else tuple(vary)
        if unknown := [name for name in vary if name != "load"]:
            raise InputError(f"vary: {unknown[0]}: expected load")
        known = None if machine is None else load(
            path_of(machine, "a file with a machine"), config.settings.rig)
        if known is not None and (len(given) != 1 or healthy or unseen or hypothesis is not None):
            raise InputError("machine: expected one recording, and neither references, held_out "
                             "nor hypothesis beside it")
        if healthy and (unseen or hypothesis is not None or without):
            raise InputError("references: expected neither held_out, hypothesis nor without "
                             "beside it")
        suspicion = _hypothesis(hypothesis)
        say = reporter(progress)
        say("reading", 0.0)
        load_runtime()
        read, kept, references = (recordings_of(part, config, "recordings") if part else []
                                  for part in (given, unseen, healthy))
        say("checking that recording and config match", READING)
        usable, channels = checked([*read, *kept, *references], config.settings)
        usable = iter(usable)
        read, kept, references = (list(islice(usable, len(part)))
                                  for part in (read, kept, references))

        def further(text: str, share: float) -> None:
            say(text, READING + (1 - READING) * share)

        with rig_motion(config.rig.motion):
            if known is not None:
                found = beside(known, read, config.settings)
            elif references:
                further("comparing", 0.5)
                found = compared(read, references, config.settings)
            else:
                found = run(read, config.settings, kept[0] if kept else None, further, suspicion,
                            without, vary)
            found = in_units(found)
        say("diagnosed", 1.0)
    return Diagnosis(**vars(found) | {"channels": (*channels, *found.channels)}, config=config,
                     losses=tuple(f"{one.source}: {loss}" for one in read for loss in one.losses),
                     indicators=indicators(evidence_of_diagnosis(
                         found, read, config.settings, leakage_of(read[0], config.settings)
                         if len(read) == 1 else None), config.settings))


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Diagnosis(Record, Found):
    """What :func:`diagnose` found; SI, of a rig that turns in rad and N·m.

    Attributes
    ----------
    verdict : str
        ``consistent``, ``mismatch``, ``unexplained`` or ``insufficient_data``.
    message : str
        The verdict as a sentence.
    bags : tuple of str
        What the recordings are called.
    probability : Mapping of str to float
        Probability of ``consistent`` and of ``unexplained``, 0 to 1.
    effects : tuple of NamedEffect
        The physics that was left out, most important first; see :class:`NamedEffect`.
    rig_data : tuple of RigFinding
        Numbers of the rig that the recordings contradict; see :class:`RigFinding`.
    learned : tuple of LearnedTerm
        A model of what has no name, where one holds on unseen data; :class:`LearnedTerm`.
    changes : tuple of Change
        What has changed against the references; see :class:`Change`.
    change_points : tuple of ChangePoint
        Where a number changed while a recording ran: bag, before_s, since_s, step, statement.
        All else is of the state since.
    drift : Value or None
        By how much viscous damping changes from start to end, as in oil that warms, where it
        surely does, N·s/m.
    events : tuple of Event
        What disturbed a recording for a while: bag, start_s, stop_s, balance, size, statement.
        All else is of the rest.
    location : Location
        Where model and recording disagree: balance, regime, intervals_s.
    before : Mapping of str to Value
        ``B`` and ``beta_e`` as the nominal model reads them: value, stddev, unit.
    after : Mapping of str to Value
        ``B`` and ``beta_e`` with the left-out physics in the model.
    signals : Mapping of str to SignalFit
        Free-run error of each signal on unseen data, before and after, SI.
    health : tuple of str
        Sentences on what the mismatch did to B and beta_e.
    advice : tuple of str
        Sentences on what to record next.
    config : Config
        The nominal config that it was made with.
    channels : tuple of ChannelFinding
        What the channels say of the config where it may be wrong, or of the hold of the demand.
    losses : tuple of str
        Sentences about what was lost in reading the recordings.
    indicators : tuple of Indicator
        Health in units to act on, leakage to drive lag; estimated, or why not (docs/health.md).
    """

    config: Config
    losses: tuple[str, ...] = ()
    indicators: tuple[Indicator, ...] = ()

    @property
    def healthy(self) -> bool:
        """Whether the nominal model explains the recording: exit status 0 with ``--exit-code``."""
        return self.verdict not in ("mismatch", "unexplained")

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
        return answer(self) | {
            "channels": finite(self.channels),
            "indicators": [one.tree(self.config.settings) for one in self.indicators]}

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
        np.float64(40.1)
        """
        return chosen(table, {
            "effects": lambda: frame_of(map(asdict, self.effects), _EFFECT, "name"),
            "values": lambda: frame_of(({"name": effect.name, "symbol": symbol} | asdict(value)
                                        for effect in self.effects
                                        for symbol, value in effect.parameters.items()),
                                       _VALUE, "name"),
            "rig_data": lambda: frame_of((asdict(one) | asdict(one.found)
                                          for one in self.rig_data), _RIG, "key"),
            "changes": lambda: frame_of(map(_change_row, self.changes), _CHANGE, "what"),
            "parameters": lambda: frame_of((
                {"when": when, "parameter": name} | asdict(value)
                for when, values in (("before", self.before), ("after", self.after))
                for name, value in values.items()),
                ("when", "parameter", "value", "stddev", "unit"), "parameter"),
            "fit": lambda: frame_of(({"signal": name} | asdict(fit)
                                     for name, fit in self.signals.items()), _FIT, "signal"),
            "considered": lambda: frame_of(map(asdict, self.considered),
                                           ("name", "gain", "beside", "why"), "name"),
            "curves": lambda: frame_of(
                ({**{key: getattr(curve, key) for key in _CURVE[:4]},
                  **dict(zip(_CURVE[4:], point, strict=True))} for curve in self.curves
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

        return chosen(what, DIAGNOSIS_DRAWINGS, "what")(self)

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
        return Config.of(completed(self, self.config.settings)[0])

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
        from eha_monitor.reports.diagnosis_report import diagnosis_page

        with calling():
            place = path_of(path, "a file to write")
            write_text(place, diagnosis_page(self, self.config.settings, [
                *self.losses, *words.channels_in_parts(self)[1]], command,
                self.indicators))
            return place

    def _short(self):
        rows = [[effect_words(effect.name), probability(effect.probability), effect.size,
                 _sizes(effect)]
                for effect in self.effects]
        rows += [[f"rig.{one.key}", probability(one.probability), "", one.statement]
                 for one in self.rig_data]
        rows += [["learned", "", term.size, term.statement] for term in self.learned]
        rows += [["changed", "", one.what, one.statement] for one in self.changes]
        rows += [[f"{SYMBOLS.get(name, name)}, before → after", "", "",
                  " → ".join(words.value_words(values.get(name))
                             for values in (self.before, self.after))]
                 for name in dict.fromkeys((*self.before, *self.after))]
        return (f"{listed(self.bags)}: {self.verdict}", self.message,
                ("what", "probability", "size", "numbers"), rows, self.health)


def known_effects(names: str | Sequence[str], option: str) -> tuple[str, ...]:
    """Return effects by name, each of them of the catalogue; the caller calls them ``option``.

    Raises InputError, naming the first that is none.
    """
    names = (names,) if isinstance(names, str) else tuple(names)
    if unknown := [name for name in names if name not in CATALOGUE]:
        raise InputError(f"{option}: {unknown[0]}: expected an effect of the catalogue, "
                         f"e.g. {', '.join(sorted(CATALOGUE)[:3])}")
    return names


def bags_of(path: Path) -> list[Path]:
    """Return the bags of a folder of bags, or the one bag that a path is."""
    return [place.path for place in find_bags(path) if not place.problem] if is_archive(
        path) else [path]


def _hypothesis(given: Any) -> Hypothesis | None:
    if given is None or isinstance(given, Hypothesis):
        return given
    if isinstance(given, Mapping):
        return hypothesis_of(dict(given), "hypothesis")
    return load_hypothesis(path_of(given, "a file with a hypothesis, or an installed name"))


def _sizes(effect: NamedEffect) -> str:
    return ", ".join(f"{name} = {words.value_words(value)}"
                     for name, value in effect.parameters.items())


def _change_row(change: Change) -> dict[str, Any]:
    return finite(change) | {
        "reference": change.reference.value, "reference_stddev": change.reference.stddev,
        "now": change.now.value, "now_stddev": change.now.stddev}


# ---- the JSON of the contract, and the config with the named physics ---------------------------

SCHEMA = "eha_monitor/diagnosis/1"
# Estimated parameter -> key of the rig that holds it.
RIG_KEYS = {"B": "viscous_damping", "beta_e": "bulk_modulus"}
# Keys of the answer that are fields of the record.
AS_THEY_ARE = ("rig_data", "rig_within", "location", "effects", "advice", "message", "bags",
               "health", "remarks", "agreement", "considered", "curves", "references",
               "config_effects", "gates", "change_points", "drift", "events", "blind", "policy",
               "named_on", "duration_s", "wall_s")
_WIDTH = 95  # of the head of a written config


def answer(found: Found) -> dict:
    """Return the JSON tree: the contract's keys, then what extends it.  NaN becomes null."""
    return finite({
        "schema": SCHEMA,
        "bag": ", ".join(found.bags),
        "verdict": found.verdict,
        "probability": {key: found.probability.get(key)
                        for key in ("consistent", "unexplained")},
        **{key: getattr(found, key) for key in AS_THEY_ARE},
        "parameters": {"before": found.before, "after": found.after},
        "fit": {"data": found.data, "signals": found.signals},
        "learned": [_learned(term) for term in found.learned],
        "changes": [_change(one) for one in found.changes],
        # Probabilities took their place; programs that read them find the keys.
        "threshold": {"log_units": None, "calibrated": False},
        "explained": None,
        "baseline": [one.to_dict() for one in found.baselines],
        "pieces": [{"bag": piece.bag, "start_s": piece.start_s, "stop_s": piece.stop_s,
                    "parameters": piece.values} for piece in found.pieces],
    } | ({"machine": found.machine.to_dict()} if found.machine is not None else {}))


def refusal(bags: tuple[Path, ...], problem: ImplausibleError) -> dict:
    """Return the JSON tree of recordings that contradict their config; nothing is diagnosed."""
    return {
        "schema": SCHEMA, "bag": ", ".join(map(str, bags)), "verdict": "insufficient_data",
        "probability": {"consistent": None, "unexplained": None}, "rig_data": [],
        "location": {"balance": dict.fromkeys(("force", "flow", "drive", "sensor"), 0.0),
                     "regime": "", "intervals_s": []},
        "effects": [], "parameters": {"before": {}, "after": {}},
        "fit": {"data": "held_out", "signals": {}}, "advice": [], "message": str(problem),
        "channels": finite(problem.channels)}


def _change(change: Change) -> dict:
    numbers = {when: {"value": value.value, "stddev": value.stddev}
               for when, value in (("reference", change.reference), ("now", change.now))}
    return {"what": change.what, "parameter": change.symbol, "balance": change.balance, **numbers,
            "unit": change.unit, "statement": change.statement,
            "indistinguishable_from": change.indistinguishable_from}


def _learned(term: LearnedTerm) -> dict:
    """Return the contract's keys of a learned term, then what extends them."""
    arrays = ("x", "curve", "band", "at", "measured", "spread", "formula_curve")
    return {"balance": term.balance, "of": term.of, "formula": term.formula,
            "shape": term.shape,
            "alternatives": [shown for shown, _ in term.rivals],
            "held_out_error_removed": term.removed, "adds": term.adds,
            "statement": term.statement, "size": term.size, "unit": term.unit,
            "against_unit": term.against_unit, "log_evidence": term.gained,
            "alternatives_behind": [behind for _, behind in term.rivals],
            "covered": [float(term.x[0]), float(term.x[-1])], "entry": term.entry,
            **{name: getattr(term, name) for name in arrays}}


def completed(found: Found, settings: Settings) -> tuple[Settings, list[str], list[str]]:
    """Return the given config completed with what was found.

    ``effects`` is what the diagnosis says.  Numbers of the rig, B and beta_e become the fitted
    ones, those within their tolerance too: with a pump that is 1.8 % off, and known to 3 %, stage
    two is off by 500 times the noise.  ``simulator`` then makes what was recorded, and the filters
    start where the rig is.  Nothing else is changed, thresholds and priors included: whether the
    rig is healthy is not for a fit to say.  Where neither names nor a learned term explain the
    mismatch, the config stays as it was.

    Returns
    -------
    settings : completed.
    changed : what is different, in words; ``missing`` what was found and cannot stand in it.
    """
    tree = settings.model_dump()
    changed, missing = [], []
    if found.command_hold != settings.command_hold:
        tree["command_hold"] = found.command_hold
        changed.append(f"command_hold: {found.command_hold}")
    if found.verdict == "mismatch" or found.learned or (
            found.verdict == "consistent" and found.fitted is not None):
        changed += _corrected_numbers(found, settings, tree["rig"], missing)
        changed += _named_physics(found, tree, missing)
        known = [*filter(None, settings.rig.identified.split(", ")),
                 *(finding.key for finding in found.rig_data),
                 *(one.name for one in found.effects if one.name in tree["effects"])]
        for name, key in RIG_KEYS.items():
            value = found.after.get(name)
            if value is not None and 0 < value.value < LARGEST:
                tree["rig"][key] = rounded(value.value)
                shown = with_uncertainty(value.value, value.stddev, value.unit)
                changed.append(f"rig.{key}: {shown}")
                known.append(key)
        tree["rig"]["identified"] = ", ".join(dict.fromkeys(known))
    return settings_from_tree(tree, "diagnosis"), changed, missing


def written_config(found: Found, settings: Settings, source: Path | None) -> str:
    """Return the config of :func:`completed` as an annotated file that says what was changed."""
    made, changed, missing = completed(found, settings)
    given = f"Completes {source.name}." if source else "Based on the paper's EHA."
    lines = [" ".join(line.split()) for line in (
        f"Written by eha_monitor {__version__}, diagnose of {', '.join(found.bags)}.", given)]
    lines += ["Changed keys:", *_indented(changed), *wrap(NOTE, _WIDTH)] if changed else [
        f"No key is changed: the verdict is {found.verdict}."]
    lines += ["Found, but not in this config:", *_indented(missing)] if missing else []
    return annotated(made, "\n".join(lines))


SAME = 1e-4  # of a number: by less it is the config's


def _indented(points: list[str]) -> list[str]:
    """Return points of a list as lines of a file's head; names of bags may hold line breaks."""
    return [line for point in points for line in wrap(
        point, _WIDTH, initial_indent="  ", subsequent_indent="    ", break_long_words=False)]


def _corrected_numbers(found: Found, settings: Settings, rig: dict, missing: list[str]
                       ) -> list[str]:
    """Put the found numbers into the tree of the rig; return what was changed, in words."""
    findings = {finding.key: finding for finding in (*found.rig_data, *found.rig_within)}
    values, refused = corrected(settings.rig, fitted_numbers(found, settings.rig) | {
        key: finding.found.value for key, finding in findings.items()})
    missing += [f"rig.{key}: {why}" for key, why in refused.items()]
    rig.update(values)
    lines = []
    for key, value in values.items():
        if key in findings and value == rounded(findings[key].found.value):
            before, now = words.rig_values(findings[key])
            lines.append(f"rig.{key}: {now}, was {before}"
                         f"{words.in_brackets(findings[key].probability)}")
        else:
            lines.append(f"rig.{key}: {value:g}, was {getattr(settings.rig, key):g}; " + (
                "makeup_conductance is a part of leakage" if value == rig["leakage"]
                and key == "makeup_conductance" else "as fitted, within its tolerance"))
    return lines


def fitted_numbers(found: Found, rig: Rig) -> dict[str, float]:
    """Return the numbers of the rig that the last model was fitted with, key -> SI.

    What the config gives both chambers alike stays so.
    """
    if found.fitted is None:
        return {}
    values = {}
    for name, value in zip(found.fitted.names, found.fitted.values, strict=True):
        owner, _, key = name.partition(".")
        if owner == "rig" and abs(value / getattr(rig, key) - 1.0) > SAME:
            values[key] = float(value)
    for pair in (("area_1", "area_2"), ("volume_1", "volume_2")):
        if getattr(rig, pair[0]) == getattr(rig, pair[1]) and any(key in values for key in pair):
            both = [values.get(key, getattr(rig, key)) for key in pair]
            values |= dict.fromkeys(pair, 0.5 * sum(both))
    return values


def _named_physics(found: Found, tree: dict, missing: list[str]) -> list[str]:
    """Put the named effects into the tree; return what was changed, in words."""
    given = {name: values for name, values in tree["effects"].items() if not is_own(values)}
    tree["effects"] = {name: values if is_own(values) else {
        key: rounded(value) for key, value in values.items() if math.isfinite(value)}
        for name, values in found.config_effects.items() if name in CATALOGUE or is_own(values)}
    reasons = words.not_in_config(found)
    for effect in found.effects:
        if effect.name in reasons:
            when = words.interval_words(effect.intervals_s)
            missing.append(f"{effect.name}: {_sizes(effect)}{f' at {when}' if when else ''}; "
                           f"{reasons[effect.name]}")
    names = [effect.name for effect in found.effects if effect.name in tree["effects"]]
    lines = [f"effects: {', '.join(names)}"] if names else []
    lines += [f"effects.{name}.{key}: {value:g}, was {was:g}"
              for name, before in given.items() if name not in names
              for key, was in before.items()
              if (value := tree["effects"].get(name, {}).get(key, was)) != was]
    return lines + [f"effects, learned: {term.statement}" for term in found.learned]
