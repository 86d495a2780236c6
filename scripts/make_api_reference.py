"""Make docs/api.md of the docstrings of the Python interface.

    python scripts/make_api_reference.py [FILE]

griffe reads the source; nothing of it is run.  A test holds that the committed page is current.
"""

import re
import sys
from pathlib import Path

import griffe

ROOT = Path(__file__).parents[1]
HEAD = "<!-- Made by scripts/make_api_reference.py of the docstrings: edit those. -->\n"
# Records that stand in others, by the module that has them.
PARTS = {
    "estimation.results": ("ParameterEstimate", "StageResult", "Consistency", "JointResult",
                        "ModelStatus", "Mismatch", "Taint", "Event"),
    "estimation.joint": ("ObservabilityTable", "ObservabilityRow"),
    "health.alarms": ("Alarm",),
    "recordings.recording": ("ChannelFinding",),
    "mismatch.diagnosis": ("NamedEffect", "Value", "RigFinding", "LearnedTerm", "Change",
                           "Location", "SignalFit"),
    "mismatch.advise.identifiability": ("Known", "Confusion", "DetectionLimit"),
    "mismatch.advise.separate": ("Doubt",),
    "mismatch.advise.motions": ("Motion",),
}
# For the rooms of the package itself.
INTERNAL = ("of", "inner", "kind", "settings", "source", "instead")


def main() -> None:
    """Write the page."""
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "docs" / "api.md"
    target.write_text(page(), encoding="utf-8")


def page() -> str:
    """Return the page as Markdown."""
    package = griffe.load("eha_monitor", search_paths=[str(ROOT)], docstring_parser="numpy")
    names = [str(name).strip("'\"") for name in package["__all__"].value.elements]
    public = [resolved(package, name) for name in names]
    parts = [resolved(package[module], name) for module, found in PARTS.items()
             for name in found]
    lines = [HEAD, "# Python API\n", plain(package["api"].docstring.value), "\n## Functions\n"]
    for one in public:
        if one.is_function:
            lines += function(one, f"em.{one.name}", 3)
    lines.append("## Records\n")
    for one in public:
        if one.is_class:
            lines += record(one)
    lines.append("## Parts of the records\n")
    for one in parts:
        lines += part(one)
    return re.sub(r"\n{3,}", "\n\n", "\n".join(lines)).strip() + "\n"


def resolved(package, name: str):
    """Return an object of a package, the thing itself where it was imported."""
    found = package[name]
    return found.final_target if found.is_alias else found


def function(one, name: str, level: int) -> list[str]:
    """Return a function with its signature and its docstring."""
    return [f"{'#' * level} `{name}`\n", "```python", signature(one, name), "```\n",
            *sections(one.docstring)]


def signature(one, name: str) -> str:
    """Return a call as it may be written, a line for each parameter where one is too short."""
    marks = {"var_positional": "*", "var_keyword": "**"}
    words, bare = [], False
    for p in one.parameters:
        if p.name in ("self", "cls"):
            continue
        if p.kind.name == "keyword_only" and not bare:
            words.append("*")
        bare = bare or p.kind.name in ("keyword_only", "var_positional")
        default = "" if p.default is None or p.kind.name in marks else f"={p.default}"
        words.append(f"{marks.get(p.kind.name, '')}{p.name}{default}")
    line = f"{name}({', '.join(words)})"
    if one.returns is not None:
        line += f" -> {str(one.returns).strip(chr(39))}"
    if len(line) < 95:
        return line
    inside = "".join(f"    {word},\n" for word in words)
    return f"{name}(\n{inside}){line.rpartition(')')[2]}"


def record(one) -> list[str]:
    """Return a class: what it is, what it shows, what it does."""
    lines = [f"### `em.{one.name}`\n", *sections(one.docstring)]
    shown = [member for name, member in one.members.items()
             if member.is_attribute and "property" in member.labels and name[0] != "_"
             and name not in INTERNAL]
    if shown:
        lines += ["Properties:\n", *(
            f"- `{member.name}` ({annotation(member.annotation)}): "
            + " ".join(plain(docstring(member)).split()) for member in shown), ""]
    for name, member in one.members.items():
        if member.is_function and name[0] != "_" and name not in INTERNAL:
            lines += function(member, f"{one.name}.{name}", 4)
    return lines


def part(one) -> list[str]:
    """Return a record that stands in another: its docstring, then its fields with their types."""
    fields = [f"`{name}`: {annotation(member.annotation)}" for name, member
              in one.all_members.items() if member.is_attribute and name[0] != "_"
              and member.annotation is not None and "property" not in member.labels]
    return [f"### `{one.name}`\n", *sections(one.docstring, short=True),
            f"Fields: {', '.join(fields)}.\n"]


def docstring(one) -> str:
    """Return the words of an object."""
    return one.docstring.value if one.docstring else ""


def sections(text, short: bool = False) -> list[str]:
    """Return the sections of a docstring; ``short``: its items are ``name : meaning``."""
    lines: list[str] = []
    for section in text.parsed:
        kind = section.kind.value
        if kind == "text":
            lines += [plain(section.value), ""]
        elif kind == "examples":
            for what, shown in section.value:
                lines += ["```python", shown, "```\n"] if what.value == "examples" else [
                    plain(shown), ""]
        else:
            items = [one for one in section.value if getattr(one, "name", "") not in INTERNAL]
            lines += [f"{kind.capitalize()}:\n", *(item(one, short) for one in items), ""]
    return lines


def item(one, short: bool) -> str:
    """Return a line of a section: name, type, meaning."""
    name, kind = getattr(one, "name", ""), annotation(one.annotation)
    words = " ".join(plain(one.description).split())
    if short:  # its first line was taken for a type
        return f"- `{name}`: {plain(str(one.annotation))} {words}".rstrip()
    return f"- `{name}` ({kind}): {words}" if name else f"- `{kind}`: {words}"


def annotation(kind) -> str:
    """Return a type, or the words that stand in its place."""
    words = plain(str(kind)).replace("\n", " ")
    if words[:1] in "'\"" and words[-1:] == words[:1]:
        words = words[1:-1]
    return words[1:-1] if words[:1] == "(" and words[-1:] == ")" and ", " in words and (
        "(" not in words[1:]) else words


def plain(text: str) -> str:
    """Return a docstring's text as Markdown: roles and double backticks as code."""
    text = re.sub(r":\w+:`~?([^`]+)`", r"`\1`", text)
    return re.sub(r"``([^`]*)``", r"`\1`", text).strip()


if __name__ == "__main__":
    main()
