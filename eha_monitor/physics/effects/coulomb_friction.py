"""Coulomb (dry) friction of seals and guides."""

from eha_monitor.compiled import njit
from eha_monitor.physics.dry_friction import (
    EQUATION,
    SOURCE,
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
    """Add F_c against the motion."""
    c[FORCE] += dry_force(s, p[0] * sliding(s, p[1], p[5]), p[2], p[3], p[4], m)


@njit
def update(s, p, h, m):
    """Remember the seal."""
    remember(s, p[0] * sliding(s, p[1], p[5]), p[2], m)


EFFECT = Effect(
    name="coulomb_friction",
    balance="force",
    equation=f"F_steady = F_c s,  {EQUATION}",
    source=f"Armstrong-Helouvry, Dupont, Canudas de Wit 1994, Eq. 1; {SOURCE}",
    parameters=(
        Parameter("F_c", "N", "Coulomb friction force", 0.0, 1e6, 20.0),
        V_E,
        Parameter("z_0", "m", "displacement over which the friction reverses", 0.0, 1.2e-5, 4e-6,
                  0.0),
        T_1,
        V_D,
        W,
    ),
    term=term,
    adds=(FORCE,),
    reads=(X, V),
    update=update,
    statement="Coulomb friction of {F_c} opposes the motion at every speed",
    rig_check="Push the depressurised rod by hand with a spring balance: the force at which it "
    "keeps creeping is F_c.",
    starts=lambda r: ({"F_c": 0.01 * r.force, **START},),
    remembers_place=True,
    family="dry",
    rarity=0,
    passive="motion",
)
