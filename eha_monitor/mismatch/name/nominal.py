"""The nominal model, fitted to the end: what a recording is compared with."""

from dataclasses import replace

from eha_monitor.mismatch.data.experiment import Experiment, resolving
from eha_monitor.mismatch.likelihood.fit import Fit
from eha_monitor.mismatch.name.refit import settled
from eha_monitor.mismatch.name.select import nominal_model
from eha_monitor.physics import signals as s


def nominal(experiment: Experiment) -> tuple[Experiment, Fit]:
    """Fit the nominal model; returns the experiment with steps that resolve the B it finds."""
    while True:
        fit = settled(experiment, replace(nominal_model(experiment), converged=False))
        finer = experiment if experiment.inverse else resolving(experiment, fit.theta[s.B])
        if finer.steps == experiment.steps:
            return experiment, fit
        experiment = finer
