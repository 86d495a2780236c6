"""``advise`` in Python: what a recording leaves open, and the cheapest motion that settles it."""

import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from eha_monitor.api.common import READING, Progress, Record, calling, chosen, frame_of, reporter
from eha_monitor.api.config import Config
from eha_monitor.api.read import (
    Several,
    checked,
    config_for,
    distinct,
    recordings_of,
    several,
)
from eha_monitor.compiled import load_runtime
from eha_monitor.mismatch.advise.advice import advise as run
from eha_monitor.mismatch.advise.identifiability import Confusion, DetectionLimit, Known
from eha_monitor.mismatch.advise.motions import Motion, excitation_tree
from eha_monitor.mismatch.advise.separate import Advice as Found
from eha_monitor.mismatch.advise.separate import Doubt
from eha_monitor.mismatch.advise.words import motion_sentence, sentences
from eha_monitor.output import finite
from eha_monitor.quantity import SYMBOLS, in_units, number, rig_motion, with_uncertainty
from eha_monitor.recordings.recording import ChannelFinding
from eha_monitor.settings.load import annotated, settings_from_tree
from eha_monitor.settings.monitor import Settings
from eha_monitor.words import effect_words, listed

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure

SCHEMA = "eha_monitor/advice/1"


def advise(recordings: Several, config: Config | str | os.PathLike | dict | None = None, *,
           check: bool = True, progress: Progress = False) -> "Advice":
    """Say what recordings can and cannot distinguish, and which motion would, cheaply.

    Parameters
    ----------
    recordings : Recording, path, or list of them
        Of one rig; paths are read with the config.
    config : Config, path, mapping or None
        The rig; without it what the first recording was read or simulated with, and of a path
        the paper's EHA.
    check : bool
        Put the proposed motion to a simulation with noise.
    progress : bool or callable
        True: a line on the standard error; a function is called with (text, share from 0 to 1).

    Returns
    -------
    Advice
        The answer of the command ``advise``.

    Raises
    ------
    InputError
        One line: what is wrong with a recording or the config, or that nothing moves.
    ImplausibleError
        If a recording's channels contradict the config (signs, units, swapped channels).

    Examples
    --------
    >>> ramps = {"kind": "triangle", "amplitude": "20 mm", "frequency": "0.25 Hz",
    ...          "duration": "4 s"}
    >>> slow = em.simulate(em.Config(simulation={"excitation": {"ramps": ramps}}), seed=1)
    >>> a = em.advise(slow, check=False)  # at one speed B and dry friction are one force
    >>> a.doubts[0].effect, a.doubts[0].parameter, a.motion.words
    ('coulomb_friction', 'B', 'a sine of 2 Hz')
    """
    with calling():
        given = several(recordings, "recordings")
        config = config_for(recordings, config, "recordings")
        distinct(given)
        say = reporter(progress)
        say("reading", 0.0)
        load_runtime()
        read = recordings_of(given, config, "recordings")
        read, channels = checked(read, config.settings)
        with rig_motion(config.rig.motion):
            named, found = run(read, config.settings, bool(check), lambda text, share: say(
                text, READING + (1 - READING) * share))
            found = in_units(found)
        say("advised", 1.0)
    return Advice(**vars(found), config=config, bags=tuple(one.source for one in read),
                  named=named, channels=channels)


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Advice(Record, Found):
    """What :func:`advise` found; SI, of a rig that turns in rad and N·m.

    Attributes
    ----------
    confusions : tuple of Confusion
        B or beta_e and an effect that take one another's part; :class:`Confusion`.
    doubts : tuple of Doubt
        Questions that the recording leaves open; :class:`Doubt`.
    motion : Motion or None
        The cheapest motion that settles them: name, words, segments, duration (s); or None.
    config : Config
        What it was made with.
    bags : tuple of str
        What the recordings are called.
    named : tuple of str
        Effects that stand in the model beside B and beta_e.
    channels : tuple of ChannelFinding
        What the channels say of the config where it may be wrong.
    """

    config: Config
    bags: tuple[str, ...]
    named: tuple[str, ...]
    channels: tuple[ChannelFinding, ...]

    @property
    def sentences(self) -> tuple[str, ...]:
        """What the recording distinguishes and leaves open, and what to record, in sentences."""
        with rig_motion(self.config.rig.motion):
            return tuple(sentences(self))

    @property
    def parameters(self) -> tuple[Known, ...]:
        """The fitted parameters, and with what each is confused most; :class:`Known`."""
        return self.known

    @property
    def visible_from(self) -> tuple[DetectionLimit, ...]:
        """From which size on each effect shows in this recording; :class:`DetectionLimit`."""
        return self.detection_limits

    def excitation(self) -> Config | None:
        """Return the config with the proposed motion, as ``--write-excitation`` does.

        Returns
        -------
        Config or None
            ``simulate`` runs the motion; None where none is proposed.
        """
        return None if self.motion is None else Config.of(
            excited(self.motion, self.config.settings))

    def to_dict(self) -> dict[str, Any]:
        """Return the answer as JSON's plain types.

        Returns
        -------
        dict
            What ``eha-monitor advise --json`` writes (schema ``eha_monitor/advice/1``).

        Examples
        --------
        >>> a.to_dict()["schema"]
        'eha_monitor/advice/1'
        """
        motion = self.motion
        with rig_motion(self.config.rig.motion):
            shown = None if motion is None else {
                "name": motion.name, "words": motion_sentence(motion),
                "duration_s": motion.duration, "excitation": excitation_tree(motion)}
        return finite({
            "schema": SCHEMA, "bag": ", ".join(self.bags), "named": self.named,
            "advice": self.sentences, "parameters": self.known, "plateaus": self.plateaus,
            "confusions": self.confusions, "visible_from": self.detection_limits,
            "groups": self.groups, "doubts": self.doubts, "motion": shown,
            "considered": self._considered(), "checks": self.checks,
            "channels": self.channels})

    def to_frame(self, table: str = "visible_from") -> "pandas.DataFrame":
        """Return a table of the answer.

        Parameters
        ----------
        table : str
            ``visible_from`` (a row for each effect), ``parameters``, ``confusions``, ``doubts``
            or ``considered`` (the motions that were tried, with log units for each doubt).

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
        >>> a.to_frame("parameters").index[:2].tolist()
        ['B', 'beta_e']
        """
        return chosen(table, {
            "visible_from": lambda: frame_of(
                map(asdict, self.visible_from),
                ("effect", "symbol", "unit", "matters", "visible", "gain", "shifts"), "effect"),
            "parameters": lambda: frame_of(
                map(asdict, self.parameters),
                ("name", "value", "stddev", "unit", "inflation", "correlation", "most_with"),
                "name"),
            "confusions": lambda: frame_of(
                map(asdict, self.confusions), tuple(Confusion.__dataclass_fields__), "parameter"),
            "doubts": lambda: frame_of(
                map(asdict, self.doubts), tuple(Doubt.__dataclass_fields__), "effect"),
            "considered": lambda: frame_of(
                self._considered(), ("name", "duration_s", "log_units"), "name")}, "table")()

    def plot(self) -> "Figure":
        """Draw the proposed motion: demanded position against time.

        Returns
        -------
        matplotlib.figure.Figure
            A notebook shows it; without a motion it says so.
        """
        from eha_monitor.reports.api_figures import motion_drawing

        with rig_motion(self.config.rig.motion):
            shown = None if self.motion is None else (self.motion.segments,
                                                      motion_sentence(self.motion))
        return motion_drawing(shown, self.config.rig.motion)

    def _considered(self) -> list[dict]:
        return [{"name": one.motion.name, "duration_s": one.motion.duration,
                 "log_units": one.gains} for one in self.tried]

    def _short(self):
        return (listed(self.bags), named_words(self), HEADS, parameter_rows(self), self.sentences)


