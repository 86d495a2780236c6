"""What least squares on the balances say, as a place where a filter's fit begins."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.likelihood.fit import Fit, with_unknowns
from eha_monitor.mismatch.name.base import with_effect
from eha_monitor.mismatch.name.refit import unfitted
from eha_monitor.mismatch.name.starts import Start, possible
from eha_monitor.physics.signals import B


@dataclass(frozen=True)
class FirstView:
    """What the balances name.

    Attributes
    ----------
    effects : name -> parameters, SI, as in the config's section.
    damping : B beside them, N s/m (N m s/rad); None where they do not say.
    """

    effects: Mapping[str, Mapping[str, float]]
    damping: float | None = None

    def entered(self, experiment: Experiment, fit: Fit) -> Fit | None:
        """Return a nominal model with these effects in it, not refitted; None where it has none.

        Unknowns are those of a model that has not been fitted: those that the nominal model asks
        for stand for the effects.
        """
        named = [name for name in self.effects
                 if possible(name, experiment) and name not in fit.named]
        if not named:
            return None
        theta = fit.theta.copy()
        for f in fit.free:
            if f.place == B and self.damping is not None:
                theta[B] = f.outward(self.damping)
        fit = replace(fit, theta=theta)
        for name in named:
            fit = with_effect(fit, Start(name, tuple(self.effects[name].items())), ())
        return with_unknowns(experiment, fit, unfitted(experiment).unknowns)
