"""A ground of the proof: the second published EHA, in its three states.

The plant is the independent one with the published numbers; docs/proof.md says what the nominal
config holds.  Besides the blind diagnoses a linear model is fitted, to show what it makes of the
friction that it lacks.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from eha_monitor.concealed.cases import SAMPLE_TIME, Case, triangle
from eha_monitor.concealed.generate import nominal_config, recording_of
from eha_monitor.prove.trial import prove
from ground_parts import (
    Ground,
    after_of,
    answer_of,
    compared_row,
    said_of,
)

# McMaster (Gadsden, Habibi): friction a2 v + (a1 v^2 + a3) sgn v, leakage L dp + Q_L0 sgn dp.
MCMASTER_RIG = {
    "A": 1.52e-3, "D_p": 5.57e-7, "M": 7.376, "V": 1.08e-3, "beta_e": 2.07e8,
    "K_pos": 22000.0, "C_T": 5e-13, "p_charge": 8e6,
}
MCMASTER = {  # L, Q_L0, a1, a2, a3 in SI
    "normal": (4.78e-12, 2.41e-6, 6.589e4, 2.144e3, 436.0),
    "leakage": (6.01e-11, 1.47e-5, 6.589e4, 2.144e3, 436.0),
    "friction": (4.78e-12, 2.41e-6, 4.462e6, 1.863e4, 551.0),
}
CLOSE = 0.1
PUMP_SPEED = 100.0  # rad/s of the published linear fits
PERIOD, SECONDS = 4.0, 24.0
PUBLISHED = {"triangle": 16457.0, "sine": 19343.0}  # N s/m, of the normal state
STATES = tuple(MCMASTER)


def prove_mcmaster(ground: Ground, announce: Callable[[str], None],
                   say: Callable[[str, float], None]) -> dict:
    """Run the trial on the published plant; ``ground.cases`` counts recordings, three a round."""
    cases = tuple(case_of(i, ground.seed) for i in range(ground.cases or len(STATES)))
    found = prove(ground.trial(cases), announce, say)
    ratios = [row for case in cases for row in parameters(case, ground.work)]
    fits = [linear_fit(shape) for shape in PUBLISHED]
    good = sum(row["within"] for row in ratios if row["aim"])
    facts = [f"a linear fit reads B = {fit['B']:.0f} N·s/m on a {fit['motion']} at "
             f"{PUMP_SPEED:.0f} rad/s of the pump; the literature has {fit['published']:.0f}, and "
             f"{MCMASTER['normal'][3]:.0f} is true" for fit in fits]
    facts.append(f"{good} of {sum(row['aim'] > 0 for row in ratios)} parameters (a1, a2, a3, L, "
                 f"Q_L0) within {CLOSE:.0%} after the diagnosis")
    return {**found, "facts": facts, "parameters": ratios}


def case_of(i: int, seed: int) -> Case:
    """Return the i-th recording: the states in turn, each round with another motion."""
    state = STATES[i % len(STATES)]
    case = mcmaster_case(state, seed=seed + i)
    return replace(case, name=f"m{i + 1:02d}_{state}")


def mcmaster_case(state: str, *, motion: str = "rich", seed: int = 0,
                  demand: np.ndarray | None = None) -> Case:
    """Return the second published EHA in one of its states.

    The nominal config has viscous friction alone, a2 of the normal state, and the leakage of the
    paper's EHA; what is concealed is the rest.  The leakage L of the publication is C_T/2 of the
    config and the concealed one together.

    Parameters
    ----------
    state : ``normal``, ``leakage`` (major) or ``friction`` (major).
    demand : (n,) x_d in m at each sample, in place of the motion.
    """
    leak, offset, a_1, a_2, a_3 = MCMASTER[state]
    added = leak - 0.5 * MCMASTER_RIG["C_T"]
    parameters = {"coulomb_friction": {"F_c": a_3}, "quadratic_friction": {"a_1": a_1},
                  "cross_port_leakage": {"L": added}, "leakage_offset": {"Q_0": offset}}
    return Case(f"mcmaster_{state}", tuple((name, 1.0) for name in parameters), motion=motion,
                seed=seed, rig={**MCMASTER_RIG, "B": a_2}, options=parameters, demand=demand,
                nominal={"B": MCMASTER["normal"][3], "beta_e": MCMASTER_RIG["beta_e"]})


def parameters(case: Case, work: Path) -> list[dict]:
    """Return the published parameters of a recording beside what the diagnosis found."""
    answer = answer_of(work, case.name)
    true = {name: next(iter(values.values())) for name, values in case.options.items()}
    base = 0.5 * MCMASTER_RIG["C_T"]
    state = case.name.partition("_")[2]
    return [
        compared_row(state, "a1", true["quadratic_friction"],
                     said_of(answer, "quadratic_friction", "a_1"), CLOSE),
        compared_row(state, "a2", case.rig["B"], after_of(answer, "B"), CLOSE),
        compared_row(state, "a3", true["coulomb_friction"],
                     dry_friction(answer), CLOSE),
        compared_row(state, "L", base + true["cross_port_leakage"],
                     leakage(answer, base), CLOSE),
        compared_row(state, "Q_L0", true["leakage_offset"],
                     said_of(answer, "leakage_offset", "Q_0"), CLOSE),
        compared_row(state, "βe", MCMASTER_RIG["beta_e"], after_of(answer, "beta_e"), 0.0),
    ]


def leakage(answer: dict, base: float) -> dict | None:
    """Return the leakage coefficient that an answer names, m^3/(s Pa).

    More leakage than the config's ``2 * base`` is an effect or a wrong number: one equation.
    """
    wrong = {one["key"]: one["found"] for one in answer.get("rig_data", ())}
    said = said_of(answer, "cross_port_leakage", "L", base)
    return scaled(wrong["leakage"], 0.5) if said is None and "leakage" in wrong else said


def dry_friction(answer: dict) -> dict | None:
    """Return the dry friction that an answer names, N.

    At constant mean pressure pressure friction is the same equation; where the answer declares
    both, its coefficient times the sum of the pressures stands for F_c.
    """
    pressures = 2.0 * MCMASTER_RIG["p_charge"]
    said = said_of(answer, "coulomb_friction", "F_c")
    if said is None and (said := said_of(answer, "coulomb_friction", "mu")) is not None:
        said = scaled(said, pressures)
    return said


def scaled(said: dict, factor: float) -> dict:
    """Return a value and its deviation times a factor."""
    return {**said, "value": factor * said["value"], "stddev": factor * said["stddev"]}


def linear_fit(shape: str, state: str = "normal") -> dict:
    """Return what the monitor's linear model reads as B on a triangle or a sine.

    The piston's speed, or its amplitude, is that of the pump at ``PUMP_SPEED``.
    """
    from eha_monitor.estimation.pipeline import estimate
    from eha_monitor.recordings.recording import Recording
    from eha_monitor.settings.load import settings_from_tree

    speed = PUMP_SPEED * MCMASTER_RIG["D_p"] / MCMASTER_RIG["A"]
    time = np.arange(round(SECONDS / SAMPLE_TIME)) * SAMPLE_TIME
    turn = 2.0 * np.pi / PERIOD
    lag = turn * MCMASTER_RIG["A"] / (MCMASTER_RIG["D_p"] * MCMASTER_RIG["K_pos"])
    demand = (triangle(time, PERIOD, speed * PERIOD / 4.0) if shape == "triangle"
              else speed / turn * np.hypot(1.0, lag) * np.sin(turn * time))
    case = mcmaster_case(state, demand=demand)
    channels, _ = recording_of(case)
    settings = settings_from_tree(nominal_config(case), "McMaster")
    said = estimate(Recording(SAMPLE_TIME, channels, 0, shape), settings).parameters["B"]
    return {"motion": shape, "B": float(said.value), "stddev": float(said.stddev),
            "status": said.status, "published": PUBLISHED[shape]}
