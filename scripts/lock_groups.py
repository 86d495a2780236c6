"""Prints the part of requirements.lock that some groups need: what `make demo` installs.

    python scripts/lock_groups.py core ros > part.txt

A group is an extra of setup.py; ``core`` is what every command needs (``install_requires``),
``builds`` what builds a package that has no wheel, and ``compiles`` what
``eha_monitor.compile_all`` imports.  Who needs a package stands below it in the
lock (``# via``), so nothing is resolved, and nothing but Python is needed.
"""

import ast
import re
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
NAME = r"[A-Za-z0-9._-]+"


def groups() -> dict[str, list[str]]:
    """Return the names of the packages that setup.py asks for, by group."""
    call = next(node for node in ast.walk(ast.parse((ROOT / "setup.py").read_text()))
                if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "setup")
    given = {word.arg: word.value for word in call.keywords}
    asked = {"builds": ["setuptools"], "compiles": ["lz4", "mcap", "numba", "pydantic", "scipy"],
             "core": ast.literal_eval(given["install_requires"]),
             **ast.literal_eval(given["extras_require"])}
    return {group: [re.match(NAME, one)[0].replace(".", "-") for one in packages]
            for group, packages in asked.items()}


def part(lock: str, roots: list[str]) -> str:
    """Return the entries of a lock for ``roots`` and for all that these need.

    Raises
    ------
    KeyError
        If the lock does not have one of them.
    """
    entries: dict[str, list[str]] = {}  # of a package, one for each range of Pythons
    needs: dict[str, set[str]] = {}
    for entry in re.split(rf"^(?={NAME}==)", lock, flags=re.MULTILINE)[1:]:
        name = re.match(NAME, entry)[0]
        entries.setdefault(name, []).append(entry)
        for parent in re.findall(rf"^    #(?: via|  ) ({NAME})", entry, re.MULTILINE):
            needs.setdefault(parent, set()).add(name)
    wanted, found = list(roots), set()
    while wanted:
        name = wanted.pop()
        if name not in found:
            found.add(name)
            wanted += needs.get(name, ())
    return "".join(entry for name in sorted(found) for entry in entries[name])


def main() -> None:
    """Print the part."""
    known = groups()
    if not sys.argv[1:] or (unknown := set(sys.argv[1:]) - set(known)):
        sys.exit(f"usage: lock_groups.py GROUP ..., of {', '.join(known)}"
                 + (f"; not {', '.join(sorted(unknown))}" if sys.argv[1:] else ""))
    roots = [package for group in sys.argv[1:] for package in known[group]]
    print(part((ROOT / "requirements.lock").read_text(), roots), end="")


if __name__ == "__main__":
    main()
