"""A measured position that reaches the drive late."""

from eha_monitor.compiled import njit
from eha_monitor.physics.effect import Effect, Parameter
from eha_monitor.physics.signals import FEEDBACK_DELAY


@njit
def circuit(p, w):
    """Add T to the delay."""
    w[FEEDBACK_DELAY] += p[0]


EFFECT = Effect(
    name="feedback_delay",
    balance="drive",
    equation="omega(t) = K_pos (x_d(t) - x(t - T))",
    source="dead time of sampling, filtering and bus",
    parameters=(
        Parameter("T", "s", "time from the position to the drive", 0.0, 0.1, 1e-3),
    ),
    circuit=circuit,
    statement="the position reaches the drive {T} late",
    rig_check="Compare the position that the drive logs with the sensor's own output on one "
    "clock.",
    starts=lambda r: tuple({"T": share * r.sample_time} for share in (0.2, 1.0, 4.0)),
)
