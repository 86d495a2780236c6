"""Friction of seals, guides and ports; how a dry friction turns over after a reversal."""

import math
from dataclasses import replace

from eha_monitor.compiled import njit
from eha_monitor.physics.effect import Effect, Parameter
from eha_monitor.physics.signals import FORCE, P1, P2, V, X

# What the dry frictions of the catalogue share: how the sign of the velocity turns over.
SOURCE = ("sign smoothed over v_e, turning over a displacement z_0 after Dahl 1968, micro damping "
          "of LuGre, Canudas de Wit, Olsson, Astrom, Lischinsky 1995, t_1 = sigma_1/sigma_0, "
          "fading over v_d after Olsson 1996")
EQUATION = ("F = f + t_1 e^-(v/v_d)^2 f',  df/d|x| = (F_steady - f) / z_0,  "
            "s = (1 - w) tanh(v / v_e) + w v / (v_e + |v|)")
V_E = Parameter("v_e", "m/s", "velocity over which the sign is smoothed", 1e-6, 1.0, 1e-3, 1e-3)
Z_0 = Parameter("z_0", "m", "displacement over which the friction reverses", 0.0, 1e-3, 4e-6, 0.0)
Z_RIGID = replace(Z_0, upper=1.2e-5)  # a longer one is a friction of its own, presliding
# sigma_1 = sqrt(sigma_0 M) damps the mass on its seal to half of critical (Canudas de Wit 1995,
# Table I): t_1 = sqrt(M / sigma_0), 1 to 10 ms here.
T_1 = Parameter("t_1", "s", "micro damping over micro stiffness of the seal", 0.0, 0.1, 2e-3, 0.0)
V_D = Parameter("v_d", "m/s", "speed above which the micro damping fades", 1e-4, 10.0, 5e-3, 5e-3)
W = Parameter("w", "", "share of the sign that turns over as slowly as v/(v_e + |v|), the rest as "
              "tanh(v/v_e)", 0.0, 1.0, 0.25, 0.0)
RESOLVED = 1e-6  # m; a seal that turns over less is rigid: its rate of deflection is no signal
SURE, SETTLED, FADED = 20.0, 40.0, 6.0  # where tanh is 1, exp(-r) is 0 and exp(-r^2) is 0
START = {"v_e": 2e-4, "z_0": 3e-6, "t_1": 3e-4, "v_d": 5e-3}


@njit(forceinline=True)
def sliding(s, v_e, w):
    """Return the sign of the velocity, smoothed over v_e; a share w has a long tail.

    No seal turns over as a tanh: an arc tangent has w = 0.7, v / sqrt(v^2 + v_e^2) 0.2.
    """
    ratio = abs(s[V]) / v_e
    sign = 1.0 if ratio > SURE else math.tanh(ratio)  # most of the time: spare the function
    if w > 0.0:
        sign += w * (ratio / (1.0 + ratio) - sign)
    return math.copysign(sign, s[V])


@njit(forceinline=True)
def held(s, steady, z, m):
    """Return the force of the seal's deflection, N, after Dahl.

    After a reversal it turns over a displacement of about ``z`` m towards the ``steady`` force in
    N: dF/d|x| = (steady - F) / z, with F = m[0] at x = m[1], so that a seal that is pushed without
    sliding acts as a spring.  z = 0 turns at once.
    """
    if z <= 0.0 or m[0] == steady:
        return steady
    turned = abs(s[X] - m[1]) / z
    if turned > SETTLED:
        return steady
    return steady + (m[0] - steady) * math.exp(-turned)


@njit(forceinline=True)
def dry_force(s, steady, z, t_1, v_d, m):
    """Return the dry friction, N: deflection and micro damping, F + t_1 exp(-(v/v_d)^2) F'."""
    force = held(s, steady, z, m)
    fade = s[V] / v_d
    if z <= 0.0 or t_1 <= 0.0 or force == steady or abs(fade) > FADED:
        return force
    return force + t_1 * math.exp(-fade * fade) * abs(s[V]) / max(z, RESOLVED) * (steady - force)


