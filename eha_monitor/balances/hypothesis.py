"""The user's hypothesis as one more column of its balance."""

import numpy as np

from eha_monitor.balances.candidates import Candidate
from eha_monitor.balances.course import Course
from eha_monitor.estimation.modelled import contributions_along
from eha_monitor.mismatch.diagnosis import Considered
from eha_monitor.physics import signals as s
from eha_monitor.physics.contributions import N_EFFECTS, N_THETA, new_memory, slot_of
from eha_monitor.physics.effects import NAMES
from eha_monitor.physics.own_term import parsed
from eha_monitor.settings.hypothesis import Hypothesis
from eha_monitor.settings.rig import Rig

BY_HALF = 1.5  # a parameter times this makes a term times this, if the term is linear in it


def candidate_of(hypothesis: Hypothesis, rig: Rig) -> Candidate | None:
    """Return a hypothesis as a candidate, its shape held at the start; None where it is none.

    It needs a parameter in which it is linear: that one is fitted.
    """
    start = {key: one.start for key, one in hypothesis.parameters.items()}
    for key, one in hypothesis.parameters.items():
        if start[key] and _linear(hypothesis, start, key):
            return Candidate(
                hypothesis.name, hypothesis.name, "force" if hypothesis.adds == "force"
                else "flow", one.unit or "1", hypothesis.name.replace("_", " "),
                1 if one.lower >= 0.0 else -1 if one.upper <= 0.0 else 0,
                lambda c, r, key=key: _column(hypothesis, start, key, c, r), symbol=key,
                limit=max(abs(one.lower), abs(one.upper)))
    return None


def untested(hypothesis: Hypothesis) -> Considered:
    """Return why a hypothesis was not tested."""
    return Considered(hypothesis.name, np.nan, (), "these recordings are judged by their "
                      "balances, which test what is proportional to one of its parameters, on one "
                      "recording or two")


def _linear(hypothesis: Hypothesis, start: dict[str, float], key: str) -> bool:
    """Tell whether a term is proportional to a parameter, on some motion."""
    track = np.random.default_rng(0).uniform(-1.0, 1.0, (64, s.N_SIGNALS))
    track[:, s.P1:s.OMEGA] = 1e6 * (2.0 + track[:, s.P1:s.OMEGA])
    one, other = (_made(hypothesis, values, track, 1e-3) for values in (
        start, {**start, key: BY_HALF * start[key]}))
    return bool(np.any(one)) and np.allclose(other, BY_HALF * one, rtol=1e-9)


def _made(hypothesis: Hypothesis, values: dict[str, float], track: np.ndarray, dt: float
          ) -> np.ndarray:
    """Return what a hypothesis contributes along a motion, (n, N_CONTRIBUTIONS)."""
    which = len(NAMES)
    theta, active = np.zeros(N_THETA), np.zeros(N_EFFECTS, dtype=np.bool_)
    theta[slot_of(which)] = parsed(hypothesis.expression).slot(hypothesis.adds, values)
    active[which] = True
    found = np.zeros((len(track), s.N_CONTRIBUTIONS))
    contributions_along(track, dt, 2, theta, active, new_memory(), found)
    return found


def _column(hypothesis: Hypothesis, values: dict[str, float], key: str, course: Course, rig: Rig
            ) -> np.ndarray | None:
    """Return the term along a recording, in its balance, by a parameter of 1; (m,)."""
    c = _made(hypothesis, values, course.track(), course.dt) / values[key]
    if hypothesis.adds == "force":
        return c[:, s.FORCE]
    if not course.has_flow:
        return None
    if hypothesis.adds == "speed":
        return (rig.pump_displacement or 1.0) * c[:, s.SPEED]
    return course.of_filled(c[:, s.FLOW_1], -c[:, s.FLOW_2] * rig.area_1 / rig.area_2)
