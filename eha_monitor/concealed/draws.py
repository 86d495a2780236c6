"""Draws for the trial: rigs, motions, strengths, sets of effects, what the config says of the rig.

On a real rig every configured number is a little wrong, and now and then one is wrong by much: a
data sheet of another pump, a charge pressure that somebody turned.  The plant always runs on the
true numbers; only the config that goes with the recording is changed.
"""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from eha_monitor.concealed.cases import RIG, TOLERANCES, Case, effect_names, outside_names, rig_of
from eha_monitor.concealed.hidden import SIGNED

# At most one of each: with two, one contains or undoes the other.
FAMILIES = (
    ("coulomb_friction", "stribeck_friction", "asymmetric_friction", "pressure_friction",
     "presliding_friction"),
    ("cross_port_leakage", "turbulent_leakage", "leakage_offset"),
    ("pump_flow_gain", "pump_volumetric_loss"),
    ("drive_lag", "command_delay", "feedback_delay", "position_delay"),
    ("pressure_offset", "pressure_scale", "pressure_drift"),
    ("external_leakage", "anti_cavitation"),
    ("backlash", "position_quantisation"),
)
MOTIONS = {"rich": 0.7, "short": 0.15, "triangle": 0.15}
CHANNELS = {
    ("x", "x_d", "omega", "p1", "p2"): 0.85,
    ("x", "x_d", "omega"): 0.075,
    ("x", "p1", "p2"): 0.075,
}
# Effects in a case -> share of the cases; "outside" is one that has no name in the catalogue.
SETS = {0: 0.15, 1: 0.45, 2: 0.2, 3: 0.1, "outside": 0.1}
STRENGTHS = (0.03, 1.2)
# Half of all controllers are computers; half of these read the sensor that is recorded.
DRIVE_SHARES = {"analogue": 0.5, "digital": 0.25, "digital_own": 0.25}
PAPER_RIG = 0.3  # share of the cases on the paper's own rig
# Kind -> its share of the cases of ``mixed``.
SHARES = {"exact": 0.4, "within": 0.4, "beyond": 0.2}
KINDS = (*SHARES, "mixed")
BEYOND = (3.0, 10.0)  # tolerances by which one number is off
FARTHEST = 300.0  # factor by which nobody errs, not even in a leakage
# A number and an effect that are one equation: with both concealed there is no one answer.
TWINS = {"M": "added_mass", "D_p": "pump_flow_gain", "C_T": "cross_port_leakage",
         "K_pos": "drive_gain"}


def draw_rig(rng: np.random.Generator) -> dict[str, float]:
    """Return a rig about the paper's whose position loop is stable with a margin."""
    paper = {key: value for key, (_, value) in RIG.items()}
    rig = {
        "A": paper["A"] * rng.uniform(0.7, 1.5),
        "V": paper["V"] * rng.uniform(0.8, 1.8),
        "M": rng.uniform(12.0, 30.0),
        "B": float(np.exp(rng.uniform(np.log(400.0), np.log(1800.0)))),
        "beta_e": float(np.exp(rng.uniform(np.log(4e8), np.log(1e9)))),
        "C_T": paper["C_T"] * rng.uniform(0.8, 2.0),
        "D_p": paper["D_p"] * rng.uniform(0.8, 1.5),
        "amplitude": rng.uniform(0.6, 1.1),
    }
    # The resonance has the loop gain K/(B/M); below one half it stays stable with any lag.
    loop = min(rng.uniform(5.0, 9.0), 0.45 * rig["B"] / (rig["M"] + 8.0))
    rig["K_pos"] = loop * rig["A"] / rig["D_p"]
    rig["amplitude"] = min(rig["amplitude"], 27000.0 / rig["K_pos"])  # a plausible pump speed
    return {key: float(f"{value:.4g}") for key, value in rig.items()}


def draw_cases(n: int, seed: int, *, rig: str = "mixed", sets: dict = SETS) -> list[Case]:
    """Draw ``n`` cases; the same seed gives the same cases, and fewer are a head of more.

    Whatever ``rig`` is (what the nominal configs say of it, one of :data:`KINDS`), effects,
    motions and true rigs of a seed are the same.  ``sets`` : effects in a case -> its share.
    """
    cases = [replace(_draw(f"c{i + 1:03d}", np.random.default_rng([seed, i]), sets),
                     drive=_chosen(np.random.default_rng([seed, i, 9]), DRIVE_SHARES))
             for i in range(n)]
    return misconfigured(cases, seed, rig)


