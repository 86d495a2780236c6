"""What ``monitor/diagnosis`` says: the answer of a diagnosis, and the model in force."""

from eha_monitor.health.alarms import WATCHED
from eha_monitor.health.judge import DIAGNOSIS, MACHINE, MODEL_IN_FORCE, Finding
from eha_monitor.live.diagnosing import Answer
from eha_monitor.live.exchange import Adopted
from eha_monitor.quantity import with_uncertainty
from eha_monitor.words import listed

EFFECT = "effect "
_LEVELS = {"consistent": "OK", "mismatch": "WARN", "unexplained": "WARN"}


def effects_in_words(answer: Answer) -> str:
    """Return what an answer puts into the model: names with their sizes.

    Names are those of the catalogue, so that programs read them too.
    """
    tree = answer.tree
    return listed([
        *(f"{one['name']} ({one['size']})" if one.get("size") else one["name"]
          for one in tree.get("effects", [])),
        *(f"rig.{one['key']}" for one in tree.get("rig_data", [])),
        *(f"a learned term of the {one['balance']} balance" for one in tree.get("learned", []))
    ]) or "B and beta_e as found"


def model_finding(adopted: Adopted | None) -> Finding:
    """Return which model is in force, who put it there and when."""
    if adopted is None:
        return Finding(MODEL_IN_FORCE, "OK", "the model of the config is in force",
                       {"adopted": 0})
    return Finding(MODEL_IN_FORCE, "OK", f"the config's model with {adopted.words} is in force: "
                   f"adopted by {adopted.who} at {adopted.time_utc}", {
                       "adopted": 1, "who": adopted.who, "time_utc": adopted.time_utc,
                       "effects": ", ".join(adopted.model["effects"]), "report": adopted.report})


def answer_findings(answer: Answer | None) -> list[Finding]:
    """Return the verdict, each effect and each number of the rig, then B and beta_e."""
    if answer is None:
        return [Finding(DIAGNOSIS, "STALE", "nothing has been diagnosed yet")]
    tree = answer.tree
    where = tree["location"]
    found = [Finding(DIAGNOSIS, _LEVELS.get(answer.verdict, "STALE"), tree.get("message", ""), {
        "verdict": answer.verdict,
        **{f"share_{name}": share for name, share in where["balance"].items()},
        "regime": where["regime"],
        **{f"probability_{name}": p for name, p in (tree.get("probability") or {}).items()
           if p is not None},
        "bag": ", ".join(map(str, answer.bags)), "report": str(answer.folder / "report.html"),
        "json": str(answer.folder / "diagnosis.json"),
        "config": str(answer.folder / "completed.yaml"), "wall_s": answer.wall_s})]
    for one in (*tree.get("effects", []), *tree.get("rig_data", [])):
        values: dict[str, float | int | str] = {}
        if one.get("probability") is not None:
            values["probability"] = float(one["probability"])
        if one.get("size"):
            values["size"] = one["size"]
        for name, value in one.get("parameters", {}).items():
            values |= _number(name, value)
        if one.get("indistinguishable_from"):
            values["indistinguishable_from"] = ", ".join(one["indistinguishable_from"])
        name = f"{EFFECT}{one['name']}" if "name" in one else f"rig.{one['key']}"
        found.append(Finding(name, "WARN", one["statement"], values))
    for one in tree.get("learned", []):
        found.append(Finding(f"learned {one['balance']}", "WARN", one["statement"]))
    found += _parameters(tree)
    return found


def comparison_findings(answer: Answer | None, since: str, healthy: int, why: str = "",
                        kept: bool = False) -> list[Finding]:
    """Return what has changed from the healthy recordings, and the indicators of health.

    Parameters
    ----------
    answer : of a comparison, None before the first.
    since : from when on the compared rows are, ISO 8601.
    healthy : number of healthy recordings.
    why : what moved then.
    kept : whether its recording and its report are.
    """
    if answer is None:
        return [Finding(MACHINE, "STALE", f"not yet compared with {healthy} healthy recordings")]
    tree, values = answer.tree, {"since_utc": since, "why": why, "verdict": answer.verdict}
    if kept:
        values |= {"bag": str(answer.bags[0]), "report": str(answer.folder / "report.html")}
    if answer.verdict == "consistent":
        found = [Finding(MACHINE, "OK", tree["message"], values)]
    else:
        found = [Finding(MACHINE, "WARN", f"changed since {since} ({why}): {tree['message']}",
                         values)]
    for one in tree["changes"]:
        before, now = one["reference"]["value"], one["now"]["value"]
        found.append(Finding(
            f"changed {one['what']} {one['parameter']}".strip(), "WARN",
            f"{one['statement']}, since {since}",
            _number("healthy", one["reference"]) | _number("now", one["now"])
            | {"unit": one["unit"], "since_utc": since}
            | ({"change_percent": 100.0 * (now / before - 1.0)} if before and now and abs(
                before) > 3.0 * (one["reference"]["stddev"] or 0.0) else {})))
    found += [Finding(f"indicator {one['name']}", "OK",
                      f"{one['words']} {with_uncertainty(one['value'], one['stddev'], '')} "
                      f"{one['unit']}",
                      _number("value", one) | {"unit": one["unit"]})
              for one in tree["indicators"]
              if one.get("value") is not None and one.get("stddev") is not None]
    return found


def _parameters(tree: dict) -> list[Finding]:
    """Return what the effects did to B and beta_e: before and after, each with deviation."""
    found = []
    for watched in WATCHED:
        before, after = (tree["parameters"][when].get(watched.symbol)
                         for when in ("before", "after"))
        values = _number("before", before) | _number("after", after)
        shown = [with_uncertainty(one["value"], one["stddev"], one["unit"])
                 for one in (before, after) if one and None not in one.values()]
        if len(shown) == 2:
            words = f"{watched.words} reads {shown[0]} without, {shown[1]} with what was found"
            found.append(Finding(watched.section, "OK", words, values))
    return found


def _number(name: str, value: dict | None) -> dict[str, float]:
    """Return a number and its deviation under a name, as far as they are known."""
    return {} if not value else {
        key: float(value[part]) for key, part in ((name, "value"), (f"{name}_stddev", "stddev"))
        if value.get(part) is not None}
