"""A ground of the proof: the mismatch concealed inside a parameter.

On the paper's own triangle Coulomb friction reads as viscous friction: the plateaus are fitted
perfectly and B is wrong.  ``advise`` is to say so, by how much, and which second motion decides.
That motion is then recorded on the same rig, and both recordings are diagnosed together.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from eha_monitor.concealed.cases import SAMPLE_TIME, Case
from eha_monitor.concealed.generate import write_case
from eha_monitor.physics.simulator import demanded_position, total_duration
from eha_monitor.prove.trial import Question, answer, begin, made, opened, result, seal
from eha_monitor.settings.rig import Segment
from ground_parts import (
    Ground,
    after_of,
    answer_of,
    compared_row,
    said_of,
)

SPEED = 0.04  # m/s of the paper's triangle
CLOSE = 0.05  # of F_c and of B with the second recording
DECISIVE = 20.0  # log units
COULOMB = "coulomb_friction"
RIGS = 3
CONFUSED = 0.999  # correlation of what cannot be distinguished
SHIFT_CLOSE = 0.05


def prove_triangle(ground: Ground, announce: Callable[[str], None],
                   say: Callable[[str, float], None]) -> dict:
    """Run the trial on the paper's triangle; ``ground.cases`` counts rigs."""
    triangles = tuple(triangle_case(i, ground.seed) for i in range(ground.cases or RIGS))
    unseen = tuple(replace(case, name=f"{case.name}_unseen", motion="short", seed=case.seed + 1)
                   for case in triangles)
    trial = ground.trial((*triangles, *unseen), tuple(
        Question(f"{case.name}_advice", (case.name,), "advise") for case in triangles))
    begin(trial)
    made(trial, lambda text, share: say(text, 0.05 * share))
    sealed = seal(trial)
    announce(f"sealed key: SHA-256 {sealed}")
    answer(trial, lambda text, share: say(text, 0.05 + 0.4 * share), "asking for advice")
    advice = {case.name: answer_of(ground.work, f"{case.name}_advice")
              for case in triangles}
    questions = [Question(case.name, (case.name,)) for case in triangles]
    for case in triangles:  # as the advice has it, on the rig that was sealed
        if advice[case.name].get("motion"):
            second = replace(case, name=f"{case.name}_second", seed=case.seed + 2,
                             demand=demanded(advice[case.name]["motion"]["excitation"]))
            write_case(second, ground.work / "recordings")
            questions.append(Question(f"{case.name}_both", (case.name, second.name),
                                      held_out=f"{case.name}_unseen"))
    diagnoses = replace(trial, questions=tuple(questions))
    answer(diagnoses, lambda text, share: say(text, 0.45 + 0.55 * share))
    found = result(diagnoses, opened(trial, sealed), sealed)
    rows = [judged(case, advice[case.name], ground.work) for case in triangles]
    ratios = [row for case in triangles for row in parameters(case, ground.work)]
    return {**found, "facts": facts_of(rows), "parameters": ratios}


def triangle_case(i: int, seed: int) -> Case:
    """Return the i-th rig: the paper's with another B, beta_e and Coulomb friction."""
    rng = np.random.default_rng([seed, i, 41])
    force = float(f"{np.exp(rng.uniform(np.log(8.0), np.log(40.0))):.3g}")
    rig = {"B": round(rng.uniform(450.0, 900.0)), "beta_e": round(rng.uniform(4.5, 8.0), 2) * 1e8}
    return Case(f"t{i + 1:02d}", ((COULOMB, force / 40.0),), motion="triangle",
                seed=int(rng.integers(2**31 - 2)), rig=rig, options={COULOMB: {"F_c": force}})


def demanded(excitation: dict) -> np.ndarray:
    """Return an advised motion as x_d at each sample, m, (n,)."""
    segments = {name: Segment(**one) for name, one in excitation.items()}
    count = round(total_duration(segments) / SAMPLE_TIME)
    return demanded_position(segments, np.arange(count) * SAMPLE_TIME)


def judged(case: Case, advice: dict, work: Path) -> dict:
    """Return what was said of one rig, each beside what is right."""
    force, true = case.options[COULOMB]["F_c"], case.rig["B"]
    said = next((one for one in advice.get("confusions", ()) if one["parameter"] == "B"
                 and one["effect"] == COULOMB), {})
    # By how much B is off for the friction that the answer speaks of: F_c / v0.
    amount, shift = said.get("amount") or 0.0, abs(said.get("plateau_shift") or 0.0)
    both = answer_of(work, f"{case.name}_both")
    motion = advice.get("motion") or {}
    gain = max((one["then"] or 0.0 for one in advice.get("doubts", ())
                if one["effect"] == COULOMB and one["parameter"] == "B"), default=0.0)
    return {
        "case": case.name, "F_c": force, "B": true, "plateau_B": true + force / SPEED,
        "linear_B": linear_fit(case, work), "correlation": abs(said.get(
            "plateau_correlation") or 0.0), "amount": amount, "shift": shift,
        "shift_right": amount > 0 and abs(shift * SPEED / amount - 1.0) < SHIFT_CLOSE,
        "motion": motion.get("words", ""), "gain": gain, "decides": gain >= DECISIVE,
        "named": [one["name"] for one in both.get("effects", ())],
        "verdict": both.get("verdict", ""),
        "F_c_said": said_of(both, COULOMB, "F_c"),
        "B_said": after_of(both, "B"),
        "data": both.get("fit", {}).get("data", ""),
    }


def linear_fit(case: Case, work: Path) -> float:
    """Return B as the monitor's linear model reads it from the triangle, N s/m."""
    from eha_monitor.estimation.pipeline import estimate
    from eha_monitor.recordings.read import read_recording
    from eha_monitor.settings import load_settings

    settings = load_settings(work / "recordings" / f"{case.name}.yaml")
    recording = read_recording(work / "recordings" / case.name, settings)
    return float(estimate(recording, settings).parameters["B"].value)


def parameters(case: Case, work: Path) -> list[dict]:
    """Return B and F_c beside what the triangle alone and both recordings gave."""
    rows = []
    for name, words in ((case.name, "triangle"), (f"{case.name}_both", "both")):
        said = answer_of(work, name)
        aim = CLOSE if words == "both" else 0.0
        group = f"{case.name}, {words}"
        rows += [compared_row(group, "F_c", case.options[COULOMB]["F_c"],
                              said_of(said, COULOMB, "F_c"), aim),
                 compared_row(group, "B", case.rig["B"], after_of(said, "B"), aim)]
    return rows


def facts_of(rows: list[dict]) -> list[str]:
    """Return what was found, in sentences."""
    count = len(rows)
    facts = [f"{row['case']}: {row['F_c']:.3g} N beside B = {row['B']} N·s/m; a linear fit of the "
             f"triangle reads {row['linear_B']:.0f}, the plateaus alone {row['plateau_B']:.0f}; "
             f"advised: {row['motion'] or 'no motion'}" for row in rows]
    confused = sum(row["correlation"] > CONFUSED and row["shift_right"] for row in rows)
    decided = sum(row["decides"] for row in rows)
    named = sum(row["named"] == [COULOMB] and row["verdict"] == "mismatch" for row in rows)
    return [
        f"{confused} of {count}: the advice says that the plateaus cannot distinguish B from "
        f"Coulomb friction, and by how much B may be off (F_c / v0 within {SHIFT_CLOSE:.0%})",
        f"{decided} of {count}: it names a second motion that decides",
        f"{named} of {count}: both recordings together name Coulomb friction and nothing else",
        *facts]
