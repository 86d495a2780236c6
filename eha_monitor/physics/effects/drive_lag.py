"""A drive that follows its command late: inverter, motor and shaft."""

from eha_monitor.compiled import njit
from eha_monitor.physics.effect import Effect, Parameter
from eha_monitor.physics.signals import DRIVE_LAG


@njit
def circuit(p, w):
    """Add tau to the drive's lag."""
    w[DRIVE_LAG] += p[0]


EFFECT = Effect(
    name="drive_lag",
    balance="drive",
    equation="tau omega' + omega = K_pos (x_d - x)",
    source="first-order speed loop of an electric drive, Leonhard 2001, Ch. 7",
    parameters=(
        Parameter("tau", "s", "time constant of the drive", 0.0, 1.0, 2e-3),
    ),
    circuit=circuit,
    statement="the drive follows its command with a time constant of {tau}",
    rig_check="Step the speed command with the rod free: 63 % of the speed must be there after "
    "tau.",
    starts=lambda r: tuple({"tau": share * r.sample_time} for share in (0.3, 1.0, 5.0)),
    rarity=0,
)
