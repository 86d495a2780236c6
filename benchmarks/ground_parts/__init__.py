"""What the grounds of ``benchmarks/grounds.py`` share: how they are run, truth beside answer."""

from dataclasses import dataclass
from pathlib import Path

from eha_monitor.concealed.cases import Case
from eha_monitor.prove.trial import Question, Trial, read_json


@dataclass(frozen=True)
class Ground:
    """How a ground is run; the meaning is that of :class:`eha_monitor.prove.trial.Trial`.

    ``cases`` 0 takes the ground's own number.
    """

    work: Path
    seed: int = 1
    cases: int = 0
    jobs: int = 0

    def trial(self, cases: tuple[Case, ...], questions: tuple[Question, ...] = (),
              **more) -> Trial:
        """Return the trial of some recordings."""
        return Trial(cases, self.seed, self.work, False, self.jobs,
                     questions=questions, **more)


def answer_of(work: Path, name: str) -> dict:
    """Return the answer to a question of the trial in ``work``, empty where there is none."""
    return read_json(work / "answers" / f"{name}.json") or {}


def after_of(answer: dict, name: str) -> dict | None:
    """Return B or beta_e with the named physics, None where an answer has none."""
    return answer.get("parameters", {}).get("after", {}).get(name)


def said_of(answer: dict, effect: str, symbol: str, added: float = 0.0) -> dict | None:
    """Return what an answer says of a parameter, None where it does not name the effect.

    An effect that has it in its declared class, and a parameter of the same name, stands for it.

    Parameters
    ----------
    added : to the value, in its unit.
    """
    for one in answer.get("effects", ()):
        if effect in (one["name"], *one["indistinguishable_from"]) and symbol in one["parameters"]:
            value = one["parameters"][symbol]
            return {**value, "value": value["value"] + added}
    return None


def compared_row(group: str, name: str, true: float, said: dict | None, aim: float) -> dict:
    """Return a parameter's truth and answer; ``aim`` is the relative error allowed, 0 for none."""
    value = (said or {}).get("value")
    sigma = (said or {}).get("stddev") or 0.0
    error = None if value is None or not true else float(abs(value / true - 1.0))
    return {"group": group, "name": name, "true": true, "said": value, "stddev": sigma,
            "unit": (said or {}).get("unit", ""), "relative": error, "aim": aim,
            "within": error is not None and bool(error <= aim)}
