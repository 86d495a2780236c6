"""The HTML report of ``prove``: marks, detection, confusion, and every miss with its picture."""

from pathlib import Path

from eha_monitor.output import write_text
from eha_monitor.prove.files import read_json
from eha_monitor.prove.numbers import number_of
from eha_monitor.prove.score import MARKS, UNEXPLAINED
from eha_monitor.prove.trial import misses
from eha_monitor.quantity import number, quantity, with_uncertainty
from eha_monitor.reports.ground_figures import parameter_pictures
from eha_monitor.reports.page import render
from eha_monitor.reports.proof_figures import (
    curve_of_all,
    detection_picture,
    missing_term,
    reliability_picture,
)
from eha_monitor.words import effect_words

GROUNDS = {
    "mcmaster": ("The second published EHA", "The independent plant with the published numbers, "
                 "in three states; the nominal config has viscous friction alone and the leakage "
                 "of the paper's EHA."),
    "simulator": ("Recordings of an independent fluid-power simulator", "Read through the import "
                  "path, with sensor noise and resolution added; the key is the simulator's own "
                  "file, opened last."),
    "strangers": ("Rigs of strangers, several recordings each", "Other equations, drawn from a "
                  "seed: friction of other laws, B that drifts with the oil, loads that differ "
                  "between recordings, play, leaks; the config is what init drafts from data "
                  "sheets. Each recording is diagnosed alone, and all of a rig together."),
    "triangle": ("Concealed inside a parameter: the paper's triangle", "Coulomb friction reads "
                 "as viscous friction there. The advice is asked first, the second motion is "
                 "recorded as advised, and both recordings are diagnosed together."),
}
GROUPS = {"by_kind": "effects in a recording", "by_rig": "numbers of the config",
          "by_strength": "strength (single effects)",
          "by_motion": "motion", "by_noise": "noise, times the sensors' own",
          "by_channels": "channels"}
MOST_PICTURES = 80  # of misses; each is some 30 kB


def write_proof_report(path: str | Path, found: dict, work: Path | None = None) -> None:
    """Write the report of a trial as a single HTML file.

    Parameters
    ----------
    path : file to write.
    found : result of :func:`eha_monitor.prove.trial.prove`.
    work : the trial's folder, for the curves of the misses.

    Raises
    ------
    InputError
        If ``path`` cannot be written.
    """
    write_text(path, proof_page(found, work))


def proof_page(found: dict, work: Path | None = None) -> str:
    """Return the report as HTML text."""
    return render(
        "proof.html.j2", title="EHA diagnosis: the concealed-effect trial",
        heading=heading(found), marks=marks(found),
        groups=[{"title": title, "rows": group_rows(found[name])}
                for name, title in GROUPS.items() if found.get(name)],
        pictures=[one for one in (detection_picture(found), curve_of_all(found)) if one],
        units=bool(found["detection_curves"]), reliability=reliability_picture(found),
        effects=effect_rows(found), confusion=confusion_rows(found),
        misses=miss_cards(found, work), cases=found["cases"], ground=ground_of(found))


def ground_of(found: dict) -> dict | None:
    """Return what a ground beside the draws shows; None of the draws."""
    if "ground" not in found:
        return None
    title, words = GROUNDS[found["ground"]]
    return {"title": title, "words": words, "facts": found["facts"],
            "pictures": parameter_pictures(found["parameters"]),
            "rows": [parameter_row(row) for row in found["parameters"]]}


def parameter_row(row: dict) -> dict:
    """Return a parameter as text: recording, name, true, found, error, and whether it is good."""
    unit = row.get("unit", "")
    said = "not named" if row["said"] is None else (
        with_uncertainty(row["said"], row["stddev"], unit))
    return {"group": row["group"], "name": row["name"], "true": quantity(row["true"], unit),
            "said": said, "error": percent(row["relative"]),
            "aim": percent(row["aim"]) if row["aim"] else "",
            "kind": "" if not row["aim"] else "good" if row["within"] else "poor"}


def percent(value: float | None) -> str:
    """Return a share as text; a dash where nothing was judged."""
    return "—" if value is None else f"{100 * value:.1f} %"


def heading(found: dict) -> list[tuple[str, str]]:
    """Return the facts at the head of the page."""
    facts = [("Recordings", str(found["cases"])), ("Seed", str(found["seed"])),
             ("Commit", found["commit"] or "not a checkout"),
             ("SHA-256 of the sealed key", found["sealed_key_sha256"])]
    facts.append(("Source of the answers", ", ".join(
        f"{name or 'none'} ({count})" for name, count in found["sources"].items())))
    facts.append(("Oracle", "asked" if found["oracle"] else "not asked"))
    if found["failed"]:
        facts.append(("Diagnoses that failed", str(found["failed"])))
    return facts


