"""A ground of the proof: strangers' rigs, by other equations, each with several recordings.

The rigs are those of :mod:`strangers`: friction by laws that the catalogue
does not have, B that drifts with the oil's temperature, loads that differ between recordings, a
config that ``init`` drafts from data sheets.  Each recording is diagnosed alone, and all of a rig
together.  A name is right within its class: dry friction of another law is dry friction.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from strangers.draw import draw_rig
from strangers.generate import truth_of, write

from eha_monitor.prove.score import SIGMAS
from eha_monitor.prove.trial import Question, prove
from ground_parts import (
    Ground,
    after_of,
    answer_of,
    compared_row,
    said_of,
)

RIGS = 5
TOGETHER = "_all"


@dataclass(frozen=True)
class Strange:
    """One recording: the rig ``i`` of a seed in its setting ``place``."""

    name: str
    seed: int
    i: int
    place: int


def prove_strangers(ground: Ground, announce: Callable[[str], None],
                    say: Callable[[str, float], None]) -> dict:
    """Run the trial on strangers' rigs; ``ground.cases`` counts rigs."""
    cases, questions = (), ()
    for i in range(ground.cases or RIGS):
        rig = draw_rig(ground.seed, i)
        mine = tuple(Strange(f"{rig.name}_{setting.name}", ground.seed, i, place)
                     for place, setting in enumerate(rig.settings))
        names = tuple(case.name for case in mine)
        cases += mine
        questions += (*(Question(name, (name,)) for name in names),
                      Question(rig.name + TOGETHER, names))
    found = prove(ground.trial(cases, questions, conceal=conceal), announce, say)
    truths = {case.name: truth(case) for case in cases}
    ratios = [row for question in questions
              for row in parameters(question, truths, ground.work)]
    facts = []
    for words, together in (("alone", False), ("together", True)):
        rows = [row for row in found["rows"] if row["case"].endswith(TOGETHER) == together]
        own = [row for row in ratios if row["group"].endswith(TOGETHER) == together
               and row["inside"] is not None]
        good = sum(row["within_class"] for row in rows)
        inside = sum(row["inside"] for row in own)
        facts.append(f"{words}: {good} of {len(rows)} answers name what is there, within its "
                     f"class, and nothing else; {inside} of {len(own)} of B and the named sizes "
                     f"inside ± {SIGMAS:g} standard deviations")
    return {**found, "facts": facts, "parameters": ratios}


def conceal(case: Strange, folder: Path) -> dict:
    """Write a recording and its config; returns its entry in the key."""
    rig = draw_rig(case.seed, case.i)
    write(rig, rig.settings[case.place], folder, case.seed + case.place)
    return truth(case)


def truth(case: Strange) -> dict:
    """Return what is true of a recording, as a key has it."""
    rig = draw_rig(case.seed, case.i)
    setting = rig.settings[case.place]
    return {**truth_of(rig, setting), "motion": setting.motion.kind, "noise": 1.0,
            "channels": ["x", "x_d", "omega", "p1", "p2", "temperature"], "seed": case.seed}


def parameters(question: Question, truths: dict[str, dict], work: Path) -> list[dict]:
    """Return B and the sizes of the effects beside what one answer says, and whether it holds.

    B holds where it is inside its ± of any value that B had: it drifts, and differs with the oil.
    """
    answer = answer_of(work, question.name)
    mine = [truths[name] for name in question.bags]
    said = after_of(answer, "B")
    spans = [value for one in mine for value in one["B_span"]]
    rows = [_row(question.name, "B", mine[0]["B"], said, min(spans), max(spans))]
    for one in mine[0]["effects"]:
        for symbol, value in one["parameters"].items():
            others = [other["parameters"].get(symbol, value) for each in mine
                      for other in each["effects"] if other["name"] == one["name"]]
            named = said_of(answer, one["name"], symbol)
            if value and named is not None:
                rows.append(_row(question.name, f"{one['name']}.{symbol}", value, named,
                                 min(others), max(others)))
    return rows


def _row(group: str, name: str, true: float, said: dict | None, low: float, high: float) -> dict:
    row = compared_row(group, name, true, said, 0.0)
    reach = SIGMAS * row["stddev"]
    return {**row, "inside": None if row["said"] is None else bool(
        low - reach <= row["said"] <= high + reach)}
