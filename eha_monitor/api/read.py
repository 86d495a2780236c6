"""Files to recordings, and what becomes of one that contradicts its config: refused, or mended."""

import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from eha_monitor import __version__
from eha_monitor.api.common import calling
from eha_monitor.api.config import Config, config_of, path_of
from eha_monitor.api.recording import Recording
from eha_monitor.archive.find import find_bags, is_archive
from eha_monitor.errors import InputError
from eha_monitor.estimation import zero
from eha_monitor.plausibility.judge import corrected, plausibility_of
from eha_monitor.recordings.importing import read_table
from eha_monitor.recordings.read import read_recording
from eha_monitor.recordings.recording import SHORTEST_S, ChannelFinding
from eha_monitor.recordings.recording import Recording as Inner
from eha_monitor.settings.load import annotated
from eha_monitor.settings.monitor import Settings

TIME = ("time",)
WAY_OUT = "implausible: warn in the config continues with a warning"
OFFER = f"--write-config FILE writes the config corrected; {WAY_OUT}"


class ImplausibleError(InputError):
    """A recording whose channels contradict its config, so that no answer would mean anything.

    Attributes
    ----------
    channels : tuple of ChannelFinding
        What the channels say: finding, kind, channels, correction.
    corrected : Config or None
        The config with the signs, units and channels that the recording says; None where no
        change of the config would mend it.
    reason : str
        What contradicts, without the ways out of it.
    """

    def __init__(self, reason: str, channels: tuple[ChannelFinding, ...],
                 corrected: Config | None = None, way: str = OFFER,
                 recordings: Sequence[Inner] = ()):
        super().__init__(f"{reason} ({way})")
        self.reason, self.channels, self.corrected, self.way = reason, channels, corrected, way
        self.recordings = tuple(recordings)  # all that were checked; not kept in a pickle

    def __reduce__(self):
        return partial(type(self), way=self.way), (self.reason, self.channels, self.corrected)

    def instead(self, way: str) -> "ImplausibleError":
        """Return it with another way out."""
        return type(self)(self.reason, self.channels, self.corrected, way, self.recordings)


def checked(recordings: Sequence[Inner], settings: Settings
            ) -> tuple[list[Inner], tuple[ChannelFinding, ...]]:
    """Return recordings fit for use, and what their channels say about the config.

    A setpoint is moved to the zero of its position (:mod:`estimation.zero`).  Raises
    ImplausibleError if no answer would be meaningful (exit status 2).
    """
    findings = contradictions(recordings, settings)
    placed = [zero.at_one_zero(one, settings) for one in recordings]
    return [one for one, _ in placed], (
        *findings, *(finding for _, said in placed for finding in said))


def contradictions(recordings: Sequence[Inner], settings: Settings
                   ) -> tuple[ChannelFinding, ...]:
    """Return what each recording's channels say about the config, where an answer is possible.

    Raises ImplausibleError if no answer would be meaningful.
    """
    found: dict[str, ChannelFinding] = {}
    blocking: list[str] = []
    for recording in recordings:
        said = plausibility_of(recording, settings)
        if recording.duration < SHORTEST_S and {f.channels for f in said.findings} != {TIME}:
            continue  # too short to say more of than that its clock is wrong
        found |= {finding.finding: finding for finding in said.findings}
        if said.blocking:
            blocking.append(f"{recording.source}: {said.message}")
    findings = tuple(found.values())
    if not blocking or settings.implausible == "warn":
        return findings
    mended = None
    if any(finding.correction for finding in findings):
        mended = Config.of(corrected(settings, findings))
    raise ImplausibleError("; ".join(blocking), findings, mended, recordings=recordings)


def corrected_config(findings: Sequence[ChannelFinding], settings: Settings,
                     source: Path | None) -> str:
    """Return the config with what the findings correct, as an annotated file."""
    lines = [f"Written by eha_monitor {__version__}: corrects "
             f"{source.name if source else 'the paper EHA'}.",
             *(f"  {finding.finding}" for finding in findings if finding.correction)]
    return annotated(corrected(settings, tuple(findings)), "\n".join(lines))


Given = Recording | str | os.PathLike
Several = Given | Sequence[Given]
TABLES = (".csv", ".tsv", ".txt", ".dat", ".mat", ".csv.gz", ".txt.gz")
_SHOWN = 3  # bags of a folder that an error names
# What of a config decides how a file becomes channels, by the kind of the file.
_READING = {"table": ("table",), "bag": ("channels",)}