def _chosen(rng: np.random.Generator, shares: dict):
    """Return one of some kinds, each at its share."""
    return list(shares)[rng.choice(len(shares), p=list(shares.values()))]


def _draw(name: str, rng: np.random.Generator, sets: dict) -> Case:
    count, motion, channels = (_chosen(rng, shares) for shares in (sets, MOTIONS, CHANNELS))
    noise = float(rng.choice([1.0, 3.0, 10.0], p=[0.8, 0.1, 0.1]))
    rig = {} if rng.random() < PAPER_RIG else draw_rig(rng)
    names = ([str(rng.choice(outside_names()))] if count == "outside"
             else draw_names(int(count), rng))
    effects, options = [], {}
    for one in names:
        low, high = STRENGTHS
        strength = float(np.exp(rng.uniform(np.log(low), np.log(high))))
        if count == "outside":
            strength = float(rng.uniform(0.5, 1.2))
        if one in SIGNED and one != "cross_port_leakage" and rng.random() < 0.5:
            strength = -strength
        if one in ("pressure_offset", "pressure_scale", "pressure_drift"):
            options[one] = {"sensor": str(rng.choice(["p1", "p2", "both"]))}
        effects.append((one, float(f"{strength:.4g}")))
    return Case(name, tuple(effects), motion=motion, seed=int(rng.integers(2**31)), noise=noise,
                channels=channels, rig=rig, options=options)


def draw_names(count: int, rng: np.random.Generator) -> list[str]:
    """Return ``count`` names of the catalogue, at most one of each family."""
    chosen: list[str] = []
    for name in rng.permutation(effect_names()):
        name = str(name)
        family = next((f for f in FAMILIES if name in f), (name,))
        if len(chosen) < count and not any(one in family for one in chosen):
            chosen.append(name)
    return chosen


def misconfigured(cases: Iterable[Case], seed: int, kind: str = "mixed") -> list[Case]:
    """Return the cases with the nominal configs of a kind; the i-th depends on seed and i only.

    ``exact``: they say the true numbers, as those of ``cases``; ``within``: each number is off by
    a normal draw of one tolerance; ``beyond``: one number is off by 3 to 10 tolerances, the others
    are exact; ``mixed``: each at its share.
    """
    if kind not in KINDS:
        raise ValueError(f"no kind {kind!r} of rig numbers, expected one of {', '.join(KINDS)}")
    return [_one(case, np.random.default_rng([seed, i, 8]), kind) for i, case in enumerate(cases)]


def _one(case: Case, rng: np.random.Generator, kind: str) -> Case:
    drawn = _chosen(rng, SHARES)
    kind = drawn if kind == "mixed" else kind
    if kind == "exact":
        return case
    values = _within(case, rng) if kind == "within" else _beyond(case, rng)
    return replace(case, nominal=case.nominal | values)


def _within(case: Case, rng: np.random.Generator) -> dict[str, float]:
    """Return all numbers, each off by a normal draw of one tolerance."""
    spreads = TOLERANCES | case.tolerances
    while True:
        said = _said(case, {symbol: spread * rng.standard_normal()
                            for symbol, spread in spreads.items()})
        if _possible(case, said):
            return said


def _beyond(case: Case, rng: np.random.Generator) -> dict[str, float]:
    """Return one number, off by 3 to 10 tolerances; none that a concealed effect is twin to."""
    hidden = {name for name, _ in case.effects}
    spreads = TOLERANCES | case.tolerances
    true = rig_of(case)
    symbols = [symbol for symbol in TOLERANCES
               if TWINS.get(symbol) not in hidden and true[RIG[symbol][0]] > 0.0]
    symbol = str(rng.choice(symbols))
    nearest = BEYOND[0] * spreads[symbol]
    farthest = max(min(BEYOND[1] * spreads[symbol], np.log(FARTHEST)), nearest)
    while True:
        said = _said(case, {symbol: rng.choice([-1.0, 1.0]) * rng.uniform(nearest, farthest)})
        if _possible(case, said):
            return said


def _said(case: Case, errors: dict[str, float]) -> dict[str, float]:
    """Return what the config says, by symbol, given the errors of the logarithms."""
    true = rig_of(case)
    return {symbol: float(f"{true[RIG[symbol][0]] * np.exp(error):.6g}")
            for symbol, error in errors.items() if true[RIG[symbol][0]] > 0.0}


def _possible(case: Case, said: dict[str, float]) -> bool:
    """Tell whether a config may say so: the make-up path is part of the leakage."""
    true = rig_of(case)
    return said.get("G", true[RIG["G"][0]]) <= said.get("C_T", true[RIG["C_T"][0]])
