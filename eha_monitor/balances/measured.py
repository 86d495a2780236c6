"""How the motion of a recording is measured: what of it can be compared, and at which rate."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import compress

import numpy as np

from eha_monitor.balances.course import (
    BAND,
    BANDS,
    COMMANDED,
    GRID,
    MEASURED,
    MIXED,
    MOTION,
    STANDING,
    TRAVEL,
    Course,
    low_pass,
    passed,
    slope,
)
from eha_monitor.errors import InputError
from eha_monitor.estimation.hold_choice import command_is_held, followed
from eha_monitor.estimation.modelled import contributions_along
from eha_monitor.estimation.rig_model import added_by, force_missing, force_of
from eha_monitor.estimation.sensors import (
    noise_levels,
    quantum,
    undo_sensors,
    without_spikes,
)
from eha_monitor.indicators.laws import viscosity_factor
from eha_monitor.physics import signals as s
from eha_monitor.physics.contributions import circuit_of, new_memory
from eha_monitor.physics.parameters import theta_of
from eha_monitor.quantity import share
from eha_monitor.recordings.grid import filled
from eha_monitor.recordings.position import astray
from eha_monitor.recordings.recording import Recording, between_stops, sample_of, sampled_rows
from eha_monitor.settings.monitor import Settings
from eha_monitor.settings.rig import Rig

STEPS = 8  # of the effects' memory in a sample: a line is faster than the grid
BRIDGED = 0.1  # of a period of the motion's band: a gap that a straight line bridges
FADED = 0.01  # of the motion: what is left of a gap that may count
JOINED = 5.0  # periods of the band that a step takes to fade to 1e-5 of itself behind its low-pass
SPARSE = 0.4  # samples in a period of the band, inverted: fewer do not hold it
DEAD = 0.02  # s: a value that does not change for longer while others do ...
JUMPED = 5.0  # ... times the usual largest step away from what comes before or after
SHORTEST = 0.5  # s of usable recording
SELDOM = 0.5  # of the rows: a channel with values in fewer is why nothing is usable
CHANNELS = ("x", "x_d", "omega", "omega_d", "p1", "p2", "force")
GAUGE = 0.5  # of the ambient pressure: a reading below is no absolute pressure


def course_of(recording: Recording, settings: Settings, band: float = BAND) -> Course:
    """Return the measured motion of a recording, in the first band that it is not too quick for.

    Parameters
    ----------
    band : Hz, that it is in at least, where the channels hold that.

    Raises
    ------
    InputError
        As :func:`course_within`.
    """
    widest = max(one for one in BANDS if one == BAND or recording.sample_time * one <= SPARSE)
    found = course_within(recording, settings, min(band, widest))
    if found.band == widest or not (found.too_quick or found.has_flow):
        return found
    wide = course_within(recording, settings, widest)
    return wide if found.too_quick and wide.shows else replace(found, wide=wide)


def course_within(recording: Recording, settings: Settings, band: float) -> Course:
    """Return the measured motion of a recording, for balances up to ``band`` Hz.

    Raises
    ------
    InputError
        If position or force are missing, or less than ``SHORTEST`` s are usable.
    """
    rig, rows, recording = settings.rig, sampled_rows(len(recording)), sample_of(recording)
    why = force_missing(rig, [name for name in recording.channels if recording.has(name)])
    if why:
        raise InputError(f"{recording.source}: {why}")
    dt = recording.sample_time
    if dt * band > SPARSE:
        raise InputError(f"{recording.source}: expected at least {band / SPARSE:.3g} samples a "
                         f"second for balances below {band:g} Hz, found {1.0 / dt:.3g}")
    names = [name for name in CHANNELS if recording.has(name)]
    noise = noise_levels(recording, settings.noise)
    cleaned, _ = without_spikes({name: recording.channels[name] for name in names}, noise)
    off = astray(cleaned["x"], dt)
    cleaned["x"] = np.where(off.mask(len(rows)), np.nan, cleaned["x"])
    needed = [name for name in names if name not in ("x_d", "omega_d")]
    # A demand is no sensor: it may rest for long and jump.
    cleaned |= {name: np.where(_dead(cleaned[name], dt), np.nan, cleaned[name])
                for name in needed}
    theta, active = theta_of(rig, settings.effects)
    circuit = circuit_of(theta, active)
    true, noise = undo_sensors(cleaned, noise, circuit, rows * dt)
    bridged = round(BRIDGED / (MOTION * band * dt))
    missing = _gaps(~np.all([np.isfinite(true[name]) for name in needed], axis=0), bridged)
    # What stands still is as a straight line says; what was not recorded is not.
    missing |= _gaps(off.mask(len(rows)) | ~np.all([np.isfinite(recording.channels[name])
                                                    for name in needed], axis=0),
                     bridged, 1.0 / (band * dt))
    fades = round(JOINED / (band * dt))
    # Of two stretches, or where the position jumps: a step, for a low-pass.
    for join in (*np.flatnonzero(np.diff(rows) > 1), *off.jumps):
        missing[max(join - fades, 0):join + fades] = True
    whole = {name: filled(values) for name, values in true.items()}
    force = force_of(rig, whole)
    away = np.zeros(len(recording), dtype=bool)
    for first, last in between_stops(whole["x"], force, dt):
        away[first:last] = True

    every = max(1, round(1.0 / (GRID * band * dt)))
    cutoff = min(MOTION * band, 0.2 / dt)
    reach = max(1, round(MIXED / band / dt))
    bad = np.convolve(missing | ~away, np.ones(2 * reach + 1), mode="same") > 0.5
    bad[:reach] = bad[-reach:] = True

    def fine(values):
        return low_pass(values, cutoff, dt)[::every]

    x = low_pass(whole["x"], cutoff, dt)
    v = slope(x, dt)
    a, step, good = slope(v, dt)[::every], every * dt, ~bad[::every]
    if good.sum() * step < SHORTEST:
        seldom = {name: np.mean(np.isfinite(true[name])) for name in needed}
        least = min(seldom, key=seldom.get)
        raise InputError(
            f"{recording.source}: expected at least {SHORTEST:g} s of motion away from stops with "
            f"all channels, found {good.sum() * step:.2g} s" + (
                f"; {least} has a value in {share(seldom[least], 2)} of the rows"
                if seldom[least] < SELDOM else ""))
    v, x = v[::every], np.ascontiguousarray(x[::every])  # one layout for compiled loops
    p1, p2, omega = (fine(whole[name]) if name in whole else None
                     for name in ("p1", "p2", "omega"))
    rate_1, rate_2 = (None if p is None else slope(p, step) for p in (p1, p2))
    top = np.quantile(np.abs(v[good]), 0.998)
    slow = np.abs(v) < STANDING * top
    slow[1:] |= v[1:] * v[:-1] <= 0.0  # a quick reversal may fall between two points
    near = max(1, round(MIXED / band / step))
    moving = np.convolve(slow, np.ones(2 * near + 1), mode="same") < 0.5
    moving &= np.ptp(x[good]) > TRAVEL * noise["x"].value
    demand = whole.get("omega_d", whole.get("omega"))
    asked = _speed_demand(cleaned["x"], whole, rig, circuit, dt)
    held = circuit[s.DRIVE_LAG] > 0.0 and command_is_held(recording, settings)
    wanted = None if asked is None else _followed(asked, circuit, dt, held)
    pressures = [p[good] for p in (p1, p2) if p is not None]
    found = Course(
        recording.source, band, step, STEPS * every, x, v, a, fine(force), p1, p2, rate_1, rate_2,
        omega, None if wanted is None else fine(wanted), None if demand is None else fine(demand),
        COMMANDED if "omega_d" in whole else MEASURED, {}, _sensors(noise, cleaned),
        0.5 * dt, passed(dt, band), bool(pressures) and min(
            float(np.quantile(p, 0.01)) for p in pressures) < GAUGE * rig.ambient_pressure,
        rig.area_2 / rig.area_1 if rig.area_1 and rig.area_2 else None, good, moving & good,
        viscosity=_viscosity(recording, settings), effects=settings.effects)
    found.known.update(known_of(found, rig, theta, active))
    return found


def _viscosity(recording: Recording, settings: Settings) -> float:
    """Return the oil's viscosity over that at the reference temperature; NaN if not measured."""
    if not recording.has("temperature"):
        return np.nan
    return 1.0 / viscosity_factor(
        settings.viscosity, float(np.nanmean(recording.channels["temperature"])))


