"""The draft as YAML: every value with where it comes from."""

from json import dumps

from eha_monitor import __version__
from eha_monitor.draft.guess import Guess, Map
from eha_monitor.draft.rig import Entry, number
from eha_monitor.draft.sources import Source

ASK = "ASK"
_COLUMN = 34  # where comments begin, if there is room


def draft_text(source: Source, found: Map, rig: list[Entry], checks: list[str]) -> str:
    """Return the config.

    Parameters
    ----------
    source, found : the recording and its channels.
    rig : lines of ``rig``.
    checks : sentences of the plausibility checks that nothing was done about.
    """
    lines = [f"# Drafted by eha_monitor {__version__} from {source.path.name}.",
             "# The comment behind each value gives its source; ASK marks missing values.",
             *(f"# {ASK}: {check}" for check in checks), "rig:"]
    lines += [_line(f"  {entry.key}: {entry.value}", entry.why, entry.ask) for entry in rig]
    lines += ["channels:"] if source.bag else ["table:"]
    if not source.bag:
        lines += [_line(f"  {key}: {_scalar(value)}", "values: how the file is laid out")
                  for key, value in source.table.items()]
        lines += _time(found.time)
        lines += ["  columns:"] if _readable(found) else [_line("  columns: {}", "no channel was "
                                                                "found", True)]
    margin = "  " if source.bag else "    "
    for name, guess in found.channels.items():
        if guess.full:
            all_ = "100 %" if guess.full == "share" else "how many counts"
            example = "'80 mm'" if guess.full == "share" else "'27648 = 250 bar'"
            lines.append(f"{margin}# {ASK} {name}: '{guess.candidate.shown}' is in "
                         f"{'per cent' if guess.full == 'share' else 'counts'}: how much is "
                         f"{all_}?  --set {name}.full={example}")
        else:
            lines += _channel(name, guess, margin)
    if found.unused:
        names = ", ".join(dumps(one.shown, ensure_ascii=False) for one in found.unused)
        lines.append(f"{margin}# not used: {names}")
    lines += [_line("thresholds:", "none yet: eha-monitor thresholds --from HEALTHY proposes "
                                   "limits",
                    True),
              "  viscous_damping: {low_error: null, low_warn: null, high_warn: null, "
              "high_error: null}",
              "  bulk_modulus: {low_error: null, low_warn: null, high_warn: null, "
              "high_error: null}"]
    return "\n".join(lines) + "\n"


def _readable(found: Map) -> list[str]:
    return [name for name, guess in found.channels.items() if not guess.full]


def _line(text: str, why: str, ask: bool = False) -> str:
    return f"{text:<{_COLUMN}}  # {f'{ASK}: ' if ask else ''}{why}"


def _time(time: Guess | None) -> list[str]:
    if time is None:
        return [f"  # {ASK}: no column of the time was found; rows follow at rig.sample_time"]
    column = _scalar(time.candidate.place["column"])
    lines = [_line(f"  time: {column}", time.why)]
    if time.unit:
        why = "header" if time.sure else "guessed from values"
        lines.append(_line(f"  time_scale: {time.unit}", why))
    return lines


def _channel(name: str, guess: Guess, margin: str) -> list[str]:
    keys = dict(guess.candidate.place)
    parts = [f"{key}: {_scalar(value)}" for key, value in keys.items()]
    parts += [f"unit: {_scalar(guess.unit)}"] if guess.unit else []
    parts += [f"scale: {number(guess.scale)}"] if guess.scale != 1.0 else []
    parts += [f"offset: {number(guess.offset)}"] if guess.offset else []
    return [_line(f"{margin}{name}: {{{', '.join(parts)}}}", guess.why)]


def _scalar(value: str | int) -> str:
    if isinstance(value, int):
        return str(value)
    return value if value.isidentifier() and value.casefold() not in (
        "y", "n", "yes", "no", "on", "off", "true", "false", "null") else dumps(
        value, ensure_ascii=False)
