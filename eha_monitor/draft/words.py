"""What headers call the quantities of an actuator, in five languages of Europe."""

import re
import unicodedata
from dataclasses import dataclass

from eha_monitor.settings.channels import check_unit, unit_of

# Quantity -> parts of long words, and whole short words.
ANGLES = ("angle", "angulo", "winkel", "angolo", "rotation")
_LONG = {
    "time": ("time", "zeit", "tiempo", "datum", "uhrz", "heure", "fecha", "timestamp", "epoch"),
    "pressure": ("druck", "press", "presion", "port"),
    "temperature": ("temperat", "temp", "oltemp"),
    "turning": ("drehzahl", "rpm", "omega", "umdreh", "giri", "shaft", "regime", "tours"),
    "velocity": ("veloc", "geschwind", "vitesse", "speed", "tempo"),
    "force": ("force", "kraft", "fuerza", "forza", "loadcell", "effort", "torque", "moment",
              "couple"),
    "position": ("posit", "posic", "posiz", "weg", "lage", "hub", "course", "deplac", "desplaz",
                 "carrera", "stroke", "displac", "encoder", "geber", "lvdt", "travel", *ANGLES),
}
_SHORT = {
    "time": ("t", "temps", "ms", "sec", "hora", "ts", "tempo"),
    "pressure": ("p", "pr", "pg", "pa", "pb", "pk"),
    "temperature": (), "turning": ("n", "w", "rps"),
    "velocity": ("v", "vel", "xdot", "dot", "dx", "vx"),
    "force": ("f", "tq", "fz", "fx", "load", "cell", "par"),
    "position": ("x", "s", "pos", "y", "q", "qm", "xact", "xist", "xmeas"),
}
DEMAND_LONG = ("soll", "setpoint", "command", "demand", "desired", "target", "reference",
               "consign", "referenc", "vorgabe", "richiest")
DEMAND_SHORT = ("set", "sp", "ref", "d", "des", "dem", "cmd", "tgt", "xd", "xref", "xsoll", "qg",
                "wd", "nd", "r", "ordre")  # Motordrehzahl has one inside
_TURNS = ("pump", "pumpe", "motor", "pompe", "bomba", "moteur", "pompa", "motore", "shaft",
          "welle")
NOT_MEASURED = ("current", "strom", "voltage", "spannung", "power", "leistung", "status", "error",
                "fehler", "flow", "durchfluss", "volumenstrom", "valve", "ventil", "accel",
                "alarm", "erreur", "debit", "courant", "corriente", "caudal")
_ONE = ("a", "1", "k", "ka", "pa", "pk", "kolben", "kolbenseite", "boden", "cap", "blind",
        "bore", "fond", "base", "left", "links", "gauche", "piston")
_TWO = ("b", "2", "pb", "st", "stange", "stangenseite", "ringseite", "ring", "rod", "tige",
        "vastago", "annulus", "annular", "right", "rechts", "droite", "stelo")
_OTHER_PRESSURE = ("supply", "tank", "system", "speise", "versorg", "reservoir", "charge",
                   "return", "speicher", "accumulator", "alimentation", "ambient", "delta", "diff")
_OTHER_SHORT = ("ps", "pt", "p0", "dp", "t", "0")
_SHARES = {"%": "share", "percent": "share", "prozent": "share", "pct": "share"}
_COUNTS = ("counts", "count", "raw", "inc", "digits", "digit", "adc", "lsb", "inkremente", "cnt",
           "roh", "rohwert")
_TIMES = {"s": "s", "sec": "s", "sek": "s", "ms": "ms", "us": "us", "µs": "us", "μs": "us",
          "ns": "ns", "min": "min", "h": "hour"}
# What a last word of a name without brackets may be as a unit; single letters are not.
_TRAILING = {"mm", "cm", "um", "µm", "bar", "mbar", "barg", "bara", "psi", "psig", "kpa", "mpa",
             "pa", "rpm", "upm", "kn", "deg", "degc", "degf", "ms", "us", "ns", "rads", "percent",
             "pct", "mmps",
             "counts", "raw", "sek", "inch"}
