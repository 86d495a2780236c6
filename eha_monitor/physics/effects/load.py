"""Loads and masses that the rod moves beyond the configured ones."""

from eha_monitor.compiled import njit
from eha_monitor.physics.effect import Effect, Parameter
from eha_monitor.physics.signals import FORCE, MASS, X


# A load force that is the same in both directions and at rest.
@njit
def constant_load_term(s, p, m, c):
    """Add F_0, positive against positive motion."""
    c[FORCE] += p[0]


CONSTANT_LOAD = Effect(
    name="constant_load", balance="force",
    equation="F = F_0",
    source="weight or external force in the force balance, Eq. 3",
    parameters=(Parameter("F_0", "N", "load, positive against positive motion", -1e7, 1e7,
                          100.0),),
    term=constant_load_term, adds=(FORCE,),
    statement="a constant load of {F_0}, counted against positive motion",
    rig_check="Hold the actuator at rest: the pressure force that remains is the load.",
    starts=lambda r: ({"F_0": 0.01 * r.force},),
    rarity=0,
)


# A load that grows with position: a spring, or the air on a control surface.
@njit
def spring_load_term(s, p, m, c):
    """Add k (x - x_0)."""
    c[FORCE] += p[0] * (s[X] - p[1])


SPRING_LOAD = Effect(
    name="spring_load", balance="force",
    equation="F = k (x - x_0)",
    source="spring load in the force balance, Merritt 1967, Sec. 6-1",
    parameters=(
        Parameter("k", "N/m", "stiffness", 0.0, 1e9, 1000.0),
        Parameter("x_0", "m", "position at which the spring is relaxed", -10.0, 10.0, 0.01, 0.0,
                  fitted=False),
    ),
    term=spring_load_term, adds=(FORCE,), reads=(X,),
    statement="a spring of {k} pulls back to x = {x_0}",
    rig_check="Hold the actuator at rest at both ends of its travel: the pressure force must "
    "differ by k times the distance.",
    starts=lambda r: ({"k": 0.01 * r.force / max(r.position, 1e-6), "x_0": 0.0},),
    rarity=0,
)


# A spring that is met in part of the stroke: a tool, an end cushion, a stop.
@njit
def contact_spring_term(s, p, m, c):
    """Add side k max(side (x - x_c), 0)."""
    pressed = p[2] * (s[X] - p[1])
    if pressed > 0.0:
        c[FORCE] += p[2] * p[0] * pressed


def _contacts(r):
    """Return where a fit begins: a fifth of the travel from either end."""
    k = {"k": 0.05 * r.force / max(r.position, 1e-6)}
    return tuple({**k, "x_c": r.middle + 0.6 * side * r.position, "side": side}
                 for side in (1.0, -1.0))


CONTACT_SPRING = Effect(
    name="contact_spring", balance="force",
    equation="F = side k max(side (x - x_c), 0)",
    source="contact with clearance: Johnson 1985, Contact Mechanics, for a linear stiffness",
    parameters=(
        Parameter("k", "N/m", "stiffness of what is met", 0.0, 1e10, 1e4),
        Parameter("x_c", "m", "position at which it is met", -10.0, 10.0, 0.01, 0.0),
        Parameter("side", "1", "1: met while extending, -1: while retracting", -1.0, 1.0, 1.0,
                  1.0, fitted=False),
    ),
    term=contact_spring_term, adds=(FORCE,), reads=(X,),
    statement="beyond x = {x_c} the rod meets a spring of {k}",
    rig_check="Look for what the rod meets there: a tool, an end cushion, a stop; move slowly "
    "across that place, where the pressure force must begin to rise with x.",
    starts=_contacts,
)


# More moving mass than the config has: a load, or oil that is moved along.
@njit
def added_mass_term(s, p, m, c):
    """Add dM to the moving mass."""
    c[MASS] += p[0]


ADDED_MASS = Effect(
    name="added_mass", balance="force",
    equation="F = dM v'",
    source="force balance, Eq. 3, with the mass M + dM",
    parameters=(Parameter("dM", "kg", "moving mass beyond the configured one", 0.0, 1e6, 5.0),),
    term=added_mass_term, adds=(MASS,),
    statement="the moving mass is {dM} beyond the configured mass",
    rig_check="Weigh what moves, the load included; on a step of speed the peak of the pressure "
    "force grows with it.",
    rig_twin="mass",
    starts=lambda r: ({"dM": 0.01 * r.force / max(r.acceleration, 1e-3)},),
)
