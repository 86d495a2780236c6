"""A pump that gives no flow below a speed: the first turns only fill its own leakage."""

from eha_monitor.compiled import njit
from eha_monitor.physics.effect import Effect, Parameter
from eha_monitor.physics.signals import OMEGA, SPEED


@njit
def term(s, p, m, c):
    """Take omega, at most omega_0 of it, off the speed that makes flow."""
    c[SPEED] -= min(max(s[OMEGA], -p[0]), p[0])


EFFECT = Effect(
    name="pump_dead_zone",
    balance="flow",
    equation="Q = D_p (|omega| - omega_0)+ sgn omega",
    source="dead zone, Tao, Kokotovic 1996; of a pump: Ivantysyn, Ivantysynova 2001",
    parameters=(
        Parameter("omega_0", "rad/s", "shaft speed below which no flow is made", 0.0, 1e4, 5.0),
    ),
    term=term,
    adds=(SPEED,),
    reads=(OMEGA,),
    statement="the pump delivers no flow below {omega_0}, and the same speed is lost above it",
    rig_check="Turn the pump slowly with the rod free: the rod must not move below omega_0.",
    starts=lambda r: ({"omega_0": 0.003 * r.pump_speed[3]},),  # it shows at small speeds
)
