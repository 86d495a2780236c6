"""Whether what was said of a mistake is true of it."""

import json
import re

from stranger_parts.commands import Answer
from stranger_parts.mistakes import MISTAKES, Truth

# Words of each kind, for a line that has no kind of its own.
KIND_WORDS = {
    "swapped": r"swap|interchang|exchang|in place of|crossed",
    "sign": r"\bsign|revers|negat|opposite|invert|minus",
    "unit": r"\bunit|times|factor|scale|\bmm\b|\bbar\b|kPa|MPa|\brpm\b|inch|degree|\bms\b|\bkN\b"
            r"|litre|per revolution|too (large|small|long|short|high|low)",
    "offset": r"offset|gauge|absolute|atmospher",
    "column": r"same|identical|copy|column|constant|not a |swap|no relation|does not follow",
}
# What a line may call a channel.
CALLED = {
    "omega": r"\bomega\b|\bω\b|pump speed|shaft speed|speed of the pump",
    "x": r"\bx\b|\bposition\b|\bangle\b", "x_d": r"\bx_d\b|demanded position|command",
    "v": r"\bv\b|velocity", "p1": r"\bp1\b|\bpressures\b|chamber_1",
    "p2": r"\bp2\b|\bpressures\b|chamber_2", "force": r"\bforce\b|\btorque\b",
    "time": r"\btimes?\b(?! too| large| small)|time_scale", "t": r"\bt\b",
    "pump_displacement": r"displacement", "mass": r"\bmass\b|\binertia\b",
    "area": r"\barea", "volume": r"\bvolume",
}
KNOWN = {name for mistake in MISTAKES for truth in mistake.truths for name in truth.names}
_NUMBER = re.compile(r"[-+]?(?:\d[\d ]*\d|\d)?(?:\.\d+)?(?:[eE][-+]?\d+)?")
_POWERS = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")
CLOSE = 0.05  # relative: a size measured on a recording


def named(answer: Answer, truths: tuple[Truth, ...], right: tuple[float, ...] = ()
          ) -> tuple[bool, bool]:
    """Tell whether an answer names a mistake: in full, and at least kind and place.

    A command that crashed, or that ran out of time, names nothing.

    Parameters
    ----------
    right : the numbers that the right config has where the wrong one differs; a correction that
        gives one of them has the right size.
    """
    if answer.status not in (0, 2):
        return False, False
    full = place = False
    for kind, names, text, correction in _findings(answer):
        for truth in truths:
            here = _kind(kind, text, truth) and _place(names, text, correction, truth)
            place = place or here
            full = full or (here and _size(text, correction, truth, right))
    return full, place


def _findings(answer: Answer):
    for entry in answer.findings:
        correction = entry.get("correction") or {}
        # What a correction changes is what is blamed; channels may also hold what it was
        # compared with.
        names = [name for name in _keys(correction) if name in KNOWN]
        if not names:
            names = [part for name in entry.get("channels") or ()
                     for part in str(name).split(".")]
        yield str(entry.get("kind", "")), names, str(entry.get("finding", "")), correction
    for line in answer.lines:
        yield "", [], line, {}


def _kind(kind: str, text: str, truth: Truth) -> bool:
    if kind:
        # One column in place of another has no kind in the contract: any but a hold will do.
        return kind in truth.kinds or ("column" in truth.kinds and kind != "hold")
    return any(re.search(KIND_WORDS[one], text, re.I) for one in truth.kinds)


def _place(names: list[str], text: str, correction, truth: Truth) -> bool:
    if truth.mentions and not re.search(truth.mentions, text + json.dumps(correction), re.I):
        return False
    if names:
        return any(name in names for name in truth.names)
    return any(re.search(CALLED.get(name, rf"\b{re.escape(name)}\b"), text, re.I)
               for name in truth.names)


def _size(text: str, correction, truth: Truth, right: tuple[float, ...]) -> bool:
    if truth.factor is None:
        return True
    if any(abs(value - one) <= CLOSE * abs(one) for value in _leaves(correction)
           for one in right):
        return True
    if truth.words and re.search(truth.words, text, re.I):
        return True
    sizes = (abs(truth.factor), 1.0 / abs(truth.factor))
    return any(abs(abs(value) / one - 1.0) < CLOSE
               for value in _numbers(text) + _leaves(correction) for one in sizes)


def numbers_that_differ(right, wrong) -> tuple[float, ...]:
    """Return the numbers of a config where another differs."""
    if isinstance(right, dict):
        other = wrong if isinstance(wrong, dict) else {}
        return tuple(n for key, value in right.items()
                     for n in numbers_that_differ(value, other.get(key)))
    return () if right == wrong else tuple(_leaves(right))


def _numbers(text: str) -> list[float]:
    text = re.sub(r"10\^?([-⁻]?[⁰¹²³⁴⁵⁶⁷⁸⁹\d]+)", _power, text.replace("\u202f", " "))
    found = []
    for match in _NUMBER.findall(text.replace("−", "-")):
        try:
            found.append(float(match.replace(" ", "")))
        except ValueError:
            continue
    return found


def _power(match) -> str:
    exponent = match[1]
    if exponent.isdigit() and match[0] == "10" + exponent:
        return match[0]  # 1000 is no power
    return "1e" + exponent.translate(_POWERS)


def _keys(tree) -> list[str]:
    if isinstance(tree, dict):
        return [part for key in tree for part in str(key).split(".")] + [
            k for value in tree.values() for k in _keys(value)]
    if isinstance(tree, (list, tuple)):
        return [k for value in tree for k in _keys(value)]
    return [tree] if isinstance(tree, str) else []


def _leaves(tree) -> list[float]:
    if isinstance(tree, dict):
        return [leaf for value in tree.values() for leaf in _leaves(value)]
    if isinstance(tree, (list, tuple)):
        return [leaf for value in tree for leaf in _leaves(value)]
    if isinstance(tree, (int, float)) and not isinstance(tree, bool):
        return [float(tree)]
    return _numbers(tree) if isinstance(tree, str) else []
