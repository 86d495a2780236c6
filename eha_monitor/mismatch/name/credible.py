"""Whether a filter built on the config can judge a recording that is far from it."""

from collections.abc import Mapping

import numpy as np

from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.name.before import informative, with_effects
from eha_monitor.mismatch.name.refit import settled
from eha_monitor.mismatch.name.select import (
    SKETCH,
    SKETCH_WINDOW,
    nominal_model,
    resolved_nominal,
    with_rig,
)
from eha_monitor.mismatch.name.starts import expected_likelihood


def credible(experiment: Experiment, effects: Mapping[str, Mapping[str, float]]) -> bool:
    """Tell whether the filter follows a recording once the effects of its balances are in it.

    The laws of the catalogue are then near the machine's, and what is smaller can be sought.  If
    not, each sample's innovation is the form of a law that nobody wrote down: the filter lacks
    more than ``lacking`` log units a sample on the expected likelihood of a right model.

    Parameters
    ----------
    effects : name -> parameters, as in the config's section; all of them are fitted.
    """
    sketch = informative(experiment, SKETCH, SKETCH_WINDOW)
    try:
        sketch, _ = resolved_nominal(sketch)
        fit = nominal_model(sketch, within=True)
        fit = settled(sketch, with_rig(sketch, with_effects(sketch, fit, effects)))
    except np.linalg.LinAlgError:
        return False
    lacks = expected_likelihood(sketch, fit) - fit.log_likelihood
    return bool(lacks < experiment.policy.lacking * sketch.n)
