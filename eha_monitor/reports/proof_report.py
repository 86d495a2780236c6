"""The result of ``prove`` as a page, with every miss and its picture."""

from pathlib import Path

import numpy as np

from eha_monitor.mismatch.diagnosis import Curve as MissingTerm
from eha_monitor.mismatch.diagnosis import Diagnosis, Location, NamedEffect
from eha_monitor.prove.score import MARKS, UNEXPLAINED, number_of, wilson
from eha_monitor.prove.trial import misses, read_json
from eha_monitor.quantity import number
from eha_monitor.reports import figure as fig
from eha_monitor.reports.diagnosis_figures import curve_figure, informative
from eha_monitor.reports.page import Cell, Table, render, table
from eha_monitor.words import effect_words

_RELIABILITY = 470  # pixels of the height of the reliability diagram


def reliability_figure(found: dict) -> fig.Figure | None:
    """Draw the share that was correct against the stated probability, counts below it."""
    if not (bins := found.get("reliability")):
        return None
    said, right, count = (np.array([one[key] for one in bins]) for key in ("said", "right", "n"))
    low, high = wilson(right, count)
    ends = (-0.02, 1.02)
    above = fig.Panel(fig.Side(limits=ends),
                      fig.Side("share that was correct", limits=(-0.04, 1.06)))
    above.add(fig.Curve(np.array([0.0, 1.0]), np.array([0.0, 1.0]),
                        "calibrated: right as often as stated", fig.INK, 1.0, "dot"),
              fig.Curve(said, right, "from stated to actual", fig.ERROR_LINE, 0.0, opacity=0.35,
                        error_width=5.0, y_error=np.maximum([right - said, said - right], 0.0)),
              fig.Curve(said, right, "share that was correct, with its 68 % interval",
                        fig.STAGE_ONE, 0.0, marker="circle", cap=2.5,
                        y_error=np.maximum([right - low, high - right], 0.0)))
    # Most statements are sure ones: on a linear scale the bins between would be invisible.
    below = fig.Panel(fig.Side("stated probability", limits=ends),
                      fig.Side("statements", log=True, limits=(0.6, 6.0 * count.max())))
    below.add(fig.Bars(np.array([0.5 * (one["low"] + one["high"]) for one in bins]), count, 0.092))
    error = found["score"].get("calibration_error")
    words = "" if error is None else f", expected calibration error {100 * error:.1f} %"
    return fig.Figure((above, below), f"how often a statement was correct against its "
                                  f"probability{words}", (3.0, 1.0), (fig.WIDTH, _RELIABILITY))


def missing_term(answer: dict | None) -> fig.Figure | None:
    """Draw the most informative curve of an answer; None where it has none."""
    if not answer or not answer.get("curves"):
        return None

    def numbers(values: list) -> np.ndarray:
        return np.array([np.nan if value is None else value for value in values], dtype=float)

    curves = tuple(MissingTerm(one["balance"], one["against"], one["against_unit"], one["unit"],
                               *(numbers(one[name]) for name in ("x", "measured", "spread",
                                                                 "modelled")))
                   for one in answer["curves"])
    effects = tuple(NamedEffect(one["name"], one["balance"], "", {}, 0.0)
                    for one in answer["effects"])
    said = Diagnosis((), answer["verdict"], "", Location(answer["location"]["balance"], "", ()),
                     effects, {}, {}, "", {}, curves)
    shown = informative(said)
    return curve_figure(said, shown[0]) if shown else None


# ---- the page -----------------------------------------------------------------------------------

GROUPS = {"by_kind": "effects in a recording", "by_rig": "numbers of the config",
          "by_strength": "strength (single effects)",
          "by_motion": "motion", "by_noise": "noise, times the sensors' own",
          "by_channels": "channels"}
MOST_PICTURES = 80  # of misses; each is some 30 kB
_NUMBERS = " | number | number | number | number | number"


def proof_page(found: dict, work: Path | None = None) -> str:
    """Return the report of a trial as HTML text; ``work`` has the curves of the misses."""
    return render(
        "proof.html.j2", title="EHA diagnosis: the concealed-effect trial", facts=_facts(found),
        verdict=verdict(found), marks=marks(found), groups=groups(found),
        reliability=reliability_figure(found),
        effects=effects(found), confusion=confusion(found), misses=_miss_cards(found, work),
        cases=found["cases"])


def percent(value: float | None) -> str:
    """Return a share as text; a dash where nothing was judged."""
    return "—" if value is None else f"{100 * value:.1f} %"


def _facts(found: dict) -> list[tuple[str, str]]:
    """Return the facts at the head of the page."""
    return [("Recordings", str(found["cases"])), ("Seed", str(found["seed"])),
            ("Commit", found["commit"] or "not a checkout"),
            ("SHA-256 of the sealed key", found["sealed_key_sha256"]),
            ("Source of the answers", ", ".join(
                f"{name or 'none'} ({count})" for name, count in found["sources"].items())),
            ("Oracle", "evaluated" if found["oracle"] else "not evaluated"),
            *([("Diagnoses that failed", str(found["failed"]))] if found["failed"] else [])]


