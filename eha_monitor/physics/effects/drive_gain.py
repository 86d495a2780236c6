"""A drive that turns the position error into another speed than the config says."""

from eha_monitor.compiled import njit
from eha_monitor.physics.effect import Effect, Parameter
from eha_monitor.physics.signals import DRIVE_GAIN


@njit
def circuit(p, w):
    """Add k to the relative gain."""
    w[DRIVE_GAIN] += p[0]


EFFECT = Effect(
    name="drive_gain",
    balance="drive",
    equation="omega = (1 + k) K_pos (x_d - x)",
    source="outer loop of the drive with another gain",
    parameters=(
        Parameter("k", "1", "relative error of the gain", -0.9, 10.0, 0.05),
    ),
    circuit=circuit,
    statement="the drive's gain is {k:+%} off the configured position gain",
    rig_check="Read the gain in the drive's parameters; measured speed over position error is "
    "K_pos.",
    rig_twin="position_gain",
    starts=lambda r: ({"k": 0.003},),
)
