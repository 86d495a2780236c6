"""Pressure sensors whose scale is wrong."""

from eha_monitor.compiled import njit
from eha_monitor.physics.effect import Effect, Parameter
from eha_monitor.physics.signals import PRESSURE_SCALE_1, PRESSURE_SCALE_2


@njit
def circuit(p, w):
    """Add k_1 and k_2 to the sensors' errors."""
    w[PRESSURE_SCALE_1] += p[0]
    w[PRESSURE_SCALE_2] += p[1]


def starts(r):
    """Both sensors at once."""
    small = 0.003
    return ({"k_1": small, "k_2": small},)


EFFECT = Effect(
    name="pressure_scale",
    balance="sensor",
    equation="p_s = (1 + k_1) p in chamber 1, (1 + k_2) p in chamber 2",
    source="sensor model y = a x",
    parameters=(
        Parameter("k_1", "1", "relative error of the scale of sensor 1", -0.9, 2.0, 0.03),
        Parameter("k_2", "1", "relative error of the scale of sensor 2", -0.9, 2.0, 0.03),
    ),
    circuit=circuit,
    statement="the pressure sensors read {k_1:+%} (chamber 1) and {k_2:+%} (chamber 2) off their "
    "scale",
    rig_check="Put both sensors on a dead-weight tester, or on one another's port, at two "
    "pressures.",
    starts=starts,
)
