"""Forty mistakes of people, each as it stands in their config, with what it is in truth.

Each edits the config that is right for a base recording.  The truth is in this file only; the
commands see a recording and a config, as they would from anybody.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

RPM = 2 * math.pi / 60
ATMOSPHERE = 101325.0
P_BOTH, X_BOTH = ("p1", "p2"), ("x", "x_d")


@dataclass(frozen=True)
class Truth:
    """What a finding has to say to be right.

    Attributes
    ----------
    kinds : of the contract; ``column`` is one column in place of another, under any kind.
    names : channels or config keys, of which one must be named.
    factor : the config's number over the right one; a finding that is about a size must give it,
        its inverse, or one of ``words``.
    words : pattern of words that say the size, e.g. ``mm``.
    mentions : pattern that the finding must hold too, for a rival of the truth that the recording
        cannot tell from it.
    """

    kinds: tuple[str, ...]
    names: tuple[str, ...]
    factor: float | None = None
    words: str = ""
    mentions: str = ""


@dataclass(frozen=True)
class Mistake:
    """One mistake: ``edit`` changes the right config (plain data, in place)."""

    name: str
    base: str
    words: str
    edit: Callable[[dict], None]
    truths: tuple[Truth, ...]


def _column(tree: dict, channel: str) -> dict:
    return tree["table"]["columns"][channel]


def scale(channels: tuple[str, ...] | str, factor: float) -> Callable[[dict], None]:
    """Return an edit: the scale, and the offset with it, ``factor`` times what is right."""
    channels = (channels,) if isinstance(channels, str) else channels

    def edit(tree):
        for channel in channels:
            one = _column(tree, channel)
            for key in ("scale", "negative_scale", "offset"):
                if key in one or key == "scale":
                    one[key] = one.get(key, 1.0) * factor
    return edit


def shift(channels: tuple[str, ...], offset: float) -> Callable[[dict], None]:
    """Return an edit: an offset in Pa more than is right."""
    def edit(tree):
        for channel in channels:
            one = _column(tree, channel)
            one["offset"] = one.get("offset", 0.0) + offset
    return edit


def swap(first: str, second: str) -> Callable[[dict], None]:
    """Return an edit: two columns, with their scales, change places."""
    def edit(tree):
        columns = tree["table"]["columns"]
        columns[first], columns[second] = columns[second], columns[first]
    return edit


def take(channel: str, other: str | None = None, header: str | None = None
         ) -> Callable[[dict], None]:
    """Return an edit: ``channel`` reads the column of ``other``, or the one named ``header``."""
    def edit(tree):
        column = _column(tree, other)["column"] if other else header
        _column(tree, channel)["column"] = column
    return edit


def number(factor: float, *keys: str) -> Callable[[dict], None]:
    """Return an edit: rig numbers ``factor`` times what is right."""
    def edit(tree):
        for key in keys:
            value = tree["rig"][key]
            if isinstance(value, str):
                figure, unit = value.split(" ", 1)
                tree["rig"][key] = f"{float(figure) * factor:.6g} {unit}"
            else:
                tree["rig"][key] = value * factor
    return edit


def time_scale(factor: float) -> Callable[[dict], None]:
    """Return an edit: seconds per unit of the time column ``factor`` times what is right."""
    def edit(tree):
        tree["table"]["time_scale"] = tree["table"].get("time_scale", 1.0) * factor
    return edit


def _unit(names, factor, words="", *, rival=(), mentions="") -> tuple[Truth, ...]:
    """Return the truth of a wrong size, and of the rival that does the same."""
    names = (names,) if isinstance(names, str) else names
    truth = (Truth(("unit",), names, factor, words),)
    if rival:
        truth += (Truth(("unit",), rival, factor, words, mentions or "|".join(names)),)
    return truth


def _sign(*names, rival=(), mentions="") -> tuple[Truth, ...]:
    truth = (Truth(("sign",), names),)
    if rival:
        truth += (Truth(("sign", "swapped"), rival, mentions=mentions),)
    return truth


SWAPPED = (Truth(("swapped",), P_BOTH),)
TIME = ("time", "time_scale", "sample_time", "t")
AREAS = ("area_1", "area_2", "area", "areas")
E, U = "equal", "single_rod"
MM = r"\bmm\b|millimet"
MISTAKES = (
    Mistake("e_swapped", E, "p1 and p2 swapped", swap("p1", "p2"), SWAPPED),
    Mistake("e_x_mm", E, "x in mm taken as m", scale("x", 1e3), _unit("x", 1e3, MM)),
    Mistake("e_x_xd_mm", E, "x and x_d in mm taken as m", scale(X_BOTH, 1e3),
            _unit(X_BOTH, 1e3, MM)),
    Mistake("e_p_kpa", E, "both pressures in kPa taken as Pa", scale(P_BOTH, 1e-3),
            _unit(P_BOTH, 1e-3, r"\bkPa\b")),
    Mistake("e_p2_kpa", E, "p2 alone in kPa taken as Pa", scale("p2", 1e-3),
            _unit("p2", 1e-3, r"\bkPa\b")),
    Mistake("e_pump_reversed", E, "pump speed reversed", scale("omega", -1.0), _sign("omega")),
    Mistake("e_x_reversed", E, "x reversed", scale("x", -1.0),
            _sign("x", rival=P_BOTH, mentions=r"\bx\b")),
    Mistake("e_x_xd_reversed", E, "x and x_d reversed", scale(X_BOTH, -1.0),
            _sign("x", rival=(*P_BOTH, "omega"), mentions=r"\bx\b")),
    Mistake("e_xd_reversed", E, "x_d reversed", scale("x_d", -1.0), _sign("x_d")),
    Mistake("e_rpm", E, "rpm taken as rad/s", scale("omega", 1 / RPM),
            _unit("omega", 1 / RPM, r"\brpm\b|rev/min|1/min", rival=("pump_displacement",),
                  mentions="speed|omega")),
    Mistake("e_gauge", E, "gauge pressures taken as absolute", shift(P_BOTH, -ATMOSPHERE),
            (Truth(("offset",), P_BOTH, None, "", ""),)),
    Mistake("e_mass", E, "mass ten times too large", number(10.0, "mass"),
            _unit("mass", 10.0, r"\bten\b", rival=(*P_BOTH, "force"))),
    Mistake("e_diameter", E, "diameter in m taken as area in m²",
            number(0.01236 / 1.2e-4, "area_1", "area_2"),
            _unit(AREAS, 0.01236 / 1.2e-4, r"diameter|hundred")),
    Mistake("e_litres", E, "volumes in litres taken as m³", number(1e3, "volume_1", "volume_2"),
            _unit(("volume_1", "volume_2", "volume", "volumes"), 1e3, r"litre|cm.?3|cm³")),
    Mistake("e_time", E, "time ten times too long", time_scale(10.0), _unit(TIME, 10.0, "ten")),
    Mistake("e_xd_as_x", E, "the demanded position's column taken for x", take("x", "x_d"),
            (Truth(("column",), ("x", "x_d")),)),
    Mistake("e_p1_twice", E, "p1's column taken for p2 too", take("p2", "p1"),
            (Truth(("column",), P_BOTH),)),
    Mistake("e_omega_as_x", E, "the pump speed's column taken for x", take("x", "omega"),
            (Truth(("column",), ("x",)),)),
    Mistake("u_swapped", U, "p1 and p2 swapped", swap("p1", "p2"), SWAPPED),
    Mistake("u_inch", U, "x scaled as if it were in inches", scale("x", 25.4),
            _unit("x", 25.4, r"inch")),
    Mistake("u_mpa", U, "both pressures in bar taken as MPa", scale(P_BOTH, 10.0),
            _unit(P_BOTH, 10.0, r"\bMPa\b|\bten\b", rival=("mass",), mentions="pressure|p1")),
    Mistake("u_p1_bar", U, "p1 alone in bar taken as Pa", scale("p1", 1e-5),
            _unit("p1", 1e-5, r"\bbar\b")),
    Mistake("u_pump_reversed", U, "pump speed reversed", scale("omega", -1.0), _sign("omega")),
    Mistake("u_rpm_twice", U, "rad/s taken as rpm", scale("omega", RPM),
            _unit("omega", RPM, r"\brpm\b|rev/min|1/min", rival=("pump_displacement",),
                  mentions="speed|omega")),
    Mistake("u_x_xd_reversed", U, "x and x_d reversed", scale(X_BOTH, -1.0),
            _sign("x", rival=(*P_BOTH, "omega"), mentions=r"\bx\b")),
    Mistake("u_p2_gauge", U, "p2 gauge, p1 absolute", shift(("p2",), -ATMOSPHERE),
            (Truth(("offset",), P_BOTH),)),
    Mistake("u_mass", U, "mass ten times too small", number(0.1, "mass"),
            _unit("mass", 0.1, r"\bten\b", rival=(*P_BOTH, "force"))),
    Mistake("u_area", U, "areas ten times too small", number(0.1, "area_1", "area_2"),
            _unit(AREAS, 0.1, r"\bten\b")),
    Mistake("u_temperature", U, "the oil's temperature taken for p1",
            take("p1", header="Oil (C)"), (Truth(("column",), ("p1",)),)),
    Mistake("u_per_revolution", U, "displacement per revolution taken as per radian",
            number(2 * math.pi, "pump_displacement"),
            _unit("pump_displacement", 2 * math.pi, r"revolution|2 ?π|2 ?pi", rival=("omega",),
                  mentions="displacement")),
    Mistake("u_ms", U, "time in s taken as ms", time_scale(1e-3), _unit(TIME, 1e-3, r"\bms\b")),
    Mistake("ivliev_swapped", "ivliev", "p1 and p2 swapped", swap("p1", "p2"), SWAPPED),
    Mistake("ivliev_mm", "ivliev", "x and x_d in mm taken as m", scale(X_BOTH, 1e3),
            _unit(X_BOTH, 1e3, MM)),
    Mistake("ivliev_bar", "ivliev", "both pressures in bar taken as Pa", scale(P_BOTH, 1e-5),
            _unit(P_BOTH, 1e-5, r"\bbar\b")),
    Mistake("emps_kn", "emps", "force in kN taken as N", scale("force", 1e-3),
            _unit("force", 1e-3, r"\bkN\b", rival=("mass",))),
    Mistake("emps_reversed", "emps", "force reversed", scale("force", -1.0),
            _sign("force", rival=("x",), mentions="force")),
    Mistake("emps_mass", "emps", "mass ten times too large", number(10.0, "mass"),
            _unit("mass", 10.0, r"\bten\b", rival=("force",))),
    Mistake("hsm_degrees", "hsm150", "angle in degrees taken as rad, speed in rad/s",
            scale("x", 180 / math.pi), _unit("x", 180 / math.pi, r"degree|\bdeg\b|°",
                                             rival=("v",), mentions=r"\bx\b|angle|position")),
    Mistake("seals_bar", "seals", "p2 in bar taken as Pa", scale("p2", 1e-5),
            _unit("p2", 1e-5, r"\bbar\b")),
    Mistake("sim_x_xd_mm", "sim", "x and x_d written in mm, taken as m", scale(X_BOTH, 1e3),
            _unit(X_BOTH, 1e3, MM)),
)
