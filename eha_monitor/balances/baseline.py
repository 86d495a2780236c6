"""Ten lines of least squares: what any recording says of its machine before any search.

    F - known = M x'' + B x' + F_c sgn(x') + F_0                force balance
    A x'  = D_p omega - C_L (p1 - p2) - C_h p'                   flow balance

No answer may contradict these without saying so: they ask for little, use all samples that move,
and cannot be led astray by a search.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from eha_monitor.balances.course import Course
from eha_monitor.balances.least_squares import beside as left_beside
from eha_monitor.balances.least_squares import independent, inverse_of, rms, signed_solution
from eha_monitor.balances.measured import course_of, known_of
from eha_monitor.balances.policy import Policy
from eha_monitor.balances.table import areas_apart, flow_columns
from eha_monitor.balances.together import of_one_machine
from eha_monitor.errors import InputError
from eha_monitor.physics.effects import CATALOGUE, DRY_LAWS
from eha_monitor.physics.parameters import theta_of
from eha_monitor.quantity import share, with_uncertainty
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.monitor import Settings
from eha_monitor.settings.rig import Rig
from eha_monitor.words import effect_words, listed

BLOCK = 1.5  # s: parts that are left out in turn; several correlation times of a residual
FOLDS = 5
SLOW = (0.03, 0.1, 0.3)  # of the top speed, below which friction may rise
BETTER = 4.0  # of the chi-square of one more number: two deviations
VIEWED = ("constant_load", "added_mass")  # beside dry friction: columns of the force balance
UNITS = {"linear": ("kg", "N·s/m", "N"), "rotary": ("kg·m²", "N·m·s/rad", "N·m")}


@dataclass(frozen=True)
class Term:
    """One number of a balance.

    Attributes
    ----------
    name, unit, words : symbol, SI unit and what it is.
    value, stddev : SI; the deviation is infinite where the motion does not determine it.
    at_bound : held at 0 by its sign.
    weight : rms of what it makes, over the standard deviation of the balance's left side.
    """

    name: str
    unit: str
    words: str
    value: float
    stddev: float
    at_bound: bool = False
    weight: float = np.nan

    @property
    def determined(self) -> bool:
        """Whether the recording determines it at all."""
        return bool(np.isfinite(self.stddev)) and not self.at_bound

    def to_dict(self) -> dict:
        """Return the JSON form; null for what is not determined."""
        known = np.isfinite(self.stddev)
        return {"value": self.value if known else None, "stddev": self.stddev if known else None,
                "unit": self.unit, "at_bound": self.at_bound}


@dataclass(frozen=True)
class BalanceFit:
    """Least squares on one balance.

    Attributes
    ----------
    terms : what was fitted.
    samples, effective_samples : compared ones, and how many independent ones they are worth.
    error_share : RMS of what is left over the standard deviation of the balance's left side.
    unseen_share : the same on blocks of ``BLOCK`` s that the fit leaves out; NaN where the motion
        is shorter.
    """

    terms: tuple[Term, ...]
    samples: int
    effective_samples: float
    error_share: float
    unseen_share: float

    def __getitem__(self, name: str) -> Term:
        return next(term for term in self.terms if term.name == name)

    def to_dict(self) -> dict:
        """Return the JSON form."""
        return {"parameters": {term.name: term.to_dict() for term in self.terms},
                "samples": self.samples, "effective_samples": round(self.effective_samples, 1),
                "error_share": self.error_share, "unseen_error_share":
                    self.unseen_share if np.isfinite(self.unseen_share) else None}


@dataclass(frozen=True)
class Baseline:
    """The first view of a recording; a balance that cannot be compared is None, with the reason.

    Attributes
    ----------
    force, flow : the balances.
    missing : reasons, by balance.
    leaning : N, by how much areas that are one tolerance off move a constant load: of each chamber
        its mean pressure force. 0 of a measured force.
    span : m, the lowest and the highest position; NaN where nothing could be compared.
    """

    source: str
    force: BalanceFit | None
    flow: BalanceFit | None
    missing: dict[str, str]
    leaning: float = 0.0
    span: tuple[float, float] = (np.nan, np.nan)

    def to_dict(self) -> dict:
        """Return the JSON form, key ``baseline``."""
        return {"source": self.source, "missing": dict(self.missing),
                **{name: fit.to_dict() if fit else None
                   for name, fit in (("force", self.force), ("flow", self.flow))}}


def baseline(recording: Recording, settings: Settings) -> Baseline:
    """Return what least squares on the balances of a recording gives; it never raises."""
    try:
        course = course_of(recording, settings)
    except InputError as problem:
        return Baseline(recording.source, None, None,
                        dict.fromkeys(("force", "flow"), str(problem)))
    missing: dict[str, str] = {}
    force, flow = force_fit(course, settings.rig, beside(course, settings)), None
    if force is None:
        missing["force"] = "too little motion at a steady direction"
    (course,) = of_one_machine([course], settings.rig)
    columns = flow_columns(course, settings.rig)
    if columns is None:
        missing["flow"] = "needs the channels omega, p1 and p2, and rig.area_1 and area_2"
    else:
        flow = fitted(course, course.counted("flow"), *columns,
                      off=areas_apart(course, settings.rig))
        if flow is None:
            missing["flow"] = "too little motion"
    return Baseline(recording.source, force, flow, missing, leaning(course, settings.rig),
                    (float(np.nanmin(course.x)), float(np.nanmax(course.x))))


def leaning(course: Course, rig: Rig) -> float:
    """Return how far areas that are one tolerance off move a constant load, N."""
    if course.p1 is None or course.p2 is None or not (rig.area_1 and rig.area_2):
        return 0.0
    forces = [area * float(np.mean(p)) * rig.tolerance.log_spread(key) for key, area, p in (
        ("area_1", rig.area_1, course.p1), ("area_2", rig.area_2, course.p2))]
    return float(np.hypot(*forces))


def beside(course: Course, settings: Settings) -> np.ndarray:
    """Return the force of the config's effects that no column of the view stands for, (m,) N.

    A spring that the config knows, or backlash; its dry friction and its load are measured anew.
    """
    kept = {name: values for name, values in settings.effects.items()
            if name not in VIEWED and name not in DRY_LAWS}
    rig = settings.rig
    return known_of(course, rig, *theta_of(rig, kept))["force"] - rig.mass * course.a


def absent_effects(courses: Sequence[Course], baselines: Sequence[Baseline], settings: Settings,
                   policy: Policy) -> tuple[str, ...]:
    """Return which effects of the config make a flow that recordings do not have, a sentence each.

    Least squares on the flow ask for none of them.  Where what one makes of the measured motion,
    beside their columns, is more than ``worse`` of the flow, and more than twice what they leave,
    it is not there: a check valve that opens 0.1 bar too early made 400 ml/min of a healthy press.
    """
    rig, found = settings.rig, []
    asked = {name: values for name, values in settings.effects.items()
             if name in CATALOGUE and CATALOGUE[name].balance == "flow"}
    for course, first in zip(courses, baselines, strict=True):
        view = flow_columns(course, rig) if asked and first.flow is not None else None
        if view is None:
            continue
        bare = known_of(course, rig, *theta_of(rig, {}))["flow"]
        for name, values in asked.items():
            made = known_of(course, rig, *theta_of(rig, {name: values}))["flow"] - bare
            rows = course.in_band(np.column_stack([
                view[0], course.of_filled(*made), *(one[-1] for one in view[1])]))[
                    course.compared(course.counted("flow"))]
            taken = max(float(np.std(rows[:, 0])), 1e-300)
            much = rms(left_beside(rows[:, 1], rows[:, 2:])) / taken
            left = first.flow.error_share
            if much > max(policy.worse, 2.0 * left):
                found.append(
                    f"{effect_words(name)} of the config makes {share(much, 2)} of the flow of "
                    f"{first.source}, where least squares without it leave {share(left, 2)}: "
                    "check its numbers, or leave it out of the config")
    return tuple(found)


def falling(course: Course, slow: float) -> np.ndarray:
    """Return a friction of 1 N at rest that falls over ``slow`` of the top speed, (m,) N."""
    return course.direction * np.exp(-np.abs(course.v) / max(course.speed, 1e-300) / slow)


def force_fit(course: Course, rig: Rig, known: np.ndarray | float = 0.0) -> BalanceFit | None:
    """Return the force balance on samples that move; None where too few do, or it never changes.

    Parameters
    ----------
    known : (m,) N, what else the config knows to act.
    """
    if not course.shows:
        return None
    one, speed = np.ones(len(course)), np.abs(course.v) / max(course.speed, 1e-300)
    inertia, damping, force = UNITS[rig.motion]
    # A load may go with the place: a lever's weight left B 22 to 48 % too large, and sure of it.
    bent = [course.v * speed, course.x - np.mean(course.x),
            *(falling(course, slow) for slow in SLOW)]
    columns = (("M", inertia, "moving mass", 1, course.a),
               ("B", damping, "viscous damping", 1, course.v),
               ("F_c", force, "dry friction", 1, course.direction),
               ("F_0", force, "constant load", 0, one))
    return fitted(course, course.counted("force"), course.force - known, columns, bent)


def fitted(course: Course, counted: np.ndarray, y: np.ndarray, columns: tuple,
           bent: Sequence[np.ndarray] = (), off: Sequence[np.ndarray] = ()) -> BalanceFit | None:
    """Fit columns (name, unit, words, sign, values) to y on the counted samples.

    The standard deviations are those of as many independent samples as the residual has, and
    contain how far a number moves beside each way in which the law may be ``bent``, where that
    fits better.  By what numbers of the config are ``off`` is fitted too,
    (m,) each as large as one deviation, and is no term.
    """
    told = len(columns)
    columns = (*columns, *(("", "", "", 0, column) for column in off))
    names, units, words, signs, values = zip(*columns, strict=True)
    signs, k = np.array(signs), len(names)
    counted = course.compared(counted)
    if counted.sum() < 4 * k:
        return None
    rows = course.in_band(np.column_stack([y, *values]))[counted]
    ways = course.in_band(np.column_stack(bent))[counted].T if len(bent) else ()
    block = (np.flatnonzero(counted) * course.step / BLOCK).astype(int)
    whole = rows.T @ rows
    left, noise, known = np.full(len(counted), np.nan), 0.0, np.arange(1 + told, 1 + k)
    for _ in range(1 + bool(off)):
        whole[known, known] += noise  # as one more sample that says 0, with a deviation of 1
        w = signed_solution(whole[1:, 1:], whole[1:, 0], signs)
        left[counted] = rows[:, 0] - rows[:, 1:] @ w
        correlated = independent(left)
        effective = max(counted.sum() / correlated, k + 1.0)
        spread = float(np.nanmean(left**2)) * effective / max(effective - k, 1.0)
        noise = spread * correlated
    held = (signs != 0) & (w == 0.0)
    variance = np.full(k, 0.0)
    free = np.flatnonzero(~held)
    variance[free] = np.diag(inverse_of(whole[1:, 1:][np.ix_(free, free)])) * noise
    unknown = ~np.isfinite(np.diag(inverse_of(whole[1:, 1:])))
    alone = noise / np.maximum(np.diag(whole)[1:], 1e-300)
    shift = np.zeros(k)
    for way in ways:
        more = np.column_stack([rows, way])
        gram = more.T @ more
        other = signed_solution(gram[1:, 1:], gram[1:, 0], np.append(signs, 0))
        better = float(gram[0, 0] - other @ gram[1:, 0])
        if better < (1.0 - BETTER / effective) * float(np.nansum(left**2)):
            shift = np.maximum(shift, np.abs(other[:k] - w))
    variance[free] += shift[free] ** 2
    stddev = np.sqrt(np.where(unknown, np.inf, np.where(held, alone, variance)))
    size = max(float(np.std(rows[:, 0])), 1e-300)
    weights = np.abs(w) * np.sqrt(np.mean(rows[:, 1:] ** 2, axis=0)) / size
    unseen, compared = [], 0
    for fold in range(FOLDS):
        out = block % FOLDS == fold
        if not out.any() or out.all():
            continue
        part = whole - rows[out].T @ rows[out]
        other = signed_solution(part[1:, 1:], part[1:, 0], signs)
        compared += int(out.sum())
        unseen.append(np.sum((rows[out, 0] - rows[out, 1:] @ other) ** 2))
    return BalanceFit(
        tuple(Term(*one) for one in zip(
            names, units, words, w.tolist(), stddev.tolist(), held.tolist(), weights.tolist(),
            strict=True))[:told],
        int(counted.sum()), float(effective), float(np.sqrt(np.nanmean(left**2)) / size),
        float(np.sqrt(np.sum(unseen) / compared) / size) if compared else float("nan"))


def sentence(fit: BalanceFit) -> str:
    """Return a balance in one line: what is determined, and what share stays open."""
    known = [f"{term.words} {with_uncertainty(term.value, term.stddev, term.unit)}"
             for term in fit.terms if term.determined]
    absent = [term.words for term in fit.terms if term.at_bound and np.isfinite(term.stddev)]
    open_ = [term.words for term in fit.terms if not np.isfinite(term.stddev)]
    parts = [", ".join(known)] if known else []
    parts += [f"no {listed(absent, 'or')}"] if absent else []
    parts += [f"{listed(open_)} not determined"] if open_ else []
    left = fit.unseen_share if np.isfinite(fit.unseen_share) else fit.error_share
    return f"{'; '.join(parts)}; {share(left)} of the balance unexplained"
