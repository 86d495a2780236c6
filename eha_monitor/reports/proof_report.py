"""The result of ``prove`` as a page, with every miss and its picture, and as Markdown."""

from pathlib import Path

from eha_monitor.errors import InputError
from eha_monitor.output import write_text
from eha_monitor.prove.files import read_json
from eha_monitor.prove.numbers import number_of
from eha_monitor.prove.score import MARKS, UNEXPLAINED
from eha_monitor.prove.trial import misses
from eha_monitor.quantity import number, quantity, with_uncertainty
from eha_monitor.reports.page import Cell, Table, markdown, render, table
from eha_monitor.reports.proof_figures import (
    detection_curve,
    detection_figure,
    missing_term,
    parameter_figures,
    reliability_figure,
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
                 "as viscous friction there. The advice comes first, the second motion is "
                 "recorded as advised, and both recordings are diagnosed together."),
}
GROUPS = {"by_kind": "effects in a recording", "by_rig": "numbers of the config",
          "by_strength": "strength (single effects)",
          "by_motion": "motion", "by_noise": "noise, times the sensors' own",
          "by_channels": "channels"}
MOST_PICTURES = 80  # of misses; each is some 30 kB
BEGIN, END = "<!-- result -->", "<!-- end of result -->"
_NUMBERS = " | number | number | number | number | number"


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
        "proof.html.j2", title="EHA diagnosis: the concealed-effect trial", facts=_facts(found),
        marks=marks(found), groups=groups(found),
        pictures=[one for one in (detection_figure(found), detection_curve(found)) if one],
        units=bool(found["detection_curves"]), reliability=reliability_figure(found),
        effects=effects(found), confusion=confusion(found), misses=_miss_cards(found, work),
        cases=found["cases"], ground=GROUNDS.get(found.get("ground")),
        ground_facts=found.get("facts", ()),
        ground_pictures=parameter_figures(found["parameters"]) if "ground" in found else [],
        parameters=parameters(found) if "ground" in found else None)


def parameters(found: dict) -> Table:
    """Return the parameters of a ground: true and found."""
    rows = []
    for row in found["parameters"]:
        unit = row.get("unit", "")
        said = "not named" if row["said"] is None else (
            with_uncertainty(row["said"], row["stddev"], unit))
        kind = "" if not row["aim"] else " good" if row["within"] else " poor"
        rows.append((row["group"], row["name"], quantity(row["true"], unit),
                     Cell(said, f"value{kind}"), percent(row["relative"]),
                     percent(row["aim"]) if row["aim"] else ""))
    return table("recording | parameter | true | found | off by | aim", rows,
                 " | key | number | value | number | number", "found")


def percent(value: float | None) -> str:
    """Return a share as text; a dash where nothing was judged."""
    return "—" if value is None else f"{100 * value:.1f} %"


def _facts(found: dict) -> list[tuple[str, str]]:
    """Return the facts at the head of the page."""
    facts = [("Recordings", str(found["cases"])), ("Seed", str(found["seed"])),
             ("Commit", found["commit"] or "not a checkout"),
             ("SHA-256 of the sealed key", found["sealed_key_sha256"])]
    facts.append(("Source of the answers", ", ".join(
        f"{name or 'none'} ({count})" for name, count in found["sources"].items())))
    facts.append(("Oracle", "evaluated" if found["oracle"] else "not evaluated"))
    if found["failed"]:
        facts.append(("Diagnoses that failed", str(found["failed"])))
    return facts


def marks(found: dict) -> Table:
    """Return the marks, each beside its aim."""
    rows = []
    for name, (words, aim, limit, more) in MARKS.items():
        value = found["score"].get(name)
        kind = ""
        if value is not None and limit is not None:
            kind = " good" if (value >= limit if more else value <= limit) else " poor"
        rows.append((words, Cell(percent(value), f"value{kind}", mark=name), aim))
    return table("mark | reached | aim", rows, " | value | number", "marks")


def groups(found: dict) -> list[Table]:
    """Return the shares by kind of case."""
    return [table(f"{title} | cases | exact | within class | detectable | within class of these", [
        (name, one["n"], percent(one["exact"]), percent(one["within_class"]), one["detectable"],
         percent(one["detectable_within_class"])) for name, one in found[key].items()], _NUMBERS)
        for key, title in GROUPS.items() if found.get(key)]


def effects(found: dict) -> Table:
    """Return the shares by effect."""
    curves = found["detection_curves"]
    rows = [(name, one["n"], percent(one["exact"]), percent(one["within_class"]),
             one["detectable"], percent(one["found"]),
             f"{curves[name]['point_95']:.2g}" if name in curves else "—")
            for name, one in found["by_effect"].items()]
    return table("effect | cases | exact | within class | detectable | found of these | "
                 "95 % point, units", rows, f"key{_NUMBERS} | number", "effects")


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


# ---- as Markdown, for docs/proof.md ---------------------------------------------------------

def write_result(path: Path, found: dict) -> None:
    """Put a result between the two marks of a Markdown file; the rest stays as it is.

    Raises
    ------
    InputError
        If the file cannot be read or has no such marks.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as problem:
        raise InputError(f"{path}: cannot read: {problem}") from problem
    opening, closing = marks_of(found.get("ground"))
    before, begin, rest = text.partition(opening)
    _, end, after = rest.partition(closing)
    if not begin or not end:
        raise InputError(f"{path}: expected the lines {opening} and {closing}, to put the result "
                         "between them")
    write_text(path, f"{before}{opening}\n{result_text(found)}\n{closing}{after}")


def marks_of(ground: str | None) -> tuple[str, str]:
    """Return the lines between which a result stands, those of a ground if it is one."""
    if ground is None:
        return BEGIN, END
    return BEGIN.replace("result", f"{ground} result"), END.replace("result", f"{ground} result")


def result_text(found: dict) -> str:
    """Return a result as Markdown: facts, marks, groups, effects, confusion, misses."""
    parts = ["\n".join(f"- {label}: {text}" for label, text in _facts(found))]
    if "ground" in found:
        answers = table("recording | concealed | said | balance", [
            (row["case"], ", ".join(row["truth"]) or "clean", said_words(row),
             row["located"] or "-") for row in found["rows"]])
        return "\n\n".join([*parts, "\n".join(f"- {fact}" for fact in found["facts"]),
                            markdown(parameters(found)), markdown(answers)])
    tables = [marks(found)]
    if found.get("reliability"):
        tables.append(table("probability said | statements | mean said | right", [
            (f"{one['low']:.1f} to {one['high']:.1f}", one["n"], percent(one["said"]),
             percent(one["right"])) for one in found["reliability"]]))
    parts += map(markdown, (*tables, *groups(found), effects(found), confusion(found)))
    missed = misses(found)
    parts.append(f"Misses: {len(missed)} of {found['cases']}.")
    parts.append("\n".join(
        f"- {row['case']} ({row['motion']}, noise × {row['noise']:g}): "
        f"{'; '.join(truths_of(row)) or 'clean'}. "
        f"Said: {said_words(row)}, {row['located'] or 'no'} balance." for row in missed))
    return "\n\n".join(part for part in parts if part)