def verdict(found: dict) -> tuple[str, str]:
    """Return the colour and the sentence of the first screen."""
    reached = [_reached(found, name) for name in MARKS]
    judged = [one for one in reached if one is not None]
    missed = judged.count(False)
    exact = percent(found["score"].get("exact"))
    return ("warn" if missed else "ok"), (
        f"{exact} of {found['cases']} recordings were named exactly; "
        f"{len(judged) - missed} of {len(judged)} aims that this trial judges were reached.")


def _reached(found: dict, name: str) -> bool | None:
    """Whether a mark reached its aim; None without one, or where the trial does not judge it."""
    (_, _, limit, more), value = MARKS[name], found["score"].get(name)
    if value is None or limit is None:
        return None
    return value >= limit if more else value <= limit


def marks(found: dict) -> Table:
    """Return the marks, each beside its aim; those that no recording of the trial has, last."""
    rows, kinds = [], {True: " good", False: " poor", None: ""}
    for name, (words, aim, _, _) in MARKS.items():
        value = found["score"].get(name)
        kind = kinds[_reached(found, name)]
        rows.append((value is None, (words, Cell(percent(value), f"value{kind}", mark=name), aim)))
    shown = [row for absent, row in rows if not absent]
    absent = [row[0] for lacking, row in rows if lacking]
    return table("mark | reached | aim", shown, " | value | number", "marks",
                 f"Not judged by this trial: {'; '.join(absent)}." if absent else "")


def groups(found: dict) -> list[Table]:
    """Return the shares by kind of case."""
    return [_shares(title, found[key], "within class of these", "detectable_within_class")
            for key, title in GROUPS.items() if found.get(key)]


def effects(found: dict) -> Table:
    """Return the shares by effect."""
    return _shares("effect", found["by_effect"], "found of these", "found", "key", "effects")


def _shares(title: str, rows: dict, last: str, of: str, kind: str = "", key: str = "") -> Table:
    """Return a row for each name; the last column, ``last``, is the share ``of``."""
    return table(f"{title} | cases | exact | within class | detectable | {last}", [
        (name, one["n"], percent(one["exact"]), percent(one["within_class"]), one["detectable"],
         percent(one[of])) for name, one in rows.items()], kind + _NUMBERS, key)


def confusion(found: dict) -> Table:
    """Return what was said of each effect, the right answer apart from the others."""
    rows = []
    for name, said in found["confusion"].items():
        outside = found["by_effect"].get(name, {}).get("outside")
        right = UNEXPLAINED if outside else name
        rows.append((name, sum(said.values()), said.get(right, 0),
                     ", ".join(f"{other} {count}" for other, count in said.items()
                               if other != right)))
    return table("concealed | answers | right | said instead", rows,
                 "key | number | number | message", "confusion")


def _miss_cards(found: dict, work: Path | None) -> list[dict]:
    """Return the misses, the ones with most evidence first."""
    cards = []
    rows = sorted(misses(found), key=lambda row: -sum(
        value or 0.0 for value in row["log_evidence"].values()))
    for place, row in enumerate(rows):
        answer = read_json(work / "answers" / f"{row['case']}.json") if work else None
        right = row["located_right"] or row["kind"] == "null"
        cards.append({
            "case": row["case"],
            "setting": ", ".join([str(row["motion"]), f"noise × {row['noise']:g}",
                                  " ".join(row["channels"] or ())]),
            "facts": [("concealed", "; ".join(truths_of(row)) or "none: a clean recording"),
                      ("said", said_words(row)),
                      ("place", (row["located"] or "nowhere") + ("" if right else " (wrong)")),
                      ("in words", row["message"])],
            "picture": missing_term(answer) if place < MOST_PICTURES else None})
    return cards


def _found_words(row: dict, name: str, evidence: dict) -> str:
    gain = evidence.get(name)
    return ("" if gain is None else f", {number(gain, 3)} log units for an oracle") + (
        ": found" if name in row["pairs"] else "")


def truths_of(row: dict) -> list[str]:
    """Return all that was concealed in words: effects, and rig numbers beyond tolerance."""
    return [*(f"{effect_words(name)} at strength {abs(row['strength'][name]):.3g}"
              + _found_words(row, name, row["log_evidence"]) for name in row["truth"]),
            *(f"{one['key']}: the config says {number(one['configured'], 4)}, "
              f"{number(one['true'], 4)} is true, {abs(one['tolerances']):.2g} tolerances"
              + _found_words(row, number_of(one["key"]), row["rig_evidence"])
              for one in row.get("rig_errors", ()) if one["key"] in row["rig_truth"])]


def said_words(row: dict) -> str:
    """Return what was said, with the declared classes; rig numbers by their names."""
    if not (classes := {**row["classes"], **row.get("rig_classes", {})}):
        return row["verdict"].replace("_", " ")
    named = "; ".join(effect_words(name) + (
        f" (or {', '.join(map(effect_words, rivals))})" if rivals else "")
        for name, rivals in classes.items())
    return named if row["verdict"] == "mismatch" else f"{row['verdict']}, with {named}"
