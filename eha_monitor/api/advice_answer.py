"""What ``advise`` answers: its JSON, and the config with the proposed motion."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from eha_monitor.api.answer import finite
from eha_monitor.mismatch.advise.motions import Motion, excitation_tree
from eha_monitor.mismatch.advise.separate import Advice
from eha_monitor.mismatch.advise.words import motion_sentence, sentences
from eha_monitor.settings.document import annotated
from eha_monitor.settings.load import settings_from_tree
from eha_monitor.settings.monitor import Settings

SCHEMA = "eha_monitor/advice/1"


def answer(bags: Sequence[str], named: Sequence[str], found: Advice) -> dict:
    """Return the JSON tree; NaN becomes null.

    Parameters
    ----------
    bags : names of the recordings.
    named : effects that stand beside B and beta_e.
    """
    motion = found.motion
    return finite({
        "schema": SCHEMA, "bag": ", ".join(bags), "named": named,
        "advice": sentences(found),
        "parameters": [asdict(one) for one in found.known],
        "plateaus": found.plateaus,
        "confusions": [asdict(one) for one in found.confusions],
        "visible_from": [asdict(one) for one in found.sights],
        "groups": found.groups,
        "doubts": [asdict(one) for one in found.doubts],
        "motion": None if motion is None else {
            "name": motion.name, "words": motion_sentence(motion), "duration_s": motion.duration,
            "excitation": excitation_tree(motion)},
        "considered": [{"name": one.motion.name, "duration_s": one.motion.duration,
                        "log_units": one.gains} for one in found.tried],
        "checks": [asdict(one) for one in found.checks],
    })


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