_SAID = {"rads": "rad/s", "mpa": "MPa", "kpa": "kPa", "pa": "Pa", "kn": "kN", "mmps": "mm/s",
         "upm": "rpm", "degc": "degC", "1/min": "rpm", "u/min": "rpm", "min-1": "rpm",
         "tr/min": "rpm", "min^-1": "rpm", "barg": "bar gauge", "psig": "psi gauge",
         "deg c": "degC", "deg f": "degF", "°c": "degC", "c": "degC", "nm": "N*m",
         "zoll": "inch", "bar": "bar", "mm": "mm"}
_KINDS = {"meter": "position", "meter / second": "velocity", "radian / second": "turning",
          "radian": "angle", "kilogram / meter / second ** 2": "pressure",
          "kilogram * meter / second ** 2": "force",
          "kilogram * meter ** 2 / second ** 2": "torque", "degC": "temperature"}
_BRACKETS = re.compile(
    r"\s*[\[({<]\s*([^\[\](){}<>]{1,12}(?:\((?:g|a|abs|rel|ü)\))?)\s*[\])}>]\s*$")
# Behind a unit of pressure: what it is counted from.
_OVER = ("g", "a", "gauge", "abs", "absolute", "rel", "relative", "ü")
_OIL = ("oil", "oel", "ol", "huile", "aceite", "olio", "fluid", "tank")  # what is warm
_AFTER = re.compile(r"(?:\s+in\s+|\s*/\s*|,\s*)([^\s/,]{1,6}(?:/[^\s/,]{1,4})?)$")


@dataclass(frozen=True)
class Header:
    """What a header says of its column."""

    unit: str  # as a map takes it, or ""; of a time ``ms`` and so on
    kind: str  # quantity that the unit is of, ``share`` or ``counts``; "" without a unit
    quantity: str  # of unit and words together; "" where nothing tells
    demand: bool  # it is what was asked for, not what was measured
    chamber: int  # of a pressure 1 or 2, 0 where it is not said, -1 where it is another pressure


def plain(text: str) -> str:
    """Return a text without accents and capitals."""
    parts = unicodedata.normalize("NFKD", text.replace("ß", "ss"))
    return "".join(c for c in parts if not unicodedata.combining(c)).casefold()


def words_of(name: str) -> list[str]:
    """Return the words of a name: parted at signs, capitals and digits."""
    apart = re.sub(r"(?<=[a-zà-ÿ])(?=[A-ZÀ-Þ])|(?<=[A-Z])(?=[A-Z][a-z]{2})", " ", name)
    apart = re.sub(r"(?<=[A-Za-z])(?=\d)|(?<=\d)(?=[A-Za-z])", " ", apart)
    return [word for word in re.split(r"[^a-z0-9µ%]+", plain(apart)) if word]


def kind_of(unit: str) -> tuple[str, str]:
    """Return a unit as a map takes it, and the quantity that it is of; twice "" if it is none."""
    low = unit.strip().casefold()
    if low in _TIMES:
        return _TIMES[low], "time"
    if low in _SHARES:
        return "%", "share"
    if low in _COUNTS:
        return "counts", "counts"
    if low in ("v", "mv", "ma"):  # of a transducer: how much one is, somebody has to tell
        return "counts", "counts"
    if low in ("a", "-", ""):
        return "", ""
    text = _SAID.get(low, unit.strip()) if unit.strip() not in ("mPa", "nm") else unit.strip()
    try:
        return text, _KINDS.get(unit_of(text).si, "")
    except ValueError:
        return "", ""


