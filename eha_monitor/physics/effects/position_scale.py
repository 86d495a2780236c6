"""A position sensor whose scale is wrong."""

from eha_monitor.compiled import njit
from eha_monitor.physics.effect import Effect, Parameter
from eha_monitor.physics.signals import IN_LOOP, POSITION_SCALE


@njit
def circuit(p, w):
    """Add k to the sensor's scale error; the drive shares it where in_loop is 1."""
    w[POSITION_SCALE] += p[0]
    w[IN_LOOP] += p[1]


EFFECT = Effect(
    name="position_scale",
    balance="sensor",
    equation="x_s = (1 + k) x, and with in_loop = 1 the drive reads x_s",
    source="sensor model y = a x",
    parameters=(
        Parameter("k", "1", "relative error of the scale", -0.5, 1.0, 0.03),
        Parameter("in_loop", "1", "1: the drive reads the same sensor; 0: only the recording "
                  "does", 0.0, 1.0, 1.0, 0.0, fitted=False),
    ),
    circuit=circuit,
    statement="the position sensor reads {k:+%} off its scale",
    rig_check="Move the rod between two stops and compare with a gauge.",
    starts=lambda r: ({"k": 0.003, "in_loop": 0.0}, {"k": 0.003, "in_loop": 1.0}),
)
