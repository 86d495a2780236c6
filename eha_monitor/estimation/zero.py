"""The zero of the recorded position beside that of the drive's controller.

    omega = s K_pos (x_d - (x - b)),     s K_pos b the intercept of a line, s near 1

A logger with a sensor of its own, or with the controller's read by another calibration, has
another zero.  The piston does not mind, but the loop of a model does: of 0.1 mm a gain of
23000 rad/s/m makes 2.3 rad/s that no pump turns, and stage two finds a mismatch 30 times the
noise; 2 um are enough for one.  So the setpoint is moved to the zero of the recorded position, on
which volumes and springs are placed.
"""

from dataclasses import replace

import numpy as np

from eha_monitor.balances.least_squares import independent
from eha_monitor.estimation.hold_choice import for_stages, resolved
from eha_monitor.estimation.inputs import inputs_of
from eha_monitor.estimation.pipeline import hand_over, run_stage_one, run_stage_two
from eha_monitor.estimation.results import LARGEST_NIS
from eha_monitor.quantity import with_uncertainty
from eha_monitor.recordings.columns import mapped
from eha_monitor.recordings.recording import ChannelFinding, Recording, sample_of
from eha_monitor.settings.monitor import Settings

NEEDED = ("x", "x_d", "omega")
SURE = 4.0  # standard deviations
LEAST = 1e-3  # of the speed's rms: less shows in no filter
LAW = 0.3  # of the speed may be left: beyond, the drive follows another law, or far behind
WITHIN = 0.9  # of the top speed: where a limit holds the drive, it does not follow
FEWEST = 200  # samples
ROUNDED = 1e-9  # of the speed's rms: recordings without noise know no more


def zero_of(recording: Recording, settings: Settings) -> tuple[float, float] | None:
    """Return by how much the recorded position reads more than the controller's, and deviation.

    In m; None where the recording does not say it, or says that there is none.
    """
    gain = settings.rig.position_gain
    if not gain or not recording.has(*NEEDED) or recording.has("omega_d"):
        return None
    x, wanted, omega = (sample_of(recording).channels[name] for name in NEEDED)
    asked = gain * (wanted - x)
    top = float(np.nanmax(np.abs(omega), initial=0.0))
    followed = np.isfinite(asked + omega) & (np.abs(asked) < WITHIN * top)
    if followed.sum() < FEWEST:
        return None
    size, spread = float(np.std(omega[followed])), float(np.std(asked[followed]))
    if not min(size, spread) > 0.0:
        return None
    # A gain that is off by a tenth is off by a tenth of the zero, and not of the motion.
    slope, constant = np.polyfit(asked[followed], omega[followed], 1)
    left = np.where(followed, omega - slope * asked - constant, np.nan)
    rest = float(np.nanstd(left))
    if not (rest < LAW * size and slope > 0.0 and abs(constant) > LEAST * size):
        return None
    far = 1.0 + (float(np.mean(asked[followed])) / spread) ** 2
    stddev = max(rest * float(np.sqrt(far * independent(left) / followed.sum())), ROUNDED * size)
    return (float(constant / (slope * gain)), float(stddev / (slope * gain))) if (
        abs(constant) > SURE * stddev) else None


def at_one_zero(recording: Recording, settings: Settings
                ) -> tuple[Recording, tuple[ChannelFinding, ...]]:
    """Return a recording with its setpoint at the zero of its position, and what says so."""
    found = zero_of(recording, settings)
    if found is None:
        return recording, ()
    value, stddev = refined(recording, settings, *found)
    said = ChannelFinding(words_of(value, stddev, settings), "zero", ("x", "x_d"))
    return moved(recording, value), (said,)


def words_of(value: float, stddev: float, settings: Settings) -> str:
    """Return what a zero says, in a sentence."""
    unit = "rad" if settings.rig.motion == "rotary" else "m"
    return (f"x reads {with_uncertainty(abs(value), stddev, unit)} "
            f"{'more' if value > 0.0 else 'less'} than the drive's controller, as the pump's "
            "speed says: x_d is moved to the zero of x")


def moved(recording: Recording, value: float) -> Recording:
    """Return a recording with its setpoint moved by ``value``, m."""
    return replace(recording, channels=recording.channels | {
        "x_d": mapped(lambda wanted: wanted + value, recording.channels["x_d"])})


def refined(recording: Recording, settings: Settings, value: float, stddev: float
            ) -> tuple[float, float]:
    """Return a zero as stage two knows it better than the speed's sensor, within its deviation.

    Its innovations nu, of variance S, go with the zero by their slope s: the information
    sum s^2 / S is that of the filter, where it fits.
    """
    piece = moved(sample_of(recording), value)
    settings, decision = resolved([piece], settings)
    settings = for_stages(settings, decision)
    inputs = inputs_of(piece, settings)
    damping = hand_over(run_stage_one(inputs, piece, settings, []), settings, piece, [], inputs)
    first = run_stage_two(inputs, piece, settings, damping, [])
    if first.consistency is None or not first.consistency.nis < LARGEST_NIS:
        return value, stddev  # what else is missing would make a zero
    off = moved(piece, stddev)
    other = run_stage_two(inputs_of(off, settings), off, settings, damping, [])
    if len(first.innovation) != len(other.innovation):
        return value, stddev
    there = np.isfinite(first.innovation + other.innovation)
    nu, size = first.innovation[there], first.innovation_stddev[there]
    slope = (other.innovation[there] - nu) / stddev / size
    information = 1.0 / stddev**2 + float(slope @ slope)
    return value - float(slope @ (nu / size)) / information, information**-0.5
