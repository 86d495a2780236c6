"""Which column is which channel, in which unit, and why: from headers and from the numbers."""

import re
from dataclasses import dataclass, replace

import numpy as np

from eha_monitor.draft.sources import Candidate, Source
from eha_monitor.draft.words import ANGLES, beside_chamber, plain, words_of
from eha_monitor.errors import InputError
from eha_monitor.settings.channels import CHANNELS
from eha_monitor.units import to_si

# Quantity -> (largest absolute value below which, unit): what a rig shows, coarsest guess.
_LEVELS = {
    "position": ((2.0, "m"), (5e3, "mm"), (np.inf, "um")),
    "angle": ((7.0, "rad"), (np.inf, "deg")),
    "velocity": ((5.0, "m/s"), (np.inf, "mm/s")),
    "pressure": ((600.0, "bar"), (2e4, "kPa"), (np.inf, "Pa")),
    "turning": ((np.inf, "rpm"),),
    "force": ((np.inf, "N"),), "torque": ((np.inf, "N*m"),),
    "temperature": ((200.0, "degC"), (np.inf, "K")),
}
_EPOCHS = ((1e17, "1 ns"), (1e14, "1 us"), (1e11, "1 ms"))
TIMES = ("1 ms", "1 s", "1 us", "1 ns", "1 min", "1 h")  # that a logger counts
REGULAR = 0.95  # of the steps of a time go forward
LAGS = 400  # samples looked ahead and behind


def likely_unit(quantity: str, values: np.ndarray) -> tuple[str, str]:
    """Return the unit that numbers of a quantity are likely in, and why, in words."""
    finite = values[np.isfinite(values)]
    largest = float(np.abs(finite).max()) if len(finite) else 0.0
    unit = next(unit for limit, unit in _LEVELS[quantity] if largest < limit)
    return unit, f"values up to {largest:.4g}"


def is_time(values: np.ndarray, named: bool = False) -> bool:
    """Tell whether numbers or dates go forward as a time does.

    One that is ``named`` so may begin anew, as where two recordings stand in one file.
    """
    steps = steps_of(values)
    forward = steps.clip(min=0.0) if named else steps
    return len(steps) > 1 and float(np.mean(steps >= 0)) > REGULAR and np.median(steps) >= 0 and (
        float(forward.sum()) > 0)


def steps_of(values: np.ndarray) -> np.ndarray:
    """Return the steps of a column; of dates in seconds."""
    if values.dtype.kind == "M":
        return np.diff(values[~np.isnat(values)].astype(np.int64)) * 1e-9
    return np.diff(values[np.isfinite(values)])


def time_unit(values: np.ndarray) -> tuple[str, str]:
    """Return what a unit of a time column without a name of its unit is, and why."""
    largest = float(np.nanmax(np.abs(values)))
    for limit, unit in _EPOCHS:
        if largest > limit:
            return unit, f"values from {largest:.3g} on count from 1970"
    steps = steps_of(values)
    step = float(np.median(steps[steps > 0]))
    if largest < 1e9 and step >= 0.5 and largest > 200:
        return "1 ms", f"steps of {step:.4g} up to {largest:.4g}"
    return "1 s", f"steps of {step:.4g} up to {largest:.4g}"


