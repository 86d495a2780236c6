"""Which channels make which parameters observable: computed from this recording's motion."""

from dataclasses import dataclass

import numpy as np

from eha_monitor.filters import kernel_joint
from eha_monitor.filters.hold import hold_of
from eha_monitor.filters.inputs import RigModel, StageInputs, force_variance
from eha_monitor.filters.joint import speed_hold
from eha_monitor.filters.results import Estimate
from eha_monitor.filters.stage_two import LOOP

COMBINATIONS = (("x", "x_d"), ("x", "omega"), ("x", "p1", "p2"), ("x", "x_d", "p1", "p2"),
                ("x", "omega", "p1", "p2"))
VAGUE = 1e3  # prior standard deviation over the value: what stays near it is not observable
STILL = 3.0  # rms of the pump speed over its noise


@dataclass(frozen=True)
class ObservabilityRow:
    """Standard deviations of B, beta_e and L (C_T), all three unknown, from some channels.

    ``relative_stddev`` is the Cramer-Rao bound over the value; infinite where the parameter
    cannot be told.
    """

    channels: tuple[str, ...]
    relative_stddev: dict[str, float]


@dataclass(frozen=True)
class ObservabilityTable:
    """Rows for each combination of channels that the recording holds."""

    rows: tuple[ObservabilityRow, ...]


def observability(estimate: Estimate) -> ObservabilityTable:
    """Compute the bound of B, beta_e and L for each combination of recorded channels.

    The joint filter runs with its parameters frozen at the estimates (nominal values where
    there are none) and a vague prior; its covariance then is the inverse Fisher information,
    unknown initial state included.  The states are the model's own motion under the recorded
    drive input, so that a recording which the model does not fit cannot pretend to tell more.
    Without a drive input see :func:`without_drive`.
    """
    recording, settings = estimate.recording, estimate.settings
    inputs = StageInputs.of(recording, settings)
    if inputs.model.hydraulics is None:
        return ObservabilityTable(())
    rows = []
    for channels in COMBINATIONS:
        if all(recording.has(name) for name in channels) and (
                "x_d" not in channels or settings.rig.position_gain is not None):
            rows.append(ObservabilityRow(channels, bound(channels, estimate, inputs)))
    return ObservabilityTable(tuple(rows))


def without_drive(estimate: Estimate) -> dict[str, float]:
    """Return the bounds from position and force alone.

    The pump's flow is unknown then, so the flow balance says nothing about beta_e and L; the
    force balance is stage one, whose covariance is the bound of B.
    """
    b = estimate.parameters["B"]
    told = b.status == "converged" and b.value != 0.0
    return {"B": float(b.stddev / abs(b.value)) if told else np.inf, "beta_e": np.inf,
            "L": np.inf}


def stands_still(omega: np.ndarray, inputs: StageInputs) -> bool:
    """Tell whether the pump speed is nothing but its sensor's noise."""
    return bool(np.nanmean(omega**2) < STILL**2 * inputs.noise["omega"].value ** 2)


def bound(channels: tuple[str, ...], estimate: Estimate, inputs: StageInputs) -> dict[str, float]:
    """Return the relative standard deviation of B, beta_e and L from these channels."""
    recording, settings = estimate.recording, estimate.settings
    rig = settings.rig
    if "x_d" not in channels and "omega" not in channels:
        return without_drive(estimate)
    model: RigModel = inputs.model
    damping, modulus = (estimate.parameters[name] for name in ("B", "beta_e"))
    b = damping.value if damping.status == "converged" else rig.viscous_damping
    beta = modulus.value if modulus.status == "converged" else rig.bulk_modulus
    values = np.array([max(abs(b), 1e-9), model.beta_0 / beta, max(model.leak, 1e-15)])
    constants = model.hydraulics.copy()
    if "x_d" in channels:
        constants[LOOP] = rig.position_gain
        hold = hold_of(recording.channels["x_d"], 0.0)
        variance = hold.variance
    else:
        constants[LOOP] = 0.0
        hold = speed_hold(recording, settings, inputs)
        variance = hold.variance if hold is not None else None
        if hold is not None and stands_still(recording.channels["omega"], inputs):
            hold = hold_of(np.zeros(len(recording)), 0.0)  # its noise is no motion
    force, r_f = np.full(len(recording), np.nan), np.inf
    if "p1" in channels:
        force = inputs.measured_force
        r_f = force_variance(rig, inputs.noise, 0.0)
    m = np.array([np.nan, 0.0, 0.0, *values, 0.0])
    p = np.diag([0.0, 0.0, 0.0, *(VAGUE * values) ** 2, 0.0])
    out = np.empty((7, len(recording)))
    kernel_joint.run_joint(inputs.x, force, hold.start, hold.end, variance,
                           hold.instrument, constants, inputs.dt,
                           inputs.position_variance, r_f, 0.0, True, m, p, out)
    relative = np.sqrt(np.maximum(np.diag(p)[3:6], 0.0)) / values
    relative = np.where(relative > 0.1 * VAGUE, np.inf, relative)
    return dict(zip(("B", "beta_e", "L"), (float(value) for value in relative), strict=True))
