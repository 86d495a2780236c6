"""Marks of learned terms: what no catalogue has against the model that was learned of it."""

import math
from collections.abc import Callable, Sequence
from statistics import median

NEAR = 0.03  # of B and beta_e, beside a learned term
INSIDE, SIGMAS = 0.9, 2.0  # share of the places at which the true curve is in the band
# As :data:`score.MARKS`: words, aim as text and as a number, whether more is better.
LEARNED = {
    "learned_told": ("outside: a term learned of it", "", None, True),
    "learned_removed": ("outside: error on unseen data removed by it, median", "at least 80 %",
                        0.8, True),
    "learned_worse": ("outside: worse on unseen data than the model before", "never", 0.0, False),
    "learned_B": ("outside: B within 3 % beside a learned term", "", None, True),
    "learned_beta_e": ("outside: bulk modulus within 3 % beside a learned term", "", None, True),
    "learned_inside": ("outside: true curve in the band at 90 % of the places, where the term is "
                       "of the right signals", "", None, True),
    "learned_shape": ("outside: signals and shape of the formula right", "at least 50 %", 0.5,
                      True),
}
# What was concealed -> signals that it is a function of, its true curve (None where the key does
# not hold all its numbers), names of its shape.
LAWS: dict[str, tuple[tuple[str, ...], Callable[[float, dict], float] | None, tuple[str, ...]]] = {
    "position_friction_hump": (("x", "v"), lambda x, p: p["F"] * math.exp(
        -(((x - p["x"]) / p["width"]) ** 2)), ("a bump", "a bump on a constant")),
    "position_dependent_leak": (("x", "dp"), lambda x, p: -p["L"] * math.exp(
        -(((x - p["x"]) / p["width"]) ** 2)), ("a bump", "a bump on a constant")),
    "lever_load": (("x",), lambda x, p: p["F"] * math.sin(2.0 * math.pi * x / p["length"]),
                   ("a sine",)),
    "end_cushion": (("x", "v"), lambda x, p: p["d"] * max(abs(x) - p["x"], 0.0),
                    ("a rise beyond",)),
    "pump_ripple": (("angle", "omega"), None, ("a ripple", "a ripple with its second harmonic")),
    "widening_gap": (("dp",), lambda dp, p: -p["L_3"] * dp**3, ("a cube",)),
}


def learned_row(truth: dict, answer: dict) -> dict | None:
    """Return how a learned term compares with what was concealed; None where that has a name.

    Returns
    -------
    dict
        ``told``, ``removed`` of the error on unseen data (0 without a term), ``errors`` relative
        of B and beta_e, ``inside`` the share of the places at which the true curve is in the
        band, ``shape`` whether the formula's is right; None where it does not apply.
    """
    outside = [one for one in truth["effects"] if not one["in_catalogue"]]
    if not outside:
        return None
    terms = answer.get("learned") or []
    if not terms:
        return {"told": False, "removed": 0.0, "errors": {}, "inside": None,
                "shape": False}
    term, after = terms[0], answer["parameters"]["after"]
    errors = {name: abs(after[name]["value"] / truth[name] - 1.0)
              for name in ("B", "beta_e") if name in after}
    of, law, shapes = LAWS.get(outside[0]["name"], ((), None, ()))
    inside = None
    found = tuple(term["of"]) == of and term["balance"] == outside[0]["balance"]
    if law is not None and found:
        parameters = outside[0]["parameters"]
        near = [abs(y - law(x, parameters)) <= SIGMAS * band
                for x, y, band in zip(term["x"], term["curve"], term["band"], strict=True)]
        inside = sum(near) / len(near)
    return {"told": True, "removed": term["held_out_error_removed"], "errors": errors,
            "inside": inside, "shape": found and term["shape"] in shapes}


def learned_score(rows: Sequence[dict]) -> dict[str, float | None]:
    """Return the marks of all cases with something outside the catalogue that shows."""
    mine = [row for row in rows if row.get("learned") and row["detectable"]]
    told = [row["learned"] for row in mine if row["learned"]["told"]]
    curves = [one["inside"] >= INSIDE for one in told if one["inside"] is not None]

    def share(flags: list[bool]) -> float | None:
        return sum(flags) / len(flags) if flags else None

    return {
        "learned_told": share([row["learned"]["told"] for row in mine]),
        "learned_removed": median(row["learned"]["removed"] for row in mine) if mine else None,
        "learned_worse": share([row["after_rms"] > 1.01 * row["before_rms"] for row in mine
                                if row["before_rms"] and row["after_rms"]]),
        "learned_B": share([one["errors"]["B"] <= NEAR for one in told if "B" in one["errors"]]),
        "learned_beta_e": share([one["errors"]["beta_e"] <= NEAR for one in told
                                 if "beta_e" in one["errors"]]),
        "learned_inside": share(curves),
        "learned_shape": share([row["learned"]["shape"] for row in mine]),
    }
