"""What least squares on the balances say, as a place where a filter's fit begins."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.likelihood.fit import Fit, with_unknowns
from eha_monitor.mismatch.name.refit import unfitted
from eha_monitor.mismatch.name.starts import Start, possible, with_effect
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
        theta = fit.theta.copy()
        for f in fit.free:
            if f.place == B and self.damping is not None:
                theta[B] = f.outward(self.damping)
        entered = with_effects(experiment, replace(fit, theta=theta), self.effects)
        if entered.named == fit.named:
            return None
        return with_unknowns(experiment, entered, unfitted(experiment).unknowns)


def with_effects(experiment: Experiment, fit: Fit, effects: Mapping[str, Mapping[str, float]]
                 ) -> Fit:
    """Return a fit with the effects that it has not yet entered where they stand, not refitted.

    Parameters
    ----------
    effects : name -> parameters, SI, as in the config's section.
    """
    for name, values in effects.items():
        if possible(name, experiment) and name not in fit.named:
            fit = with_effect(fit, Start(name, tuple(values.items())), ())
    return fit
