"""What a suspect is, which of them exclude each other, and which are of one family."""

from collections.abc import Iterable

import numpy as np

from eha_monitor.mismatch.policy import SearchPolicy
from eha_monitor.physics.effects import CATALOGUE


def log_odds(name: str, policy: SearchPolicy) -> float:
    """Return the logarithm of a suspect's prior odds."""
    if not is_named(name):
        return policy.unnamed
    return policy.effect + policy.rare * rarity((name,))


def log_prior(names: Iterable[str], policy: SearchPolicy) -> float:
    """Return the logarithm of a set's prior odds."""
    return float(sum(log_odds(name, policy) for name in names))


def rarity(names: Iterable[str]) -> int:
    """Return how uncommon a set is: the sum over its members."""
    return sum(CATALOGUE[name].rarity for name in names if name in CATALOGUE)


def exclude(one: str, other: str) -> bool:
    """Tell whether of two suspects one contains the other, or both are unknown functions."""
    first, second = CATALOGUE.get(one), CATALOGUE.get(other)
    if first and second:
        return bool({first.name, *first.contains} & {second.name, *second.contains})
    return not (first or second or one.startswith("rig.") or other.startswith("rig."))


def kin(name: str) -> list[str]:
    """Return the other effects of an effect's family."""
    family = CATALOGUE[name].family if name in CATALOGUE else ""
    return [other for other, entry in CATALOGUE.items()
            if family and entry.family == family and other != name]


def form_kin(name: str) -> list[str]:
    """Return the other effects that take up errors of form of an effect's family."""
    family = CATALOGUE[name].family if name in CATALOGUE else ""
    return [other for other, entry in CATALOGUE.items()
            if family and family in (entry.family, entry.mimics) and other != name]


def simple_kin(name: str) -> list[str]:
    """Return the other effects of an effect's family that have one size."""
    return [other for other in kin(name) if len(CATALOGUE[other].sizes) == 1]


def limited(name: str) -> bool:
    """Tell whether an effect is a limit, or is fitted as a logarithm: it has no linear size."""
    return name in CATALOGUE and any(p.log or not np.isfinite(p.neutral)
                                     for p in CATALOGUE[name].sizes)


def is_effect(name: str) -> bool:
    """Tell whether a suspect is an entry of the catalogue."""
    return name in CATALOGUE


def is_named(name: str) -> bool:
    """Tell whether a suspect is an entry of the catalogue or a number of the rig."""
    return name in CATALOGUE or name.startswith("rig.")


def twins(one: str, other: str) -> bool:
    """Tell whether an effect and a number of the rig are one equation."""
    return any(name in CATALOGUE and f"rig.{CATALOGUE[name].rig_twin}" == key
               for name, key in ((one, other), (other, one)))
