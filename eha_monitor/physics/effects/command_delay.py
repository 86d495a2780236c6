"""A demanded position that reaches the drive late."""

from eha_monitor.compiled import njit
from eha_monitor.physics.effect import Effect, Parameter
from eha_monitor.physics.signals import COMMAND_DELAY


@njit
def circuit(p, w):
    """Add T to the delay."""
    w[COMMAND_DELAY] += p[0]


EFFECT = Effect(
    name="command_delay",
    balance="drive",
    equation="omega(t) = K_pos (x_d(t - T) - x(t))",
    source="dead time of sampling, filtering and bus",
    parameters=(
        Parameter("T", "s", "time from the command to the drive", 0.0, 0.1, 1e-3),
    ),
    circuit=circuit,
    statement="the command reaches the drive {T} late",
    rig_check="Log the command where it is made and where the drive takes it: compare the "
    "stamps of a step.",
    starts=lambda r: tuple({"T": share * r.sample_time} for share in (0.2, 1.0, 4.0)),
)
