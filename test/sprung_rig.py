"""A cylinder against a spring, by arithmetic: four sensors, little noise."""

import numpy as np
from scipy.ndimage import gaussian_filter1d

from eha_monitor.recordings.recording import Recording
from eha_monitor.settings import settings_from_tree

AREA, DISPLACEMENT, B, DRY, SOFT, LEAK = 5e-4, 1.6e-7, 800.0, 120.0, 1e-13, 3e-13  # SI
STIFFNESS = 6e4  # N/m
SETTINGS = settings_from_tree({"rig": {
    "area_1": AREA, "area_2": AREA, "pump_displacement": DISPLACEMENT, "volume_1": 7e-5,
    "volume_2": 7e-5, "leakage": 2.0 * LEAK, "position_gain": None, "mass": 1.0}}, "rig.yaml")


def nothing(t, x, v):
    return np.zeros(len(t))


def behind_play(x, width):
    """Return what a sensor behind a play shows, which is ``width`` m from end to end."""
    shown, there = np.empty_like(x), x[0]
    for k, at in enumerate(x):
        there = min(max(there, at - 0.5 * width), at + 0.5 * width)
        shown[k] = there
    return shown


def one_wave(t, seed):
    return 0.02 * np.sin(2.0 * np.pi * 0.25 * t)


def two_waves(t, seed):
    return one_wave(t, seed) + 0.006 * np.sin(2.0 * np.pi * 0.7 * t + seed)


def strokes(t, seed):
    """Return strokes of 10 to 40 mm at 20 to 90 mm/s, which turn within some 40 ms."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(5e-3, 2e-2, 40) * (-1.0) ** np.arange(40)
    when = np.cumsum(np.abs(np.diff(places, prepend=0.0)) / rng.uniform(0.02, 0.09, 40))
    return gaussian_filter1d(np.interp(t, np.append(0.0, when), np.append(0.0, places)), 10)


def recorded(seed, force=nothing, leak=None, motion=two_waves, play=0.0, noise=1.0,
             drive=None):
    """Return 30 s of a motion.

    Parameters
    ----------
    force : t, x, v -> (n,) N more that it takes.
    leak : t, x, v, dp -> (n,) m³/s more.
    play : of the position sensor, m.
    noise : times 0.1 µm and 200 Pa.
    drive : gain of the position loop, rad/(s·m), and feed-forward of the speed, rad/m, that ask
        for the pump's speed; None where no demand is recorded.
    """
    rng, dt = np.random.default_rng(seed), 0.002
    t = dt * np.arange(15_000)
    x = motion(t, seed)
    v = np.gradient(x, dt)
    whole = np.gradient(v, dt) + B * v + STIFFNESS * x + DRY * np.tanh(v / 1e-3) + force(t, x, v)
    dp = whole / AREA
    flow = AREA * v + 0.5 * SOFT * np.gradient(dp, dt) + LEAK * dp
    if leak is not None:
        flow += leak(t, x, v, dp)
    channels = {"x": behind_play(x, play) + noise * 1e-7 * rng.standard_normal(len(t)),
                "omega": flow / DISPLACEMENT,
                "p1": 2e6 + 0.5 * dp + noise * 200.0 * rng.standard_normal(len(t)),
                "p2": 2e6 - 0.5 * dp + noise * 200.0 * rng.standard_normal(len(t))}
    if drive is not None:
        gain, feed = drive
        channels["x_d"] = x + (channels["omega"] - feed * v) / gain
    return Recording(dt, channels, source=f"run_{seed}")
