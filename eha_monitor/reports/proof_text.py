"""The result of a trial as Markdown, for docs/proof.md."""

from pathlib import Path

from eha_monitor.errors import InputError
from eha_monitor.output import write_text
from eha_monitor.prove.trial import misses
from eha_monitor.reports.proof_report import (
    GROUPS,
    confusion_rows,
    effect_rows,
    group_rows,
    heading,
    marks,
    parameter_row,
    percent,
    said_words,
    truths_of,
)

BEGIN, END = "<!-- result -->", "<!-- end of result -->"


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
    parts = ["\n".join(f"- {label}: {text}" for label, text in heading(found))]
    if "ground" in found:
        parts.append("\n".join(f"- {fact}" for fact in found["facts"]))
        parts.append(table(("recording", "parameter", "true", "found", "off by", "aim"), [
            tuple(row.values())[:6] for row in map(parameter_row, found["parameters"])]))
        answers = [(row["case"], ", ".join(row["truth"]) or "clean", said_words(row),
                    row["located"] or "-") for row in found["rows"]]
        return "\n\n".join([*parts, table(("recording", "concealed", "said", "balance"), answers)])
    parts.append(table(("mark", "reached", "aim"), [
        (row["words"], row["value"], row["aim"]) for row in marks(found)]))
    if found.get("reliability"):
        parts.append(table(("probability said", "statements", "mean said", "right"), [
            (f"{one['low']:.1f} to {one['high']:.1f}", one["n"], percent(one["said"]),
             percent(one["right"])) for one in found["reliability"]]))
    head = ("cases", "exact", "within class", "detectable", "within class of these")
    for name, title in GROUPS.items():
        if found.get(name):
            parts.append(table((title, *head), [
                tuple(row.values()) for row in group_rows(found[name])]))
    parts.append(table(("effect", "cases", "exact", "within class", "detectable",
                        "found of these", "95 % point, units"),
                       [tuple(row.values()) for row in effect_rows(found)]))
    parts.append(table(("concealed", "answers", "right", "said instead"),
                       [tuple(row.values()) for row in confusion_rows(found)]))
    missed = misses(found)
    parts.append(f"Misses: {len(missed)} of {found['cases']}.")
    parts.append("\n".join(
        f"- {row['case']} ({row['motion']}, noise × {row['noise']:g}): "
        f"{'; '.join(truths_of(row)) or 'clean'}. "
        f"Said: {said_words(row)}, {row['located'] or 'no'} balance." for row in missed))
    return "\n\n".join(part for part in parts if part)


def table(head: tuple[str, ...], rows: list[tuple]) -> str:
    """Return a Markdown table."""
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join(f"| {' | '.join(map(str, line))} |" for line in lines)