@njit(forceinline=True)
def remember(s, steady, z, m):
    """Keep deflection and place at the end of a step."""
    m[0] = held(s, steady, z, m)
    m[1] = s[X]


# Coulomb (dry) friction of seals and guides.
@njit
def coulomb_friction_term(s, p, m, c):
    """Add F_c against the motion."""
    c[FORCE] += dry_force(s, p[0] * sliding(s, p[1], p[5]), p[2], p[3], p[4], m)


@njit
def coulomb_friction_update(s, p, h, m):
    """Remember the seal."""
    remember(s, p[0] * sliding(s, p[1], p[5]), p[2], m)


COULOMB_FRICTION = Effect(
    name="coulomb_friction", balance="force",
    equation=f"F_steady = F_c s,  {EQUATION}",
    source=f"Armstrong-Helouvry, Dupont, Canudas de Wit 1994, Eq. 1; {SOURCE}",
    parameters=(
        Parameter("F_c", "N", "Coulomb friction force", 0.0, 1e6, 20.0),
        V_E, Z_RIGID, T_1, V_D, W,
    ),
    term=coulomb_friction_term, adds=(FORCE,), reads=(X, V), update=coulomb_friction_update,
    statement="Coulomb friction of {F_c} opposes the motion at every speed",
    rig_check="Push the depressurised rod by hand with a spring balance: the force at which it "
    "keeps creeping is F_c.",
    starts=lambda r: ({"F_c": 0.01 * r.force, **START},),
    remembers_place=True, family="dry", rarity=0, passive="motion",
)


# Dry friction that is larger at creeping speed than at speed.
@njit(forceinline=True)
def sliding_force(s, p):
    """Return g = F_c + F_d drop in N, F_d = F_s - F_c, and its deflection in m.

    The drop is exp(-u^delta) with u = |v/v_s|, and a share h of it the rational 1/(1 + u^2): how
    far its tail reaches is part of what the friction at speed and B are known to.
    The seal's stiffness is the same at every speed, so the deflection goes with the force; z_0 is
    the one at standstill.
    """
    ratio = abs(s[V]) / p[2]
    drop = math.exp(-(ratio ** p[7]))
    g = p[0] + p[1] * (drop + p[9] * (1.0 / (1.0 + ratio * ratio) - drop))
    most = p[0] + p[1]
    return g, (p[4] * g / most if most > 0.0 else 0.0)


@njit
def stribeck_friction_term(s, p, m, c):
    """Add the seal's force."""
    g, z = sliding_force(s, p)
    c[FORCE] += dry_force(s, g * sliding(s, p[3], p[8]), z, p[5], p[6], m)


@njit
def stribeck_friction_update(s, p, h, m):
    """Remember the seal."""
    g, z = sliding_force(s, p)
    remember(s, g * sliding(s, p[3], p[8]), z, m)


def stribeck_friction_starts(r):
    """Stribeck velocities over two decades, within the speeds of the record.

    An exponential drop meets any other on its way; from a Gaussian one at the wrong speed a fit
    shrinks it to nothing.
    """
    small = 0.01 * r.force
    speed = max(r.speed, 1e-6)
    return tuple({"F_c": small, "F_d": small, "v_s": share * speed,
                  **START, "delta": 1.0}
                 for share in (0.3, 0.1, 0.03, 0.006))


