"""A friction feed-forward table as a ROS parameter file, for a joint under ros2_control."""

from collections.abc import Sequence
from io import StringIO

import numpy as np
from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq

from eha_monitor import __version__
from eha_monitor.exports.friction import law_of, motion_of, table_velocities
from eha_monitor.exports.model import Exported, Model
from eha_monitor.quantity import quantity
from eha_monitor.recordings.recording import Recording

NODE, CONTROLLER = "friction_feedforward", "joint_trajectory_controller"
ENOUGH = 0.1  # s of motion near a velocity: it is covered
DERIVATIVE = 0.02  # s over which the position is fitted for its rate


def feedforward_of(model: Model, joint: str, recordings: Sequence[Recording] = ()) -> Exported:
    """Return the table, and the one number of it that a controller of ros2_controllers takes.

    Parameters
    ----------
    recordings : what the model was identified from: they tell which velocities are covered.
    """
    motion = motion_of(model)
    seen = [velocity_of(one) for one in recordings]
    fastest = max([motion.speed, *(float(np.nanmax(np.abs(v), initial=0.0)) for v in seen)])
    velocity = table_velocities(max(fastest, 1e-6))
    law = law_of(model, velocity)
    unit = ("rad/s", "N·m", "N·m·s/rad", "kg·m²") if model.rotary else ("m/s", "N", "N·s/m", "kg")
    table = CommentedMap()
    _add(table, "joint", joint, "")
    _add(table, "velocity", _row(velocity), f"{unit[0]}, ascending")
    _add(table, "force", _row(law.force), f"{unit[1]} to keep that velocity at x = 0: B v and "
         "all named effects of the force balance")
    _add(table, "friction", _row(law.dry), f"{unit[1]} of it: what is neither B v nor the load")
    _add(table, "viscous_damping", float(law.viscous), f"{unit[2]}, B")
    _add(table, "load", _number(law.load), f"{unit[1]} at rest, against positive motion")
    _add(table, "moving_mass", _number(law.mass), f"{unit[3]}, for a force with the acceleration")
    if recordings:
        seconds = covered_seconds(velocity, seen, [one.sample_time for one in recordings])
        _add(table, "covered_seconds", _row(seconds), "s of the recordings near each velocity")
        _add(table, "covered", _flow([bool(one >= ENOUGH) for one in seconds]),
             f"at least {ENOUGH:g} s: elsewhere the law is extrapolated")
    gains = CommentedMap({"gains": CommentedMap({joint: CommentedMap()})})
    _add(gains["gains"][joint], "ff_velocity_scale", float(law.viscous),
         f"{unit[2]}: B, with the command interface effort only", indent=8)
    tree = CommentedMap({NODE: CommentedMap({"ros__parameters": table}),
                         CONTROLLER: CommentedMap({"ros__parameters": gains})})
    lost = _lost(model, law, unit[1], bool(recordings))
    head = [f"Friction feed-forward of {model.settings.rig.name}: eha_monitor {__version__}, "
            f"from {model.source}.",
            f"{NODE}: a table for a node of your own; no controller of ros2_controllers reads it.",
            f"{CONTROLLER}: its one feed-forward number, to be merged with your parameters.",
            *(f"Not in this file: {one}" for one in lost)]
    tree.yaml_set_start_comment("\n".join(" ".join(line.split()) for line in head))
    yaml, text = YAML(), StringIO()
    yaml.width = 98
    yaml.dump(tree, text)
    return Exported(text.getvalue(), lost)


def _lost(model: Model, law, force: str, covered: bool) -> tuple[str, ...]:
    lost = [f"{name}: the force depends on the position; taken at x = 0"
            for name in law.by_position]
    lost += [f"{name}: taken at the charge pressure, "
             f"{quantity(model.settings.rig.charge_pressure, 'Pa', 3)}"
             for name in law.names if "pressure" in name]
    if np.ptp(law.dry) > 0.0:
        lost.append(f"{CONTROLLER}: ff_velocity_scale is B alone; the dry friction of up to "
                    f"{quantity(float(np.abs(law.dry).max()), force, 3)} goes in as effort of "
                    "the trajectory's points")
    if not covered:
        lost.append("which velocities the data covered: give --recording BAG")
    return tuple(lost)


def velocity_of(recording: Recording) -> np.ndarray:
    """Return the velocity of a recording, m/s (n,): measured, or the position's rate."""
    if recording.has("v"):
        return np.asarray(recording.channels["v"])
    if not recording.has("x"):
        return np.zeros(0)
    from scipy.signal import savgol_filter

    x = np.asarray(recording.channels["x"])
    half = max(2, round(0.5 * DERIVATIVE / recording.sample_time))
    if len(x) <= 2 * half:
        return np.zeros(0)
    good = np.isfinite(x)
    whole = np.interp(np.arange(len(x)), np.flatnonzero(good), x[good])
    rate = savgol_filter(whole, 2 * half + 1, 2, deriv=1, delta=recording.sample_time)
    return np.where(good, rate, np.nan)


def covered_seconds(velocity: np.ndarray, seen: Sequence[np.ndarray],
                    sample_times: Sequence[float]) -> np.ndarray:
    """Return how long the recordings went at about each velocity of the table, s (n,)."""
    edges = np.concatenate([[-np.inf], 0.5 * (velocity[1:] + velocity[:-1]), [np.inf]])
    return sum((np.histogram(v[np.isfinite(v)], edges)[0] * dt
                for v, dt in zip(seen, sample_times, strict=True)), np.zeros(len(velocity)))


def _add(table: CommentedMap, key: str, value, comment: str, indent: int = 4) -> None:
    table[key] = value
    if comment:
        table.yaml_set_comment_before_after_key(key, before=comment, indent=indent)


def _row(values: np.ndarray) -> CommentedSeq:
    return _flow([_number(one) for one in values])


def _flow(values: list) -> CommentedSeq:
    row = CommentedSeq(values)
    row.fa.set_flow_style()
    return row


def _number(value: float) -> float:
    return float(f"{value:.7g}") + 0.0  # 0.0, not -0.0
