"""A stranger's rig for the tests of the balances: the motion is given, the forces follow."""

import numpy as np

from eha_monitor.balances.machine import healthy_machine_of, machine_from
from eha_monitor.balances.measured import course_of, courses_of
from eha_monitor.balances.policy import POLICY
from eha_monitor.balances.together import of_one_machine
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings import load_settings

A_1, A_2 = np.pi / 4 * 0.040**2, np.pi / 4 * (0.040**2 - 0.025**2)  # m^2, rod of 25 mm


def stranger(seed=0, dry=180.0, rise=80.0, damping=(1500.0, 1275.0), load=338.0, mass=60.0,
             seconds=24.0, dt=2e-3, late=0.0, dead=False, stop=False, presses=4000.0, dwells=0,
             spring=0.0, travel=1.0, grows=0.0):
    """Return a recording of an inclined single-rod cylinder with 12-bit sensors.

    B runs from the first to the second value of ``damping``; friction has a Stribeck ``rise``.
    ``late`` : delay of the pressures, s.  ``dead`` : samples that fall to nil or stand.
    ``stop`` : the end of the record presses against a stop with the force ``presses``.
    ``dwells`` : so many stretches of 1.2 s at rest, in which friction holds any force.
    ``spring`` : N/m, against which it moves.
    ``travel`` : share of the usual motion, and of the encoder's step.
    ``grows`` : m^2, by which dry friction grows with the sum of the pressures.
    """
    rng = np.random.default_rng(seed)
    h = dt / 4
    t = np.arange(0.0, seconds, h)
    phase = rng.uniform(0.0, 2 * np.pi, 4)
    w = 2 * np.pi * np.array([0.11, 0.31, 0.73, 1.9])
    size = travel * np.array([0.06, 0.03, 0.008, 0.001]) * rng.uniform(0.8, 1.2, 4)
    x = 0.2 + sum(a * np.sin(b * t + c) for a, b, c in zip(size, w, phase, strict=True))
    x = np.where(t < 1.0, x[np.searchsorted(t, 1.0)], x)  # it stands first
    if stop:
        last = t > seconds - 3.0
        x[last] = x[last][0] + (x.max() + 0.02 - x[last][0]) * np.minimum(
            1.0, (t[last] - t[last][0]) / 1.0)
    rests = np.zeros(len(t), dtype=bool)
    for start in np.linspace(3.0, seconds - 4.0, dwells):
        hold = (t >= start) & (t < start + 1.2)
        x = x.copy()
        x[t >= start + 1.2] += x[hold][0] - x[hold][-1]
        x[hold] = x[hold][0]
        rests |= (t >= start + 0.02) & (t < start + 1.18)
    kernel = np.hanning(41) / np.hanning(41).sum()
    x = np.convolve(np.pad(x, 20, mode="edge"), kernel, mode="valid")
    v = np.gradient(x, h)
    a = np.gradient(v, h)
    b = np.linspace(*damping, len(t))
    friction = (dry + rise * np.exp(-((v / 0.01) ** 2))) * np.tanh(v / 2e-4)
    reaction = 0.9 * (dry + rise) * np.sign(np.sin(1.7 * t)) * np.exp(-(t % 1.2))
    force = mass * a + b * v + np.where(rests, reaction, friction) + load + spring * (x - 0.2)
    if stop:
        force[(t > seconds - 2.0)] = presses
    p2 = 8e5 + 2e5 * np.sin(0.7 * t)
    p1 = (force + A_2 * p2) / A_1
    p1 += grows * (p1 + p2) * np.tanh(v / 2e-4) / A_1

    def sampled(values, span, delay=0.0):
        step = span / 4096
        at = np.arange(0.0, seconds, dt)
        noisy = np.interp(at - delay, t, values) + 0.5 * step * rng.standard_normal(len(at))
        return np.round(noisy / step) * step

    channels = {"x": sampled(x, 0.5 * travel), "p1": sampled(p1, 160e5, late),
                "p2": sampled(p2, 160e5, late)}
    if dead:
        channels["p1"][2000:2030] = 0.0
        channels["x"][5000:5060] = channels["x"][5000]
        channels["p2"][7000:7200] = np.nan
    return Recording(dt, channels, source=f"stranger {seed}")


def stranger_settings(tmp_path):
    """Return the config of that rig, from its data sheet."""
    path = tmp_path / "rig.yaml"
    path.write_text(f"""/**:
  ros__parameters:
    rig: {{name: stranger, area_1: {A_1}, area_2: {A_2}, volume_1: null, volume_2: null,
           pump_displacement: null, position_gain: null, mass: 55.0, viscous_damping: 1000.0,
           charge_pressure: 5.0e5, sample_time: 2.0e-3}}
""", encoding="utf-8")
    return load_settings(path)


def machine_of(recordings, settings, vary=()):
    """Return the machine that several recordings of one rig show, ``vary`` known to differ."""
    courses = of_one_machine([course_of(one, settings) for one in recordings], settings.rig,
                             POLICY)
    return machine_from(courses, settings.rig, vary, (), POLICY)


def healthy_machine(recordings, settings):
    """Return the machine of healthy recordings."""
    return healthy_machine_of(courses_of(recordings, settings)[1], settings)