STRIBECK_FRICTION = Effect(
    name="stribeck_friction", balance="force",
    equation="F_steady = (F_c + F_d ((1 - h) exp(-u^delta) + h / (1 + u^2))) s,  u = |v| / v_s,  "
    f"{EQUATION}",
    source=f"Armstrong-Helouvry, Dupont, Canudas de Wit 1994, Eq. 5, F_d = F_s - F_c; {SOURCE}",
    parameters=(
        Parameter("F_c", "N", "Coulomb friction force at speed", 0.0, 1e6, 20.0),
        Parameter("F_d", "N", "what is added to it near standstill, F_s - F_c", 0.0, 1e6, 20.0),
        Parameter("v_s", "m/s", "Stribeck velocity, over which the addition falls", 1e-6, 10.0,
                  5e-3, 5e-3),
        V_E, Z_0, T_1, V_D,
        Parameter("delta", "", "exponent of the fall: 1 exponential, 2 Gaussian", 0.4, 3.0, 1.0,
                  2.0),
        W,
        Parameter("h", "", "share of the fall that is rational, 1/(1 + (v/v_s)^2), with a long "
                  "tail", 0.0, 1.0, 0.25, 0.0),
    ),
    term=stribeck_friction_term, adds=(FORCE,), reads=(X, V), update=stribeck_friction_update,
    statement="dry friction of {F_c} at speed rises by {F_d} below {v_s}",
    rig_check="Let the rod creep at a few speeds below v_s: the force to keep it moving must fall "
    "as the speed rises.",
    starts=stribeck_friction_starts,
    contains=("coulomb_friction",), remembers_place=True, family="dry", passive="motion",
)


# Dry friction whose presliding shows: the seal bends before it slides.  The law is that of Coulomb
# friction, with a z_0 that is a visible length.
PRESLIDING_FRICTION = Effect(
    name="presliding_friction", balance="force",
    equation=f"F_steady = F_c s,  {EQUATION}",
    source="Dahl 1968; the rigid limit of LuGre, Canudas de Wit, Olsson, Astrom, Lischinsky 1995, "
    "with sigma_0 = F_c / z_0",
    parameters=(
        Parameter("F_c", "N", "friction force once it slides", 0.0, 1e6, 20.0),
        V_E,
        Parameter("z_0", "m", "displacement over which the friction reverses", 1.2e-5, 1e-3, 4e-5,
                  4e-5),
        T_1, V_D, W,
    ),
    term=coulomb_friction_term, adds=(FORCE,), reads=(X, V), update=coulomb_friction_update,
    statement="dry friction of {F_c} builds up over {z_0} of travel after each reversal",
    rig_check="Move the rod back and forth by a tenth of a millimetre: force against position is "
    "a loop with rounded corners, z_0 wide.",
    starts=lambda r: ({"F_c": 0.01 * r.force, **START, "z_0": 2e-5},
                      {"F_c": 0.01 * r.force, **START, "z_0": 1e-4}),
    contains=("coulomb_friction",), remembers_place=True, family="dry", passive="motion",
)


# Dry friction of seals that the pressure presses on.
@njit(forceinline=True)
def steady(s, p):
    """Return mu (p1 + p2) against the motion, N; a pressure below zero presses on nothing."""
    return p[0] * max(s[P1] + s[P2], 0.0) * sliding(s, p[1], p[5])


@njit
def pressure_friction_term(s, p, m, c):
    """Add the seal's force."""
    c[FORCE] += dry_force(s, steady(s, p), p[2], p[3], p[4], m)


@njit
def pressure_friction_update(s, p, h, m):
    """Remember the seal."""
    remember(s, steady(s, p), p[2], m)


PRESSURE_FRICTION = Effect(
    name="pressure_friction", balance="force",
    equation=f"F_steady = mu (p1 + p2) s,  {EQUATION}",
    source=f"Ottestad, Nilsen, Hansen 2012, seal friction grows with pressure; {SOURCE}",
    parameters=(
        Parameter("mu", "m^2", "friction coefficient times contact area of the seals", 0.0, 1.0,
                  3e-6),
        V_E, Z_RIGID, T_1, V_D, W,
    ),
    term=pressure_friction_term, adds=(FORCE,), reads=(X, V, P1, P2),
    update=pressure_friction_update,
    statement="seal friction of {mu} times the sum of the chamber pressures opposes the motion",
    rig_check="Raise the charge pressure at the same motion: the friction must rise in "
    "proportion.",
    starts=lambda r: ({"mu": 0.005 * r.force / max(r.mean_pressure, 1e3), **START},),
    remembers_place=True, family="dry", passive="motion",
)