def leads(one: np.ndarray, other: np.ndarray) -> bool:
    """Tell whether one column is ahead of another, as a demand is of what follows it."""
    a, b = (np.nan_to_num(np.diff(values)) for values in (one, other))
    a, b = a - a.mean(), b - b.mean()
    lags = range(-min(LAGS, len(a) // 4), min(LAGS, len(a) // 4) + 1)
    match = [float(np.dot(a[max(0, -k):len(a) - max(0, k)], b[max(0, k):len(b) - max(0, -k)]))
             for k in lags]
    return bool(list(lags)[int(np.argmax(match))] > 0)


def is_rate_of(speed: np.ndarray, position: np.ndarray, step: float) -> bool:
    """Tell whether one column is the rate of another in the same unit of length."""
    rate = np.gradient(position, step)
    good = np.isfinite(rate) & np.isfinite(speed)
    if good.sum() < 100 or not np.std(speed[good]) or not np.std(rate[good]):
        return False
    # Over blocks, so that the noise of a difference does not hide it.
    width = max(1, good.sum() // 300)
    a, b = (values[good][:good.sum() // width * width].reshape(-1, width).mean(axis=1)
            for values in (speed, rate))
    slope = float(np.dot(a, b) / np.dot(b, b))
    return bool(np.corrcoef(a, b)[0, 1] > 0.95 and 0.9 < slope < 1.1)


HOTTEST = 700.0  # of a temperature in any unit; more are counts
ACTUAL = ("ist", "act", "actual", "meas", "measured", "real", "mesure", "medida", "fbk",
          "feedback", "gemessen", "effettiva")
VALVE = ("dcv", "valve", "ventil", "spool")
_STRAIGHT = ("x", "xdot", "dot", "piston", "kolben", "rod", "cyl", "cylinder")  # no shaft turns
_UNITS_OF = {"x": "position", "x_d": "position", "v": "velocity", "omega": "turning",
             "omega_d": "turning", "p1": "pressure", "p2": "pressure", "force": "force",
             "temperature": "temperature"}


@dataclass(frozen=True)
class Guess:
    """A channel of the draft; unit, scale, offset and delay as the map takes them."""

    candidate: Candidate
    unit: str  # of the time ``1 ms`` and so on
    why: str  # where column and unit come from, as the end of a line
    scale: float = 1.0
    offset: float = 0.0
    # The header names the unit, or somebody answered: values do not overrule it.
    sure: bool = False
    full: str = ""  # ``share`` or ``counts`` where somebody has to say first how much is all
    delay: float = 0.0
    clock: "Guess | None" = None  # its own, where it is not the time of the others


@dataclass(frozen=True)
class Map:
    """What was guessed: the time, the channels, what nobody uses."""

    time: Guess | None
    channels: dict[str, Guess]
    unused: tuple[Candidate, ...]
    rotary: bool = False
    # The first words of the columns where these part several machines, that of ``x`` first; empty
    # where the file is of one machine, or somebody has named the column of x.
    machines: tuple[str, ...] = ()

    def with_channel(self, name: str, guess: Guess) -> "Map":
        """Return the map with another channel."""
        return replace(self, channels={**self.channels, name: guess})


def guessed(source: Source, chosen: dict[str, str] | None = None) -> Map:
    """Return which column is which channel; ``chosen``: channel or ``time`` -> column named."""
    chosen = chosen or {}
    named = {name: _named(source, column) for name, column in chosen.items()}
    left = [one for one in source.candidates if one not in named.values()]
    time = named.pop("time", None) or _time(source, left)
    machines = _machines([one for one in left if one is not time], named.get("x"))
    left = [one for one in left if one is not time and _first(one) not in machines[1:]]
    found = dict(named)
    for channel, one, why in (*_pressures(left), *_others(left, time, source)):
        if channel not in found and one not in named.values():
            found[channel] = (one, why)
    taken = [entry[0] if isinstance(entry, tuple) else entry for entry in found.values()]
    rotary = any(map(_turns, taken)) and not any(one.header.kind == "position" for one in taken)
    channels = {}
    for channel, entry in sorted(found.items(), key=lambda one: CHANNELS.index(one[0])):
        one, why = entry if isinstance(entry, tuple) else (entry, "answered")
        channels[channel] = _in_unit(channel, one, why, rotary, source.bag)
    whole = _time_guess(time, source.bag)
    if whole:
        channels = _on_their_clocks(channels, whole, source.candidates)
    used = [one.candidate for guess in channels.values() for one in (guess, guess.clock) if one]
    unused = tuple(one for one in source.candidates if one is not time
                   and not any(one is other for other in used))
    return Map(whole, channels, unused, rotary,
               () if "x" in named else machines)


def _first(one: Candidate) -> str:
    return next(iter(words_of(one.shown)), "")


def _machines(left: list[Candidate], x: Candidate | None) -> tuple[str, ...]:
    """Return the first words of the columns of several machines, own first.

    Empty where one word, or none, has a measured position and another channel.
    """
    told = [one for one in left if one.header.quantity]
    travel = {}
    for one in told:
        if one.header.quantity == "position" and not one.header.demand and _moves(one) and any(
                other is not one and _first(other) == _first(one) for other in told):
            travel[_first(one)] = max(float(np.ptp(one.values[np.isfinite(one.values)])),
                                      travel.get(_first(one), 0.0))
    own = _first(x) if x else max(travel, key=travel.get, default="")
    others = [word for word in travel if word != own]
    return (own, *others) if others and (x is None or own in words_of(x.shown)) else ()


def _named(source: Source, column: str) -> Candidate:
    for one in source.candidates:
        if column in (one.shown, one.place.get("column"), one.place.get("topic")):
            return one
    raise InputError(f"{source.path}: column '{column}' not found, the file has "
                     f"{', '.join(one.shown for one in source.candidates)}")


def _time(source: Source, left: list[Candidate]) -> Candidate | None:
    if source.bag:
        return None
    going = [one for one in left if is_time(one.values, one.header.quantity == "time")]
    dated = [one for one in going if one.values.dtype.kind == "M"]
    named = [one for one in going if one.header.quantity == "time" or "".join(
        words_of(one.shown)) == "xvalue"]
    even = [one for one in going if _even(one.values)]
    # A name beats dates, and dates beat a column that merely counts on.
    return next(iter([*named, *dated, *even]), None)


def _turns(one: Candidate) -> bool:
    return one.header.kind in ("angle", "torque") or (
        one.header.quantity == "position" and any(part in plain(one.shown) for part in ANGLES))


def _even(values: np.ndarray) -> bool:
    steps = steps_of(values)
    step = np.median(steps)
    return bool(step > 0 and np.mean(np.abs(steps - step) < 0.2 * step) > 0.9)


def _time_guess(one: Candidate | None, bag: bool) -> Guess | None:
    if one is None or bag:
        return None
    if one.values.dtype.kind == "M":
        return Guess(one, "", "values: dates or times of day", sure=True)
    if one.header.kind == "time":
        return Guess(one, f"1 {one.header.unit}", f"header: '{one.shown}'", sure=True)
    if words_of(one.shown) in (["ms"], ["t", "ms"]):
        return Guess(one, "1 ms", f"header: '{one.shown}'", sure=True)
    unit, why = time_unit(one.values)
    return Guess(one, unit, why)


def _on_their_clocks(channels: dict[str, Guess], time: Guess, columns: tuple[Candidate, ...]
                     ) -> dict[str, Guess]:
    """Return channels with the clock that a logger has written to the left of each.

    A scope that records with several tasks writes the time of each, and then its signals: the
    rows of one of 5 ms end when half of those of 10 ms have passed.
    """
    shown = [re.sub(r"[._ ]?\d+$", "", one.shown) for one in columns]
    clock, own = None, []
    for one, name in zip(columns, shown, strict=True):
        even = one.values.dtype.kind == "f" and _even(one.values)
        tells = one is time.candidate or (even and (
            one.header.quantity == "time" or shown.count(name) > 1))
        clock = one if tells else clock
        own.append(None if tells else clock)
    if len({id(one) for one in own if one is not None}) < 2 or (
            time.candidate.values.dtype.kind == "M"):
        return channels
    stamps = to_si(time.unit, "s") * time.candidate.values
    found = {}
    for name, guess in channels.items():
        clock = next(its for one, its in zip(columns, own, strict=True) if one is guess.candidate)
        if clock is not None and clock is not time.candidate:
            told = _unit_beside(clock, stamps)
            late = np.abs(to_si(told.unit, "s") * clock.values - stamps)
            if np.nanmax(late) > 0.5 * np.nanmedian(steps_of(stamps)):
                guess = replace(guess, clock=told)
        found[name] = guess
    return found


def _unit_beside(clock: Candidate, stamps: np.ndarray) -> Guess:
    """Return the time of a clock whose unit is its header's, or one in which it lasts as long."""
    if clock.header.kind == "time":
        return Guess(clock, f"1 {clock.header.unit}", f"header: '{clock.shown}'", sure=True)
    lasts = np.ptp(stamps[np.isfinite(stamps)])
    spans = {name: to_si(name, "s") * float(np.nanmax(clock.values) - np.nanmin(clock.values))
             / lasts for name in TIMES}
    return Guess(clock, min(spans, key=lambda name: abs(np.log(spans[name]))),
                 f"the time to the left of it: '{clock.shown}'")


def _pressures(left: list[Candidate]) -> list[tuple[str, Candidate, str]]:
    """Return the chambers' pressures: by their marks, else in the order of the columns."""
    all_ = [one for one in left if one.header.quantity == "pressure" and one.header.chamber >= 0
            and not one.header.demand]
    marked = {chamber: [one for one in all_ if one.header.chamber == chamber]
              for chamber in (1, 2)}
    free = [one for one in all_ if not one.header.chamber]
    first, second = (marked[chamber][0] if marked[chamber] else None for chamber in (1, 2))
    # Both at the same place: the cylinder's, where the valve has its own.
    pairs = [(one, other) for one in marked[1] for other in marked[2]
             if beside_chamber(one.shown) == beside_chamber(other.shown)]
    if pairs:
        first, second = min(pairs, key=lambda pair: bool(
            set(VALVE) & set(words_of(pair[0].shown))))
    why = "header"
    if first is None and second is None and len(free) == 2:
        (first, second), why = free, "header, in the order of the columns"
    elif (first is None) != (second is None) and len(free) == 1:
        first, second = first or free[0], second or free[0]
    return [(channel, one, why) for channel, one in (("p1", first), ("p2", second)) if one]


def _others(left: list[Candidate], time: Candidate | None, source: Source
            ) -> list[tuple[str, Candidate, str]]:
    found = []
    positions = [one for one in left if one.header.quantity == "position" and _moves(one)]
    demanded = [one for one in positions if one.header.demand]
    measured = sorted((one for one in positions if not one.header.demand),
                      key=lambda one: not set(words_of(one.shown)) & set(ACTUAL))
    why = "header"
    if not demanded and len(measured) > 1:
        one, other = measured[:2]
        ahead = leads(one.values, other.values)
        measured, demanded = ([other], [one]) if ahead else ([one], [other])
        why = "values: one of the two positions is ahead of the other"
    found += [("x", one, why) for one in measured[:1]] + [("x_d", one, why)
                                                          for one in demanded[:1]]
    for one in left:
        quantity, header = one.header.quantity, one.header
        if quantity == "velocity" and not header.kind and not source.bag and not (
                set(_STRAIGHT) & set(words_of(one.shown))):
            quantity = "velocity" if _is_rate(one, measured[:1], time) else "turning"
        if quantity in ("turning", "velocity", "force"):
            name = {"turning": "omega", "velocity": "v", "force": "force"}[quantity]
            if header.demand:
                name = {"omega": "omega_d"}.get(name, "")
            if name and name not in [channel for channel, *_ in found]:
                found.append((name, one, "header"))
        elif quantity == "temperature" and "temperature" not in [c for c, *_ in found] and (
                np.nanmax(np.abs(one.values)) < HOTTEST):
            found.append(("temperature", one, "header"))
    return found


def _moves(one: Candidate) -> bool:
    return one.values.dtype.kind == "f" and bool(np.nanmax(one.values) > np.nanmin(one.values))


def _is_rate(one: Candidate, positions: list[Candidate], time: Candidate | None) -> bool:
    if not positions or time is None or time.values.dtype.kind == "M":
        return False
    scale = to_si(_time_guess(time, False).unit, "s")
    return is_rate_of(one.values, positions[0].values,
                      scale * float(np.median(steps_of(time.values))))


def _in_unit(channel: str, one: Candidate, why: str, rotary: bool, bag: bool) -> Guess:
    header = one.header
    told = f"{why}: '{one.shown}'" if why == "header" else why
    if header.kind in ("share", "counts"):
        return Guess(one, "", told, full=header.kind)
    if header.kind:
        return Guess(one, header.unit, told, sure=True)
    quantity = _UNITS_OF[channel]
    if rotary:
        quantity = {"position": "angle", "velocity": "turning", "force": "torque"}.get(
            quantity, quantity)
    if bag and (len(one.place) > 2 or one.place.get("field") != "data"):
        return Guess(one, "", f"{told}; SI, as the message type says")
    unit, values = likely_unit(quantity, one.values)
    if quantity == "turning" and {"w", "omega", "wd"} & set(words_of(one.shown)):
        unit, values = "rad/s", "its symbol"
    return Guess(one, unit, f"{told}; {unit} guessed from {values}")