def parted(name: str) -> tuple[str, str, str]:
    """Return a header's name without its unit, the unit as a map takes it, and its quantity."""
    first, _, last = name.strip().rpartition(" ")
    if first and "/" in last and kind_of(last)[1]:  # mm/s is no second
        return (first.strip(), *kind_of(last))
    for pattern in (_BRACKETS, _AFTER):
        match = pattern.search(name)
        if match:
            unit, kind = kind_of(match[1])
            if kind:
                return name[:match.start()].strip(" _-"), unit, kind
    words = re.split(r"[\s_.\-]+", name.strip())
    if len(words) > 3 and words[-2] == "per":  # rad_per_s
        del words[-2]
    if len(words) > 2 and words[-1] in ("s", "min"):  # n_rad_s, v_mm_s: no "/" is in a name
        unit, kind = kind_of("/".join(words[-2:]))
        if kind in ("velocity", "turning"):
            return " ".join(words[:-2]), unit, kind
    if len(words) > 2 and words[-1].casefold() in _OVER and (
            words[-2].casefold() in _TRAILING):  # p_A bar g
        unit, kind = kind_of(" ".join(words[-2:]))
        if kind == "pressure":
            return " ".join(words[:-2]), unit, kind
    if words and (words[-1].casefold() in _TRAILING or words[-1] == "%") and (
            len(words) > 1 or words[0] not in ("pA", "pa", "PA", "in")):
        unit, kind = kind_of(words[-1])
        if kind:
            rest = " ".join(words[:-1])
            return rest or name, unit, kind
    if len(words) > 1 and words[-1] in ("s", "m", "N", "C", "K"):
        unit, kind = kind_of(words[-1])
        bare = words_of(" ".join(words[:-1]))
        warm = kind == "temperature" and not set(bare).isdisjoint(_OIL)
        if warm or kind == _quantity(bare):  # t_s, x_m, F_N, oil_C; p_s is no time
            return " ".join(words[:-1]), unit, kind
    return name, "", ""


def read(name: str, unit: str = "") -> Header:
    """Return what a header says; ``unit`` of a row of units, where there is one."""
    bare, own, kind = parted(name)
    if unit:
        given, of = kind_of(unit.strip().strip("[](){} "))
        own, kind = (given, of) if of else (own, kind)
    words = words_of(bare)
    joined = "".join(words)
    if own == "counts" or (not kind and any(word in _COUNTS for word in words)):
        own, kind = "counts", "counts"
    demand = any(part in joined for part in DEMAND_LONG) or any(
        word in DEMAND_SHORT for word in words)
    quantity = {"angle": "position", "torque": "force"}.get(kind, kind)
    if quantity in ("", "share", "counts"):
        quantity = _quantity(words)
        if not quantity and demand:
            quantity = "position"
    if any(part in joined for part in NOT_MEASURED) and quantity != "pressure":
        quantity = ""
    return Header(own, kind, quantity, demand, _chamber(words) if quantity == "pressure" else 0)


def _quantity(words: list[str]) -> str:
    """Return the quantity that words name, or ""."""
    joined = "".join(words)
    if "temps" in words:
        return "time"
    if "t" in words and not set(words).isdisjoint(_OIL):  # T_oil
        return "temperature"
    for quantity, parts in _LONG.items():
        if any(part in joined for part in parts):
            # A pump's speed is of its shaft, whatever it is called; "velocity" is the piston's.
            if quantity == "velocity" and any(part in joined for part in _TURNS):
                return "turning"
            return quantity
    for quantity, known in _SHORT.items():
        if any(word in known for word in words):
            return quantity
    return ""


def _chamber(words: list[str]) -> int:
    """Return 1 or 2 of a pressure's name, 0 where it is not said, -1 for another pressure."""
    joined = "".join(words)
    if any(part in joined for part in _OTHER_PRESSURE) or joined in _OTHER_SHORT:
        return -1
    # A number counts most: "pressure/chamber_1 a".
    for numbers, chamber in ((("1",), 1), (("2",), 2), (_ONE, 1), (_TWO, 2)):
        if any(word in numbers for word in words):
            return chamber
    long = [(part, chamber) for parts, chamber in ((_ONE, 1), (_TWO, 2)) for part in parts
            if len(part) > 3 and part in joined]
    if long:
        return max(long, key=lambda one: len(one[0]))[1]
    return 0


def other_quantity(name: str, channel: str, unit: str, rotary: bool = False) -> str:
    """Return the unit that a column's name says, where no such channel can be in it; else "".

    A share or counts are of anything.

    ``channel``, ``unit`` : what the column is taken for, and in which unit; "": SI.
    """
    _, said, kind = parted(name)
    if kind in ("", "share", "counts"):
        return ""
    try:
        for of in (said, unit or said):
            check_unit(channel, of, rotary)
    except ValueError:
        return said
    return ""


def beside_chamber(name: str) -> list[str]:
    """Return the words of a pressure's name without those that name its chamber."""
    return [word for word in words_of(name) if word not in (*_ONE, *_TWO)]
