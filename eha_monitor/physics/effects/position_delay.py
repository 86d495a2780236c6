"""A position that reaches the recording late; the drive has it in time."""

from eha_monitor.compiled import njit
from eha_monitor.physics.effect import Effect, Parameter
from eha_monitor.physics.signals import POSITION_DELAY


@njit
def circuit(p, w):
    """Add T to the delay."""
    w[POSITION_DELAY] += p[0]


EFFECT = Effect(
    name="position_delay",
    balance="sensor",
    equation="x_s(t) = x(t - T)",
    source="dead time of sampling, filtering and bus",
    parameters=(
        Parameter("T", "s", "time from the position to its stamp in the recording", 0.0,
                  0.1, 1e-3),
    ),
    circuit=circuit,
    statement="the recorded position is {T} late",
    rig_check="Tap the rod while a second sensor is on the same clock: the position must respond "
              "T later.",
    starts=lambda r: tuple({"T": share * r.sample_time} for share in (0.2, 1.0, 4.0)),
)
