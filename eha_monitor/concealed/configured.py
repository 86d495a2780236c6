"""What the nominal config says of the rig: the truth, a little off, or one number far off.

On a real rig every configured number is a little wrong, and now and then one is wrong by much: a
data sheet of another pump, a charge pressure that somebody turned.  The plant always runs on the
true numbers; only the config that goes with the recording is changed.
"""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from eha_monitor.concealed.cases import RIG, TOLERANCES, Case, rig_of

# Kind -> its share of the cases of ``mixed``.
SHARES = {"exact": 0.4, "within": 0.4, "beyond": 0.2}
KINDS = (*SHARES, "mixed")
BEYOND = (3.0, 10.0)  # tolerances by which one number is off
FARTHEST = 300.0  # factor by which nobody errs, not even in a leakage
# A number and an effect that are one equation: with both concealed there is no one answer.
TWINS = {"M": "added_mass", "D_p": "pump_flow_gain", "C_T": "cross_port_leakage",
         "K_pos": "drive_gain"}


def misconfigured(cases: Iterable[Case], seed: int, kind: str = "mixed") -> list[Case]:
    """Return the cases with the nominal configs of a kind; the i-th depends on seed and i only.

    Parameters
    ----------
    cases : whose nominal configs have the true numbers.
    seed : of the draws.
    kind : ``exact``; ``within``: each number off by a normal draw of one tolerance; ``beyond``:
        one number off by 3 to 10 tolerances, the others exact; ``mixed``: each at its share.
    """
    if kind not in KINDS:
        raise ValueError(f"no kind {kind!r} of rig numbers, expected one of {', '.join(KINDS)}")
    return [_one(case, np.random.default_rng([seed, i, 8]), kind) for i, case in enumerate(cases)]


def _one(case: Case, rng: np.random.Generator, kind: str) -> Case:
    drawn = str(rng.choice(list(SHARES), p=list(SHARES.values())))
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
