"""Words and verdicts on a parameter: converged, not excited, diverged."""

import math

import numpy as np

from eha_monitor.filters.results import ParameterEstimate
from eha_monitor.quantity import FLOOR, SYMBOLS, quantity, share, with_uncertainty
from eha_monitor.settings.monitor import Settings

CONVERGED = 0.10  # relative standard deviation
GAINED = 2.0  # so many times sharper than the prior, or the motion has told nothing
NEGATIVE = 3.0  # standard deviations below zero that no physical coefficient can be
HUGE = 100.0  # times the prior and its sigma: no longer a coefficient of this rig


def units_of(motion: str) -> dict[str, str]:
    """Return the units of B, beta_e and L as people write them."""
    damping = "N·m·s/rad" if motion == "rotary" else "N·s/m"
    return {"B": damping, "beta_e": "Pa", "L": "m³/(s·Pa)"}


def no_data(name: str, unit: str, reason: str) -> ParameterEstimate:
    """Return an estimate without a number."""
    return ParameterEstimate(name, math.nan, math.nan, unit, "no_data", reason)


def judge_parameter(name: str, value: float, stddev: float, unit: str, prior: float,
                    prior_stddev: float, largest: float = math.inf) -> ParameterEstimate:
    """Give a value its status from how much sharper it is than its prior.

    ``largest`` is more than the parameter can be.
    """
    symbol = SYMBOLS.get(name, name)
    if not (math.isfinite(value) and math.isfinite(stddev)):
        return ParameterEstimate(name, math.nan, math.nan, unit, "diverged",
                                 f"{symbol} is no longer a finite number")
    limit = min(HUGE * (prior + prior_stddev), largest)
    # Beyond the limit, the inverse of the value (a compliance) must be so within its own sigma.
    beyond = abs(value) > limit and (1.0 + NEGATIVE * stddev / abs(value)) / abs(value) < 1 / limit
    if value < -NEGATIVE * stddev or beyond:
        return ParameterEstimate(
            name, math.nan, math.nan, unit, "diverged",
            f"{symbol} went to {quantity(value, unit, 3)}, which is not physical: the model, the "
            "config or a sign is wrong")
    shown = with_uncertainty(value, stddev, unit)
    if stddev > CONVERGED * abs(value) or GAINED * stddev > prior_stddev:
        before = with_uncertainty(prior, prior_stddev, unit)
        return ParameterEstimate(
            name, value, stddev, unit, "not_excited",
            f"too little motion to identify {symbol}: {shown}, prior {before}")
    told = share(max(stddev / abs(value) if value else 0.0, FLOOR), 2)
    return ParameterEstimate(name, value, stddev, unit, "converged",
                             f"{symbol} = {shown}, identified to ± {told}")


def converged_where(value: np.ndarray, stddev: np.ndarray, prior: float, prior_stddev: float,
                    largest: float = math.inf) -> np.ndarray:
    """Return (n,) bool, where :func:`judge_parameter` would say ``converged``."""
    limit = min(HUGE * (prior + prior_stddev), largest)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        size = np.abs(value)
        beyond = (size > limit) & ((1.0 + NEGATIVE * stddev / size) / size < 1.0 / limit)
        lost = (value < -NEGATIVE * stddev) | beyond
        return (np.isfinite(value) & np.isfinite(stddev) & ~lost
                & ~(stddev > CONVERGED * size) & ~(prior_stddev < 2.0 * stddev))


def parameters_of(settings: Settings, one, two, lacking: tuple[str, str], either: float = 0.0
                  ) -> dict[str, ParameterEstimate]:
    """Return both parameters as the stages tell them; ``lacking`` says why one does not run.

    Parameters
    ----------
    one, two : with ``value`` and ``stddev``, SI; None where a stage does not run.
    either : relative difference of beta_e between two inputs that nothing tells apart.
    """
    units, first, second = units_of(settings.rig.motion), settings.stage_one, settings.stage_two
    b = no_data("B", units["B"], lacking[0]) if one is None else judge_parameter(
        "B", one.value, one.stddev, units["B"], first.prior, first.prior_stddev)
    beta = no_data("beta_e", units["beta_e"], lacking[1]) if two is None else judge_parameter(
        "beta_e", two.value, math.hypot(two.stddev, either * two.value), units["beta_e"],
        second.prior, second.prior_stddev, second.largest)
    return {"B": b, "beta_e": beta}
