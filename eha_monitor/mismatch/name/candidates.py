"""What a set may hold: effects of the catalogue, wrong numbers of the rig, unknown functions.

Sets are of names; what a name stands for, and what it excludes, is asked of its candidate.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from eha_monitor.mismatch.policy import SearchPolicy
from eha_monitor.physics.effect import Effect
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.settings.rig import TOLERATED

RIG = "rig."  # before the key of a number
FORCE_KEYS, DRIVE_KEYS = ("mass", "area_1", "area_2"), ("position_gain",)


@dataclass(frozen=True)
class Candidate:
    """Something that a model may lack, one member of a set."""

    name: str  # effect, ``rig.<key>``, or the name of an unknown function
    balance: str = ""  # where it acts; "" of an unknown function
    effect: Effect | None = None  # its entry in the catalogue; None of all others
    key: str = ""  # of the number of the rig; "" of all others
    equals: str = ""  # the candidate that is the same equation, or ""

    @property
    def named(self) -> bool:
        """Tell whether it is an effect of the catalogue or a number of the rig."""
        return bool(self.effect or self.key)

    @property
    def rarity(self) -> int:
        """How uncommon it is."""
        return self.effect.rarity if self.effect else 0

    @property
    def limit(self) -> bool:
        """Tell whether it is a limit, or is fitted as a logarithm: it has no linear size."""
        return self.effect is not None and any(
            p.log or not np.isfinite(p.neutral) for p in self.effect.sizes)

    def log_odds(self, policy: SearchPolicy) -> float:
        """Return the logarithm of its prior odds."""
        return policy.effect + policy.rare * self.rarity if self.named else policy.unnamed

    def excludes(self, other: "Candidate") -> bool:
        """Tell whether one of two contains the other, or both are unknown functions."""
        if self.effect and other.effect:
            return bool({self.name, *self.effect.contains} & {other.name, *other.effect.contains})
        return not (self.named or other.named)

    @cached_property
    def kin(self) -> frozenset[str]:
        """The other effects of its family."""
        return frozenset(name for name, entry in CATALOGUE.items() if name != self.name
                         and self.effect and self.effect.family == entry.family != "")

    @cached_property
    def form_kin(self) -> frozenset[str]:
        """The other effects that take up errors of form of its family."""
        return self.kin | frozenset(name for name, entry in CATALOGUE.items() if name != self.name
                                    and self.effect and self.effect.family == entry.mimics != "")


def candidate(name: str) -> Candidate:
    """Return the candidate of a name."""
    return CANDIDATES.get(name) or Candidate(name)


def log_prior(names: Iterable[str], policy: SearchPolicy) -> float:
    """Return the logarithm of a set's prior odds."""
    return float(sum(candidate(name).log_odds(policy) for name in names))


def all_named(names: Iterable[str]) -> bool:
    """Tell whether a set holds no unknown function."""
    return all(candidate(name).named for name in names)


def _candidates() -> dict[str, Candidate]:
    twins = {entry.rig_twin: name for name, entry in CATALOGUE.items() if entry.rig_twin}
    rig = [Candidate(RIG + key, "force" if key in FORCE_KEYS else
                     "drive" if key in DRIVE_KEYS else "flow", key=key, equals=twins.get(key, ""))
           for key in TOLERATED]
    effects = [Candidate(name, entry.balance, entry,
                         equals=RIG + entry.rig_twin if entry.rig_twin else "")
               for name, entry in CATALOGUE.items()]
    return {one.name: one for one in (*effects, *rig)}


CANDIDATES = _candidates()
