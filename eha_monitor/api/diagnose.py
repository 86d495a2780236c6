"""``diagnose`` in Python: which physics the model left out, where, and the proof."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from eha_monitor.api.calls import Progress, calling, reporter
from eha_monitor.api.config import Config, path_of
from eha_monitor.api.diagnosis import Diagnosis
from eha_monitor.api.indicators import of_diagnosis
from eha_monitor.api.plausible import checked
from eha_monitor.api.read import (
    Given,
    Several,
    config_for,
    distinct,
    recordings_of,
    several,
)
from eha_monitor.api.recording import Recording
from eha_monitor.api.rotary import of_rig
from eha_monitor.archive.find import find_bags, is_archive
from eha_monitor.balances.changed import against
from eha_monitor.balances.machine import load
from eha_monitor.compiled import load_runtime
from eha_monitor.errors import InputError
from eha_monitor.mismatch.compare.compared import compared
from eha_monitor.mismatch.diagnose import diagnose as run
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.settings.hypothesis import Hypothesis, hypothesis_of, load_hypothesis

__all__ = ["Diagnosis", "diagnose"]
READING = 0.03  # share of the progress


def diagnose(recordings: Several, config: Config | str | os.PathLike | dict | None = None, *,
             held_out: Given | None = None, references: Several = (),
             hypothesis: Hypothesis | str | os.PathLike | dict | None = None,
             without: str | Sequence[str] = (), vary: str | Sequence[str] = (),
             machine: str | os.PathLike | None = None, progress: Progress = False) -> Diagnosis:
    """Say where model and recordings differ, which physics that is, and show the fit improve.

    Parameters
    ----------
    recordings : Recording, path, or list of them
        Of one rig, explained together; paths are read with the config.
    config : Config, path, mapping or None
        The nominal rig; its effects count as known.  Without it what the first recording was
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
        True: a line on the standard error; a function is told (text, share from 0 to 1).

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
    'Coulomb friction of 40 N opposes the motion at every speed'
    """
    with calling():
        given, config = several(recordings, "recordings"), config_for(
            recordings, config, "recordings")
        healthy = _unfolded(several(references, "references")) if _any(references) else ()
        unseen = several(held_out, "held_out") if held_out is not None else ()
        if len(unseen) > 1:
            raise InputError(f"held_out: expected one recording, got {len(unseen)}")
        distinct(given, *unseen[:1] or (None,), healthy)
        without = known_effects(without, "without")
        vary = (vary,) if isinstance(vary, str) else tuple(vary)
        if unknown := [name for name in vary if name != "load"]:
            raise InputError(f"vary: {unknown[0]}: expected load")
        known = None if machine is None else load(path_of(machine, "a file with a machine"))
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
        channels = checked([*read, *kept, *references], config.settings)

        def further(text: str, share: float) -> None:
            say(text, READING + (1 - READING) * share)

        if known is not None:
            found = against(known, read, config.settings, known.sources)
        elif references:
            found = compared(read, references, config.settings, further)
        else:
            found = run(read, config.settings, kept[0] if kept else None, further, suspicion,
                        without, vary)
        found = of_rig(found, config.rig.motion)
        say("diagnosed", 1.0)
    return Diagnosis(found, config, (*channels, *found.channels), tuple(
        f"{one.source}: {loss}" for one in read for loss in one.losses),
        of_diagnosis(found, read, config.settings))


def known_effects(names: str | Sequence[str], option: str) -> tuple[str, ...]:
    """Return effects by name, each of them of the catalogue.

    Parameters
    ----------
    option : what the caller calls them.

    Raises
    ------
    InputError
        Naming the first that is none.
    """
    names = (names,) if isinstance(names, str) else tuple(names)
    unknown = [name for name in names if name not in CATALOGUE]
    if unknown:
        raise InputError(f"{option}: {unknown[0]}: expected an effect of the catalogue, "
                         f"e.g. {', '.join(sorted(CATALOGUE)[:3])}")
    return names


def _any(given: Any) -> bool:
    """Tell whether an argument names a recording at all."""
    return not (given is None or (isinstance(given, (list, tuple)) and not given))


def _unfolded(references: Sequence[Recording | Path]) -> tuple[Recording | Path, ...]:
    """Return references with the bags of each folder of bags."""
    found: list[Recording | Path] = []
    for one in references:
        found += bags_of(one) if isinstance(one, Path) else [one]
    return tuple(found)


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