def _gaps(missing: np.ndarray, short: int, period: float = 0.0) -> np.ndarray:
    """Return where samples are missing, (n,) bool, without runs of up to ``short`` of them.

    With what the low-pass of the band makes of a straight line over them: it is wrong by (gap /
    period)^2 of the motion, all of it at most, and fades to a tenth in each ``period`` (samples;
    0: the line is right).
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[False], missing, [False]])))
    found = np.zeros(len(missing), dtype=bool)
    for start, stop in edges.reshape(-1, 2):
        if stop - start > short:
            wrong = min((stop - start) / max(period, 1e-9), 1.0) ** 2
            fades = round(max(np.log10(wrong / FADED), 0.0) * period)
            found[max(start - fades, 0) : stop + fades] = True
    return found


def courses_of(recordings: Sequence[Recording], settings: Settings, band: float = BAND
               ) -> tuple[list[Recording], list[Course], tuple[str, ...]]:
    """Return the recordings that hold a motion, their motions, and why others are left out.

    All are kept where nothing moves in any.  They are of one band, that of the quickest: a late
    channel is a mass in one band and none in another.

    Parameters
    ----------
    band : Hz, that they are in at least.

    Raises
    ------
    InputError
        If none has a balance.
    """
    kept, courses, problems = [], [], []
    for recording in recordings:
        try:
            courses.append(course_of(recording, settings, band))
            kept.append(recording)
        except InputError as problem:
            problems.append(problem)
    if not courses:
        raise problems[0]
    lines = [f"left out: {problem}" for problem in problems]
    moves = [course.shows for course in courses]
    if any(moves):  # at rest a seal holds whatever load there is
        lines += [f"left out: {course.source}: {course.still}" for course in courses
                  if course.still]
        kept, courses = list(compress(kept, moves)), list(compress(courses, moves))
    widest = max(course.band for course in courses)
    courses = [course if course.band == widest else course_of(recording, settings, widest)
               for recording, course in zip(kept, courses, strict=True)]
    return kept, courses, tuple(lines)


def known_of(course: Course, rig: Rig, theta: np.ndarray, active: np.ndarray
             ) -> dict[str, np.ndarray]:
    """Return what the config adds to each balance beyond B, D_p and the compliance, SI.

    The force of its mass and effects, (m,), and the flow of its leakage and effects as of either
    chamber, (2, m), by the catalogue's own compiled terms along the measured motion.  A volume
    that changes over the stroke is in the compliance, which is fitted, and not in the flow.
    """
    zero = np.zeros(len(course))
    c = np.zeros((len(course), s.N_CONTRIBUTIONS))
    # As in the stages: a term of the shaft's angle, which no recording has, is left out.
    active = np.array([on and bool(added_by(which, theta)) for which, on in enumerate(active)])
    if active.any():
        contributions_along(course.track(), course.dt, course.steps, theta, active,
                            new_memory(), c)
    known = {"force": c[:, s.FORCE] + (rig.mass + c[:, s.MASS]) * course.a, "drive": zero}
    if active.any():
        known["at_rest"] = _at_rest(course, theta, active)
    if not course.has_flow:
        return known
    pump = (rig.pump_displacement or 0.0) * c[:, s.SPEED]
    crossing = 0.5 * (rig.leakage - rig.makeup_conductance) * (course.p1 - course.p2)
    left, stroke = [], []
    for sign, ratio, p, rate, volume, own, more, into in (
            (1.0, 1.0, course.p1, course.rate_1, s.VOLUME_1, rig.volume_1, s.COMPLIANCE_1,
             s.FLOW_1),
            (-1.0, course.ratio, course.p2, course.rate_2, s.VOLUME_2, rig.volume_2,
             s.COMPLIANCE_2, s.FLOW_2)):
        soft = ((own or 0.0) + c[:, volume]) * c[:, more]
        makeup = rig.makeup_conductance * (p - rig.charge_pressure)
        left.append(sign / ratio * (c[:, into] - sign * crossing - makeup - soft * rate))
        stroke.append(sign / ratio * c[:, volume] * rate)
    return known | {"flow": pump + np.stack(left), "stroke": np.stack(stroke)}


def _at_rest(course: Course, theta: np.ndarray, active: np.ndarray) -> np.ndarray:
    """Return the force that the config's effects make at rest at each place of a motion, (m,) N.

    A spring, a weight, a table over the stroke: what the rod holds, whatever it does.
    """
    track = np.zeros((len(course), s.N_SIGNALS))
    track[:, s.X] = course.x
    c = np.zeros((len(course), s.N_CONTRIBUTIONS))
    contributions_along(track, course.dt, 0, theta, active, new_memory(), c)
    return c[:, s.FORCE]


def _sensors(noise: dict, channels: dict[str, np.ndarray]) -> dict[str, float]:
    """Return the noise of position, pressures (the larger), pump speed and force in a sample."""
    x = channels["x"]
    level = {name: one.value for name, one in noise.items()}
    return {"x": float(np.hypot(level.get("x", 0.0),
                                quantum(x[np.isfinite(x)]) / np.sqrt(12.0))),
            "p": max(level.get("p1", 0.0), level.get("p2", 0.0)),
            "omega": level.get("omega", 0.0), "force": level.get("force", 0.0)}


def _ahead(values: np.ndarray, lead: float, dt: float) -> np.ndarray:
    """Return samples (n,) from ``lead`` s later."""
    if lead == 0.0:
        return values
    t = np.arange(len(values)) * dt
    return np.interp(t + lead, t, values)


def _speed_demand(shown: np.ndarray, true: dict[str, np.ndarray], rig: Rig, w: np.ndarray,
                  dt: float) -> np.ndarray | None:
    """Return the speed that is demanded of the drive, late as it comes, (n,) rad/s.

    None where nothing says.

    ``shown`` is the position as its sensor shows it, NaN where missing: a loop in which that
    stands reads it.
    """
    if "omega" not in true:
        return None
    if "omega_d" in true:
        return _ahead(true["omega_d"], -w[s.COMMAND_DELAY], dt)
    if "x_d" not in true or rig.position_gain is None:
        return None
    read, lead = (filled(shown), w[s.POSITION_DELAY]) if w[s.IN_LOOP] else (true["x"], 0.0)
    return rig.position_gain * (_ahead(true["x_d"], -w[s.COMMAND_DELAY], dt)
                                - _ahead(read, lead - w[s.FEEDBACK_DELAY], dt))


def _followed(demand: np.ndarray, w: np.ndarray, dt: float, held: bool) -> np.ndarray:
    """Return the speed that the config's drive makes of a demand, (n,) rad/s.

    ``held`` : it holds the demand over each sample.
    """
    made = np.clip((1.0 + w[s.DRIVE_GAIN]) * demand, -w[s.SPEED_LIMIT], w[s.SPEED_LIMIT])
    if w[s.DRIVE_LAG] > 0.0:
        end = np.concatenate([made[:1], made[:-1]]) if held else made
        made = followed(made, end, w[s.DRIVE_LAG], dt)
    return made


def _dead(values: np.ndarray, dt: float) -> np.ndarray:
    """Return which samples are dead, (n,) bool: held for long, and far from before or after.

    A sensor that drops to nil or a logger that repeats its last value; a position at rest is
    neither, since it goes on from where it stood.
    """
    starts = np.flatnonzero(np.concatenate([[True], values[1:] != values[:-1]]))
    lengths = np.diff(np.append(starts, len(values)))
    jumps = np.abs(np.diff(values))
    moved = jumps[np.isfinite(jumps) & (jumps > 0.0)]
    if not len(moved):
        return np.zeros(len(values), dtype=bool)
    far = JUMPED * np.quantile(moved, 0.98)
    before = np.concatenate([[0.0], jumps])[starts]
    after = np.append(jumps, 0.0)[starts + lengths - 1]
    dead = (lengths * dt > DEAD) & (np.maximum(np.nan_to_num(before), np.nan_to_num(after)) > far)
    return np.repeat(dead, lengths)
