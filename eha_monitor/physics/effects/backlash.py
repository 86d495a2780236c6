"""Play between the piston and its position sensor."""

from eha_monitor.compiled import njit
from eha_monitor.physics.effect import Effect, Parameter
from eha_monitor.physics.signals import IN_LOOP, PLAY


@njit
def circuit(p, w):
    """Widen the play by b; the drive sees it where in_loop is 1."""
    w[PLAY] += p[0]
    w[IN_LOOP] += p[1]


def starts(r):
    """Two widths, with and without the drive behind the play."""
    return tuple({"b": share * max(r.position, 1e-6), "in_loop": in_loop}
                 for in_loop in (1.0, 0.0) for share in (0.001, 0.01))


EFFECT = Effect(
    name="backlash",
    balance="force",
    equation="x_s = min(max(x_s, x - b/2), x + b/2), x_s is what the sensor shows and, with "
    "in_loop = 1, the drive reads",
    source="play operator, Nordin, Gutman 2002; Tao, Kokotovic 1996",
    parameters=(
        Parameter("b", "m", "width of the play, end to end", 0.0, 0.1, 1e-4),
        Parameter("in_loop", "1", "1: the drive reads the sensor behind the play; 0: only the "
                  "recording does", 0.0, 1.0, 1.0, 1.0, fitted=False),
    ),
    circuit=circuit,
    statement="there is a backlash of {b} between the piston and its position sensor",
    rig_check="Put a dial gauge on the piston rod and reverse slowly: the sensor must stand still "
    "for b.",
    starts=starts,
    rarity=2,
)
