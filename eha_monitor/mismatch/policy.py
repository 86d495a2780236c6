"""The numbers that decide what the search by filter names, in one place; each with its reason.

All others of the search are numerics: steps, blocks, grids, how far is searched.
``benchmarks/policy_sweep.py`` varies them; what moved stands in docs/diagnosis.md.
"""

from dataclasses import asdict, dataclass


@dataclass(frozen=True)
class SearchPolicy:
    """What a name owes.

    Attributes
    ----------
    effect : log prior odds of an effect, and of a number of the rig beyond its tolerance.
        Definition: one rig in 150 has any given one.
    rare : of them for each degree of an effect's rarity (catalogue).  Definition.
    temper : power of the evidence between sets.  Measured: with it the probabilities are honest
        (calibration error 1.3 %, docs/proof.md).
    form : log units; what a model leaves above the noise counts in full up to here, beyond as its
        logarithm.  Definition: 0.4 % of the samples that a search uses.
    law : share of what named laws explain that may be their form error.  Measured: a wrong law
        gained 0 to 3 % over the right one on 170 draws (docs/diagnosis.md).
    rival : probability from which another answer cannot be excluded.  Definition: one in twenty.
    likely : probability, and share of an error, from which something is the answer: more than
        half.  Definition.
    explained : share of what speaks against a model that an explanation by other parameters must
        take away.  Definition: three quarters.
    few : times the smallest unknowns: a right model needs fewer, one that needs as many as likely
        lacks something as not, and what an effect adds has to be more.  Definition: 0.15 % of what
        its balance does.
    share : of the unknowns that names have taken the place of: the same, of a model that names
        something.  Definition: more than half is left.
    matters : times the smallest unknowns: an unknown that matters.  Definition: 1 % of what its
        balance does.
    informed : of a prior deviation: a number known no better is known from the prior alone.
        Definition.
    sure : standard deviations from which a difference, a sign or a bound is no noise.  Definition.
    worse : share of a signal or a parameter by which a difference is none.  Contract of the gate.
    timing : samples; shorter delays need no name.  Definition: nobody's stamps are better.
    wrong : tolerances, the deviation of a number which is wrong.  Definition: a factor of four
        for one known to a tenth.
    spread : times its start, the prior deviation of an effect's size.  Derived: a start is about
        1 % of what the recording covers.
    shape : prior deviation of the logarithm of a shape.  Definition: a factor of four and a half.
    lacking : log units a sample, behind the expected likelihood of a right model: a filter that
        lacks more, after a search of a third of the samples, is no judge.  Definition: one;
        measured up to 0.12 on concealed draws, 1.1 to 8.1 on strangers' rigs (docs/diagnosis.md).
    """

    effect: float = -5.0
    rare: float = -0.5
    temper: float = 0.3
    form: float = 100.0
    law: float = 0.05
    rival: float = 0.05
    likely: float = 0.5
    explained: float = 0.75
    few: float = 15.0
    share: float = 0.6
    matters: float = 100.0
    informed: float = 0.5
    sure: float = 3.0
    worse: float = 0.02
    timing: float = 0.05
    wrong: float = 14.0
    spread: float = 100.0
    shape: float = 1.5
    lacking: float = 1.0

    @property
    def unnamed(self) -> float:
        """Log prior odds of an unknown function, as of the rarest effects; columns also pay."""
        return self.effect + 2.0 * self.rare

    def to_dict(self) -> dict:
        """Return the JSON form, key ``policy``."""
        return asdict(self)


POLICY = SearchPolicy()
