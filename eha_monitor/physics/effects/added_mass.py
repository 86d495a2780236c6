"""More moving mass than the config has: a load, or oil that is moved along."""

from eha_monitor.compiled import njit
from eha_monitor.physics.effect import Effect, Parameter
from eha_monitor.physics.signals import MASS


@njit
def term(s, p, m, c):
    """Add dM to the moving mass."""
    c[MASS] += p[0]


EFFECT = Effect(
    name="added_mass",
    balance="force",
    equation="F = dM v'",
    source="force balance, Eq. 3, with the mass M + dM",
    parameters=(
        Parameter("dM", "kg", "moving mass beyond the configured one", 0.0, 1e6, 5.0),
    ),
    term=term,
    adds=(MASS,),
    statement="the moving mass is {dM} beyond the configured mass",
    rig_check="Weigh what moves, the load included; on a step of speed the peak of the pressure "
    "force grows with it.",
    rig_twin="mass",
    starts=lambda r: ({"dM": 0.01 * r.force / max(r.acceleration, 1e-3)},),
)