def marks(found: dict) -> list[dict]:
    """Return the rows of the table of marks, each beside its aim."""
    rows = []
    for name, (words, aim, limit, more) in MARKS.items():
        value = found["score"].get(name)
        kind = ""
        if value is not None and limit is not None:
            kind = "good" if (value >= limit if more else value <= limit) else "poor"
        rows.append({"name": name, "words": words, "value": percent(value), "aim": aim,
                     "kind": kind})
    return rows


def group_rows(groups: dict) -> list[dict]:
    """Return the rows of a table by group."""
    return [{"name": name, "n": one["n"], "exact": percent(one["exact"]),
             "within": percent(one["within_class"]), "detectable": one["detectable"],
             "found": percent(one["detectable_within_class"])} for name, one in groups.items()]


def effect_rows(found: dict) -> list[dict]:
    """Return the rows of the table by effect."""
    curves = found["detection_curves"]
    return [{"name": name, "n": one["n"], "exact": percent(one["exact"]),
             "within": percent(one["within_class"]), "detectable": one["detectable"],
             "found": percent(one["found"]),
             "point": f"{curves[name]['point_95']:.2g}" if name in curves else "—"}
            for name, one in found["by_effect"].items()]


def confusion_rows(found: dict) -> list[dict]:
    """Return what was said of each effect, the right answer apart from the others."""
    rows = []
    for name, said in found["confusion"].items():
        outside = found["by_effect"].get(name, {}).get("outside")
        right = UNEXPLAINED if outside else name
        rows.append({"name": name, "n": sum(said.values()), "own": said.get(right, 0),
                     "others": ", ".join(f"{other} {count}" for other, count in said.items()
                                         if other != right)})
    return rows


def miss_cards(found: dict, work: Path | None) -> list[dict]:
    """Return the misses, the ones with most evidence first."""
    cards = []
    rows = sorted(misses(found), key=lambda row: -sum(
        value or 0.0 for value in row["log_evidence"].values()))
    for row in rows:
        answer = read_json(work / "answers" / f"{row['case']}.json") if work else None
        drawn = len(cards) < MOST_PICTURES
        cards.append({
            "case": row["case"], "truth": truths_of(row) or ["none: a clean recording"],
            "said": said_words(row), "message": row["message"],
            "place": row["located"] or "nowhere",
            "place_right": row["located_right"] or row["kind"] == "null",
            "setting": ", ".join([str(row["motion"]), f"noise × {row['noise']:g}",
                                  " ".join(row["channels"] or ())]),
            "picture": missing_term(answer) if drawn else None,
        })
    return cards


def truth_words(row: dict, name: str) -> str:
    """Return a concealed effect in words: name, strength, evidence."""
    words = f"{effect_words(name)} at strength {abs(row['strength'][name]):.3g}"
    gain = row["log_evidence"].get(name)
    if gain is not None:
        words += f", {number(gain, 3)} log units for an oracle"
    return words + (": found" if name in row["pairs"] else "")


def truths_of(row: dict) -> list[str]:
    """Return all that was concealed in words: effects, and rig numbers beyond tolerance."""
    return [*(truth_words(row, name) for name in row["truth"]),
            *(number_words(row, one) for one in row.get("rig_errors", ())
              if one["key"] in row["rig_truth"])]


def number_words(row: dict, one: dict) -> str:
    """Return a rig number that the config has wrong in words, SI."""
    words = (f"{one['key']}: the config says {number(one['configured'], 4)}, "
             f"{number(one['true'], 4)} is true, {abs(one['tolerances']):.2g} tolerances")
    name = number_of(one["key"])
    gain = row["rig_evidence"].get(name)
    if gain is not None:
        words += f", {number(gain, 3)} log units for an oracle"
    return words + (": found" if name in row["pairs"] else "")


def said_words(row: dict) -> str:
    """Return what was said, with the declared classes; rig numbers by their names."""
    classes = {**row["classes"], **row.get("rig_classes", {})}
    if not classes:
        return row["verdict"].replace("_", " ")
    named = "; ".join(effect_words(name) + (
        f" (or {', '.join(map(effect_words, rivals))})" if rivals else "")
        for name, rivals in classes.items())
    return named if row["verdict"] == "mismatch" else f"{row['verdict']}, with {named}"

