"""Which channels make which parameters observable: computed from this recording's motion."""

from dataclasses import dataclass

import numpy as np

from eha_monitor.estimation.discretisation import LOOP
from eha_monitor.estimation.drive import hold_of
from eha_monitor.estimation.inputs import Inputs, Piece, PiecedInputs, inputs_of
from eha_monitor.estimation.joint import (
    ConstantsJoint,
    RowsJoint,
    filter_joint,
    new_state_joint,
    speed_hold,
)
from eha_monitor.estimation.results import Estimate
from eha_monitor.estimation.rig_model import force_variance

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
    inputs = inputs_of(recording, settings)
    if inputs.model.hydraulics is None:
        return ObservabilityTable(())
    bounds = [Bound(channels, estimate, inputs) for channels in COMBINATIONS
              if all(recording.has(name) for name in channels) and (
                  "x_d" not in channels or settings.rig.position_gain is not None)]
    if any(bound.driven for bound in bounds):
        for piece in inputs.pieces(recording):
            for bound in bounds:
                bound.take(piece)
    return ObservabilityTable(tuple(ObservabilityRow(bound.channels, bound.relative)
                                    for bound in bounds))


def without_drive(estimate: Estimate) -> dict[str, float]:
    """Return the bounds from position and force alone.

    The pump's flow is unknown then, so the flow balance says nothing about beta_e and L; the
    force balance is stage one, whose covariance is the bound of B.
    """
    b = estimate.parameters["B"]
    told = b.status == "converged" and b.value != 0.0
    return {"B": float(b.stddev / abs(b.value)) if told else np.inf, "beta_e": np.inf,
            "L": np.inf}


def stands_still(omega: np.ndarray, inputs: Inputs) -> bool:
    """Tell whether the pump speed is nothing but its sensor's noise."""
    return bool(np.nanmean(omega**2) < STILL**2 * inputs.noise["omega"].value ** 2)


class Bound:
    """The bound of B, beta_e and L from some channels, over the pieces of a recording.

    Attributes
    ----------
    driven : whether a drive input is among the channels.
    """

    def __init__(self, channels: tuple[str, ...], estimate: Estimate, inputs: Inputs):
        self.channels, self.estimate, self.inputs = channels, estimate, inputs
        self.driven = "x_d" in channels or "omega" in channels
        model, rig = inputs.model, estimate.settings.rig
        damping, modulus = (estimate.parameters[name] for name in ("B", "beta_e"))
        b = damping.value if damping.status == "converged" else rig.viscous_damping
        beta = modulus.value if modulus.status == "converged" else rig.bulk_modulus
        self._values = np.array([max(abs(b), 1e-9), model.beta_0 / beta, max(model.leak, 1e-15)])
        self._constants = model.hydraulics.copy()
        self._constants[LOOP] = rig.position_gain if "x_d" in channels else 0.0
        self._still = False
        if self.driven and "x_d" not in channels:
            omega = (inputs.sample if isinstance(inputs, PiecedInputs)
                     else estimate.recording).channels["omega"]
            self._still = stands_still(omega, inputs)
        self._state = new_state_joint(self._values, (VAGUE * self._values) ** 2)

    def take(self, piece: Piece) -> None:
        """Learn from some rows."""
        if not self.driven:
            return
        part, rows, inputs = piece.inputs, piece.recording, self.inputs
        if "x_d" in self.channels:
            hold = hold_of(rows.channels["x_d"], 0.0)
        else:
            hold = speed_hold(rows, self.estimate.settings, inputs)
        variance = hold.variance
        if self._still:
            hold = hold_of(np.zeros(len(rows)), 0.0)  # its noise is no motion
        force, R_f = np.full(part.rows, np.nan), np.inf
        if "p1" in self.channels:
            force = part.measured_force
            R_f = force_variance(self.estimate.settings.rig, inputs.noise, 0.0)
        hold = hold._replace(variance=variance).part(piece.within)
        given = ConstantsJoint(self._constants, inputs.dt, inputs.position_variance, R_f, True)
        filter_joint(RowsJoint(part.x, force, *hold), given, self._state, piece.first,
                     np.empty((7, part.rows)))

    @property
    def relative(self) -> dict[str, float]:
        """Relative standard deviations of B, beta_e and L."""
        if not self.driven:
            return without_drive(self.estimate)
        found = np.sqrt(np.maximum(np.diag(self._state.P)[3:6], 0.0)) / self._values
        found = np.where(found > 0.1 * VAGUE, np.inf, found)
        return dict(zip(("B", "beta_e", "L"), map(float, found), strict=True))
