"""A position that comes in whole steps.

No term and no circuit: the step is found in the recording itself, where the positions are whole
multiples of it, and not by a fit.  The simulator makes it from ``noise.position_resolution``.
"""

from eha_monitor.physics.effect import Effect, Parameter

EFFECT = Effect(
    name="position_quantisation",
    balance="sensor",
    equation="x_s = q round(x / q)",
    source="uniform quantiser, Widrow, Kollar 2008",
    parameters=(
        Parameter("q", "m", "step of the position sensor", 0.0, 0.01, 1e-5),
    ),
    statement="the position comes in steps of {q}",
    rig_check="Read the resolution of the encoder or of its converter in the data sheet.",
    starts=lambda r: (),
)
