"""Pressure sensors with a zero error."""

from eha_monitor.compiled import njit
from eha_monitor.physics.effect import Effect, Parameter
from eha_monitor.physics.signals import PRESSURE_OFFSET_1, PRESSURE_OFFSET_2


@njit
def circuit(p, w):
    """Add b_1 and b_2 to the sensors' errors."""
    w[PRESSURE_OFFSET_1] += p[0]
    w[PRESSURE_OFFSET_2] += p[1]


def starts(r):
    """Both sensors at once."""
    small = 0.003 * max(r.pressure_difference[3], 1.0)
    return ({"b_1": small, "b_2": small},)


EFFECT = Effect(
    name="pressure_offset",
    balance="sensor",
    equation="p_s = p + b_1 in chamber 1, p + b_2 in chamber 2",
    source="sensor model y = x + b",
    parameters=(
        Parameter("b_1", "Pa", "zero error of sensor 1", -1e8, 1e8, 2e4),
        Parameter("b_2", "Pa", "zero error of sensor 2", -1e8, 1e8, 2e4),
    ),
    circuit=circuit,
    statement="the pressure sensors have zero errors of {b_1:+} (chamber 1) and {b_2:+} (chamber "
              "2)",
    rig_check="Open both chambers to the tank: the sensors must show the same pressure, and a "
    "gauge too.",
    starts=starts,
    rarity=0,
)