HEADS = ("parameter", "value", "variance inflation", "most correlated with")


def named_words(found: Advice) -> str:
    """Return which effects stand in the model."""
    named = listed([effect_words(name) for name in found.named])
    return f"named beside B and βe: {named or 'nothing'}"


def parameter_rows(found: Advice) -> list[list[str]]:
    """Return a row for B, beta_e and each parameter of the named effects, under ``HEADS``."""
    return [[SYMBOLS.get(one.name, one.name), with_uncertainty(one.value, one.stddev, one.unit),
             number(one.inflation, 3), f"{one.most_with} ({number(one.correlation, 3)})"]
            for one in found.known if one.name in ("B", "beta_e")
            or one.name.partition(".")[0] in found.named]


def excited(motion: Motion, settings: Settings) -> Settings:
    """Return the config with the motion as its ``simulation.excitation``."""
    tree = settings.model_dump()
    tree["simulation"]["excitation"] = excitation_tree(motion)
    return settings_from_tree(tree, "advice")


def written_excitation(motion: Motion, settings: Settings, bags: Sequence[str | Path]) -> str:
    """Return the config with the motion as its ``simulation.excitation``, an annotated file."""
    given = ", ".join(map(str, bags))
    title = " ".join(f"Written by advise of {given}: its simulation.excitation is "
                     f"{motion_sentence(motion)}.".split())
    return annotated(excited(motion, settings), title)
