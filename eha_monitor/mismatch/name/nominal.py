"""The nominal model, fitted to the end: what a recording is compared with."""

from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.likelihood.fit import Fit
from eha_monitor.mismatch.name.refit import settled
from eha_monitor.mismatch.name.select import resolved_nominal


def nominal(experiment: Experiment) -> tuple[Experiment, Fit]:
    """Fit the nominal model; returns the experiment with steps that resolve the B it finds."""
    experiment, first = resolved_nominal(experiment)
    return experiment, settled(experiment, first)