def read(path: str | os.PathLike, config: Config | str | os.PathLike | dict | None = None
         ) -> Recording:
    """Read a recording.

    Parameters
    ----------
    path : str or path
        A rosbag2 bag (folder or .mcap file, whole or cut off), or a CSV or MAT file for which
        the config has a ``table`` section.  ``~`` is the home folder.
    config : Config, path, mapping or None
        Its ``channels`` say which topic is which channel, its ``table`` which column, its
        ``rig.sample_time`` the grid; without it the paper's.

    Returns
    -------
    Recording
        Channels on one time grid, SI.

    Raises
    ------
    InputError
        One line: what is not there or cannot be read, and what was expected.

    Examples
    --------
    >>> r = em.read("bags/hidden_friction")
    >>> r.duration, list(r.channels)
    (11.0, ['x', 'x_d', 'omega', 'p1', 'p2'])
    >>> em.read("bags/hiden_friction")
    Traceback (most recent call last):
        ...
    eha_monitor.errors.InputError: bags/hiden_friction: no such bag
    """
    if isinstance(path, Recording):
        raise InputError(f"read: expected a path, got a recording of {path.source or 'arrays'}")
    with calling():
        config = config_of(config)
        place = path_of(path, "a bag, a CSV or a MAT file")
        kind = "table" if _is_table(place) else "bag"
        return Recording.of(inner_of(place, config), config, kind)


def _is_table(path: Path) -> bool:
    return path.name.lower().endswith(TABLES) and not path.is_dir()


def inner_of(path: Path, config: Config) -> Inner:
    """Return what a file holds; a folder of bags is refused, with the names of some."""
    if _is_table(path):
        return read_table(path, config.settings, map_source=config.source or "config")
    if is_archive(path):
        names = [place.name for place in find_bags(path) if not place.problem]
        more = ", ..." if len(names) > _SHOWN else ""
        raise InputError(f"{path}: expected one bag, found a folder of {len(names)}: "
                         f"{', '.join(names[:_SHOWN])}{more}")
    return read_recording(path, config.settings)


def recordings_of(given: Several, config: Config, name: str) -> list[Inner]:
    """Return the inner recordings of the argument ``name``: paths are read, recordings are taken.

    Raises InputError if there is none, or one was read with channels that the config maps
    otherwise.
    """
    return [inner_of(one, config) if isinstance(one, Path) else _fitting(one, config)
            for one in several(given, name)]


def several(given: Several, name: str) -> tuple[Recording | Path, ...]:
    """Return what an argument names, as recordings and paths."""
    many = given if isinstance(given, (list, tuple)) else (given,)
    for one in many:
        if not isinstance(one, (Recording, str, os.PathLike)):
            raise InputError(f"{name}: expected an em.Recording, a path, or a list of them, got "
                             f"{type(one).__name__}; arrays: em.Recording({{'x': x}}, "
                             "sample_time=1e-3)")
    if not many:
        raise InputError(f"{name}: expected at least one recording")
    return tuple(one if isinstance(one, Recording) else path_of(one, "a recording")
                 for one in many)


def config_for(given: Several, config: Any, name: str) -> Config:
    """Return the config of a call: what is given, or what the first recording was read with."""
    if config is None:
        first = several(given, name)[0]
        return first.config or Config() if isinstance(first, Recording) else Config()
    return config_of(config)


def source_of(given: Recording | Path) -> str:
    """Return what errors call a recording."""
    return given.source or "recording" if isinstance(given, Recording) else str(given)


def distinct(recordings: Sequence[Recording | Path], held_out: Recording | Path | None = None,
             references: Sequence[Recording | Path] = (), option: str = "held_out") -> None:
    """Refuse a recording that is given twice, or fitted and kept back (``option``) at once.

    Raises InputError, naming the recording.
    """
    places = [_place(one) for one in (*recordings, *references)]
    for one, place in zip((*recordings, *references), places, strict=True):
        if places.count(place) > 1:
            raise InputError(f"{source_of(one)}: is given twice, expected different recordings")
    if held_out is not None and _place(held_out) in places:
        raise InputError(f"{source_of(held_out)}: {option} names a bag that is fitted, expected "
                         "one that is not")


def _place(one: Recording | Path) -> Any:
    """Return what identifies a recording: where it lies, or itself."""
    return id(one) if isinstance(one, Recording) else one.resolve()


def _fitting(recording: Recording, config: Config) -> Inner:
    """Return the inner recording, if it was read as the config would have it read."""
    first, now = recording.config, config.settings
    for key in _READING.get(recording.kind, ()):
        if first is not None and getattr(first.settings, key) != getattr(now, key):
            raise InputError(f"{source_of(recording)}: was read with another section {key} than "
                             "that of the config: expected em.read(path, config)")
    step, said = recording.sample_time, now.rig.sample_time
    if abs(step - said) > 1e-6 * said:
        raise InputError(f"{source_of(recording)}: has a row every {step:g} s, and the config "
                         f"says rig.sample_time {said:g} s: expected em.read(path, config), or a "
                         f"config with sample_time {step:g} s")
    return recording.inner
