"""The numbers that decide what is named, in one place; each with its reason."""

from dataclasses import asdict, dataclass

import numpy as np
from scipy.special import ndtr


@dataclass(frozen=True)
class Policy:
    """What a name owes.

    Attributes
    ----------
    gain : a term removes this share of the RMS error, or it is left out.  Definition: 2 % of an
        error is what nobody would repair a machine for.
    small : what is a smaller share decides nothing.  Of the error, what a number that every
        recording has of its own, or a learned term, must remove; of the signal, a constant load
        that may be the zero of the sensors.  Definition: a tenth.
    named : share of the error that a family of terms must gain together before it is named.
        Smaller terms stay in the model as corrections of form.  Measured: what gains less on one
        day is not chosen on the other (docs/one_machine.md).
    alone : the same where the parts left out are of the same recording.  Measured: what gains
        less in one recording does not come back on another day (docs/one_machine.md).
    repeats : Student's t of that gain over recordings left out.  Definition: 2 deviations.
    block : s that stay together when a recording is halved or blocks are left out.  Measured:
        several correlation times of the residuals of a real actuator (0.1 to 0.9 s).
    halves : random halves of a recording's blocks.  Definition: a frequency to a tenth.
    stable : share of the halves in which a name must come up.  Meinshausen and Buehlmann 2010.
    certain : highest probability that one recording alone can carry.  Measured: what it says
        with 99 % comes back on another day in 88 to 95 % (design/one_machine.md).
    slope : of the log odds of a name in the log odds of its frequency.  Measured on replicates.
    between : relative spread of a parameter between recordings of one machine where only one is
        known.  Measured on replicates; see docs/one_machine.md.
    worse : an error on unseen parts may grow by this share of the signal.  Contract of the gate.
    odd : robust deviations beyond which a recording does not belong.  Definition.
    varied : deviations by which two numbers differ: a load that was varied (and by a fifth of
        its size), a number of the config that is wrong, a term that is there.  Definition.
    open : share that an answer may leave: of the signal, else nothing is named; of an error, else
        it is not explained.  Definition: half.
    clean : times what the sensors alone leave: such a balance is closed.  Derived: the scatter of
        some hundred correlated samples.
    false : share of healthy recordings that may be called changed.  Definition.
    fewest : recordings from which a structure is chosen on recordings left out.  Derived: a t of
        2 from fewer is met by chance in one of six.
    coherent : share of what a model leaves that may look like any one of its terms.  Measured: the
        spread of parameters between two days of a real actuator (docs/one_machine.md).
    near : share of a balance that the config's own model may leave open, for a filter built on it
        to judge what is missing, and a machine's of its drive, for that to be compared.
        Definition: a quarter; see docs/diagnosis.md.
    """

    gain: float = 0.02
    small: float = 0.1
    named: float = 0.15
    alone: float = 0.1
    repeats: float = 2.0
    block: float = 1.5
    halves: int = 20
    stable: float = 0.7
    certain: float = 0.95
    slope: float = 0.8
    between: float = 0.2
    worse: float = 0.02
    odd: float = 4.0
    varied: float = 3.0
    open: float = 0.5
    clean: float = 1.25
    false: float = 0.01
    fewest: int = 3
    coherent: float = 0.5
    near: float = 0.25

    def sure(self, value: float, stddev: float) -> bool:
        """Tell whether a number is surely not 0."""
        return bool(abs(value) > self.varied * stddev)

    @property
    def owed(self) -> float:
        """How far from absent a name of one recording is, in standard deviations.

        It is of the machine, so it holds on another day: what is surely absent there, ``varied``
        deviations of the difference of two days, is no name here.
        """
        return float(np.sqrt(2.0) * self.varied)

    def alike(self, left: float, noise: float) -> float:
        """Return what may look like any one term, of the squares that are left: it repeats.

        What is left of a law that is missing is there in each recording, and no longer one takes
        it away; of the sensors' ``noise`` it does.
        """
        return self.coherent**2 * max(left - noise, 0.0)

    def probability(self, frequency: float, apart: float) -> float:
        """Return how surely a name comes back on another day.

        Parameters
        ----------
        frequency : share of the halves in which it comes up.
        apart : deviations of this day's value from absent; another day's differs by both days'
            own, and is there where it is ``varied`` of them from absent by itself.
        """
        half = 0.5 / self.halves
        odds = np.log((frequency + half) / (1.0 - frequency + half))
        return min(float(1.0 / (1.0 + np.exp(-self.slope * odds))), self.certain,
                   float(ndtr((apart - self.varied) / np.sqrt(2.0))))

    def to_dict(self) -> dict:
        """Return the JSON form, key ``policy``."""
        return asdict(self)


POLICY = Policy()