# Friction that is not the same in both directions.
@njit(forceinline=True)
def level(s, p):
    """Return the dry friction in this direction, N: it brakes in both, and drives in none."""
    return max(p[0] + math.copysign(1.0, s[V]) * p[1], 0.0)


@njit(forceinline=True)
def deflection(s, p):
    """Return the deflection at which the seal slides this way, m; its stiffness is one."""
    most = p[0] + abs(p[1])
    return p[4] * level(s, p) / most if most > 0.0 else 0.0


@njit
def asymmetric_friction_term(s, p, m, c):
    """Add the seal's force and dB |v|: more friction forwards is less backwards.

    In positive motion F_c + dF and B + dB act, in negative motion F_c - dF and B - dB.
    """
    c[FORCE] += p[2] * abs(s[V]) + dry_force(
        s, level(s, p) * sliding(s, p[3], p[7]), deflection(s, p), p[5], p[6], m)


@njit
def asymmetric_friction_update(s, p, h, m):
    """Remember the seal."""
    remember(s, level(s, p) * sliding(s, p[3], p[7]), deflection(s, p), m)


ASYMMETRIC_FRICTION = Effect(
    name="asymmetric_friction", balance="force",
    equation=f"F_steady = max(F_c + dF sgn v, 0) s, beside dB |v|;  {EQUATION}",
    source=f"Armstrong-Helouvry 1991, Sec. 2.3, other friction by direction; {SOURCE}",
    parameters=(
        Parameter("F_c", "N", "mean dry friction of both directions", 0.0, 1e6, 20.0),
        Parameter("dF", "N", "half the difference of dry friction, positive more than negative "
                  "motion", -1e6, 1e6, 10.0),
        Parameter("dB", "N*s/m", "half the difference of viscous damping, positive more than "
                  "negative motion", -1e6, 1e6, 100.0),
        V_E, Z_0, T_1, V_D, W,
    ),
    term=asymmetric_friction_term, adds=(FORCE,), reads=(X, V), update=asymmetric_friction_update,
    statement="friction differs by direction: {F_c} of dry friction on average, to which "
    "positive motion adds {dF:+} and {dB:+}, and negative motion the opposite",
    rig_check="Hold the same steady speed in both directions: the forces differ by twice "
    "dB |v| + dF, and not at rest.",
    starts=lambda r: ({"F_c": 0.01 * r.force, "dF": 0.01 * r.force,
                       "dB": 0.01 * r.force / max(r.speed, 1e-6), **START},),
    contains=("coulomb_friction",), remembers_place=True, family="dry", passive="motion",
    within=(("dF", "F_c"),),
    rarity=10,  # no likelier than Coulomb friction and a constant load, which do the same
)


# Friction that grows with the square of the speed: turbulent flow in ports and lines.
@njit
def quadratic_friction_term(s, p, m, c):
    """Add a_1 v |v|."""
    c[FORCE] += p[0] * s[V] * abs(s[V])


QUADRATIC_FRICTION = Effect(
    name="quadratic_friction", balance="force",
    equation="F = a_1 v |v|",
    source="turbulent pressure loss, Merritt 1967, Sec. 3-3",
    parameters=(Parameter("a_1", "N*s^2/m^2", "force over the square of the speed", 0.0, 1e9,
                          2000.0),),
    term=quadratic_friction_term, adds=(FORCE,), reads=(V,),
    statement="a force of {a_1} times the square of the speed opposes the motion",
    rig_check="Hold two steady speeds, one twice the other: beyond the viscous part the force "
    "must be four times as large.",
    starts=lambda r: ({"a_1": 0.01 * r.force / max(r.speed, 1e-6) ** 2},),
    passive="motion",
    mimics="dry",  # the tail of a Stribeck drop, B given a little less
)
