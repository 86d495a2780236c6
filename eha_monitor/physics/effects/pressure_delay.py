"""Pressures that reach the recording late."""

from eha_monitor.compiled import njit
from eha_monitor.physics.effect import Effect, Parameter
from eha_monitor.physics.signals import PRESSURE_DELAY


@njit
def circuit(p, w):
    """Add T to the delay."""
    w[PRESSURE_DELAY] += p[0]


EFFECT = Effect(
    name="pressure_delay",
    balance="sensor",
    equation="p_s(t) = p(t - T), both chambers",
    source="dead time of sampling, filtering and bus",
    parameters=(
        Parameter("T", "s", "time from the pressures to their stamps in the recording", 0.0,
                  0.1, 1e-3),
    ),
    circuit=circuit,
    statement="the recorded pressures are {T} late",
    rig_check="Tap the blocked rod while a second sensor is on the same clock: the pressures "
              "must respond T later.",
    starts=lambda r: tuple({"T": share * r.sample_time} for share in (0.2, 1.0, 4.0)),
)
