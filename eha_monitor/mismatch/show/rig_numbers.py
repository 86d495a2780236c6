"""What the recordings say of the rig's numbers: those that are wrong, those they know better."""

import numpy as np

from eha_monitor import ties
from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.diagnosis import RigFinding, Value
from eha_monitor.mismatch.likelihood.fit import Fit
from eha_monitor.mismatch.name.columns import rig_free
from eha_monitor.mismatch.name.gates import at_bound
from eha_monitor.mismatch.name.naming import Naming
from eha_monitor.quantity import side_by_side

SHOWN = 1e-3  # of a probability: what is closer reads the same, and stands as in the config


def rig_findings(experiment: Experiment, naming: Naming) -> tuple[RigFinding, ...]:
    """Return the numbers of the rig that a recording contradicts, the most certain first."""
    found = []
    for key in naming.wrong:
        configured, value, words = _told(experiment, naming.after, key)
        found.append(RigFinding(
            key, configured, value, naming.probability.get(f"rig.{key}", np.nan), words,
            naming.rivals.get(f"rig.{key}", ())))
    return tuple(ties.ordered(found, lambda finding: finding.probability, within=SHOWN))


def rig_within(experiment: Experiment, naming: Naming) -> tuple[RigFinding, ...]:
    """Return the numbers that a recording knows better than the config, within their tolerance.

    A pump that delivers 3 % less is no mismatch where its displacement is known to 3 %, but it is
    what the recording says.
    """
    fitted, found, policy = {f.name for f in naming.after.free}, [], experiment.policy
    for own in rig_free(experiment):
        key = own.symbol
        if own.name not in fitted or key in naming.wrong or at_bound(
                own, naming.after.value(own.name)):
            continue  # at the end of its tolerance it is no optimum, so no finding
        configured, value, words = _told(experiment, naming.after, key)
        spread = experiment.settings.rig.tolerance.log_spread(key)
        moved, sigma = np.log(value.value / configured), value.stddev / value.value
        if sigma < policy.informed * spread and abs(moved) > max(
                policy.sure * sigma, policy.informed * spread):
            found.append(RigFinding(key, configured, value, np.nan,
                                    f"{words}, within its tolerance"))
    return tuple(found)


def _told(experiment: Experiment, fit: Fit, key: str) -> tuple[float, Value, str]:
    """Return what the config says of a number, what the recording, and both in words."""
    name, rig = f"rig.{key}", experiment.settings.rig
    unit = type(rig).model_fields[key].json_schema_extra["unit"]
    value = Value(fit.value(name), fit.stddev(name), unit)
    configured = float(getattr(rig, key))
    one, other = side_by_side(configured, value.value, value.stddev, unit)
    return configured, value, f"{key}: the config says {one}, the recording {other}"
