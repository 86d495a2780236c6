"""Dry friction whose presliding shows: the seal bends before it slides."""

from eha_monitor.compiled import njit
from eha_monitor.physics.dry_friction import (
    EQUATION,
    START,
    T_1,
    V_D,
    V_E,
    W,
    dry_force,
    remember,
    sliding,
)
from eha_monitor.physics.effect import Effect, Parameter
from eha_monitor.physics.signals import FORCE, V, X


@njit
def term(s, p, m, c):
    """Add F_c; the same law as Coulomb friction, z_0 is a visible length."""
    c[FORCE] += dry_force(s, p[0] * sliding(s, p[1], p[5]), p[2], p[3], p[4], m)


@njit
def update(s, p, h, m):
    """Remember the seal."""
    remember(s, p[0] * sliding(s, p[1], p[5]), p[2], m)


EFFECT = Effect(
    name="presliding_friction",
    balance="force",
    equation=f"F_steady = F_c s,  {EQUATION}",
    source="Dahl 1968; the rigid limit of LuGre, Canudas de Wit, Olsson, Astrom, Lischinsky 1995, "
    "with sigma_0 = F_c / z_0",
    parameters=(
        Parameter("F_c", "N", "friction force once it slides", 0.0, 1e6, 20.0),
        V_E,
        Parameter("z_0", "m", "displacement over which the friction reverses", 1.2e-5, 1e-3, 4e-5,
                  4e-5),
        T_1,
        V_D,
        W,
    ),
    term=term,
    adds=(FORCE,),
    reads=(X, V),
    update=update,
    statement="dry friction of {F_c} builds up over {z_0} of travel after each "
    "reversal",
    rig_check="Move the rod back and forth by a tenth of a millimetre: force against position is "
              "a "
    "loop with rounded corners, z_0 wide.",
    starts=lambda r: ({"F_c": 0.01 * r.force, **START, "z_0": 2e-5},
                      {"F_c": 0.01 * r.force, **START, "z_0": 1e-4}),
    contains=("coulomb_friction",),
    remembers_place=True,
    family="dry",
    passive="motion",
)
