"""Pressure sensors whose zero wanders during the record."""

from eha_monitor.compiled import njit
from eha_monitor.physics.effect import Effect, Parameter
from eha_monitor.physics.signals import PRESSURE_DRIFT_1, PRESSURE_DRIFT_2


@njit
def circuit(p, w):
    """Add d_1 and d_2 to the sensors' errors."""
    w[PRESSURE_DRIFT_1] += p[0]
    w[PRESSURE_DRIFT_2] += p[1]


def starts(r):
    """Both sensors at once."""
    small = 0.003 * max(r.pressure_difference[3], 1.0) / max(r.duration, r.sample_time)
    return ({"d_1": small, "d_2": small},)


EFFECT = Effect(
    name="pressure_drift",
    balance="sensor",
    equation="p_s = p + d_1 t in chamber 1, p + d_2 t in chamber 2",
    source="sensor model y = x + d t, t since the start of the record",
    parameters=(
        Parameter("d_1", "Pa/s", "drift of the zero of sensor 1", -1e7, 1e7, 1e3),
        Parameter("d_2", "Pa/s", "drift of the zero of sensor 2", -1e7, 1e7, 1e3),
    ),
    circuit=circuit,
    statement="the pressure sensors drift by {d_1:+} (chamber 1) and {d_2:+} (chamber 2)",
    rig_check="Log the sensors for as long as the record took with the rig at rest and both "
    "chambers open to the tank.",
    starts=starts,
    rarity=2,
)
