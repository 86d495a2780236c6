"""Rigs whose balances are compared as they stand: clean, and with one known effect.

The recordings are made here with a few lines of numpy: a motion is prescribed, the force, flow
and speed that it takes are written down with B and effects of the draw's own, and sensors add
noise and steps.  Nothing of the simulator or of the catalogue takes part.
"""

from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d

from eha_monitor.recordings.recording import Recording
from eha_monitor.settings import load_settings

CONFIG = Path(__file__).resolve().parent.parent / "config"
# Names that are the same thing in these recordings.
LEAKS = {"cross_port_leakage", "external_leakage", "turbulent_leakage", "pump_volumetric_loss",
         "leakage_offset"}
FRICTION = {"coulomb_friction", "asymmetric_friction", "stribeck_friction", "presliding_friction"}
CASES = {
    "eha": {"clean": set(), "coulomb": FRICTION | {"pressure_friction"}, "leakage": LEAKS,
            "saturation": {"drive_saturation"}},
    "hsm": {"clean": set(), "coulomb": FRICTION | {"pressure_friction"}},
    "seals": {"clean": set(), "coulomb": FRICTION, "pressure": {"pressure_friction"}},
}
EHA_CONFIG, HSM_CONFIG, SEALS_CONFIG = "ivliev_eha", "hsm150", "pneumatic_seals"


def ramps(t, places, speeds, rng, soft=0.05):
    """Return a position that goes from place to place at given speeds and rests between."""
    x, now, at = np.full(len(t), places[0]), places[0], 2.0 + rng.uniform(0.0, 1.0)
    for place, speed in zip(places[1:], speeds, strict=True):
        lasting = abs(place - now) / speed
        share = np.clip((t - at) / lasting, 0.0, 1.0)
        x = np.where(t >= at, now + (place - now) * share, x)
        now, at = place, at + lasting + rng.uniform(1.0, 2.0)
    return gaussian_filter1d(x, soft / (t[1] - t[0]))


def eha(case, seed):
    """Return a recording of a single-rod rig with several bar of noise, 25 µm steps."""
    settings, rng = load_settings(CONFIG / f"{EHA_CONFIG}.yaml"), np.random.default_rng(seed)
    rig, dt = settings.rig, 1e-3
    t = np.arange(0.0, 31.0, dt)
    v_0 = rng.uniform(0.010, 0.016)
    x = ramps(t, [0.0, 0.05, 0.0, 0.025, 0.005, 0.03],
              v_0 * np.array([1.0, 1.4, 0.6, 0.8, 1.8]), rng)
    v = np.gradient(x, dt)
    sign = np.tanh(v / 5e-5)
    force = rng.uniform(0.8e5, 2.0e5) * v + rig.mass * np.gradient(v, dt)
    if case == "coulomb":
        force = force + rng.uniform(500.0, 1200.0) * sign
    low = rng.uniform(2e5, 5e5)
    p1 = low + np.maximum(force, 0.0) / rig.area_1
    p2 = low + np.maximum(-force, 0.0) / rig.area_2
    p1 = np.where(force > 0, p1 + low * (rig.area_2 / rig.area_1 - 1.0), p1)
    p2 = np.where(force <= 0, p2 + low * (rig.area_1 / rig.area_2 - 1.0), p2)
    beta = rng.uniform(1.5e8, 5e8)
    leak = rng.uniform(1.0e-12, 3.0e-12) if case == "leakage" else 0.0
    into_1 = rig.area_1 * v + leak * (p1 - p2) + rig.volume_1 / beta * np.gradient(p1, dt)
    out_2 = rig.area_2 * v + leak * (p1 - p2) - rig.volume_2 / beta * np.gradient(p2, dt)
    flow = np.where(p1 > p2, into_1, out_2 * rig.area_1 / rig.area_2)
    omega = flow / rig.pump_displacement
    told = gaussian_filter1d(omega, 5)
    made = told
    if case == "saturation":
        most = 0.75 * np.quantile(np.abs(told), 0.99)
        made, told = omega, np.where(np.abs(omega) > most, 1.4 * omega, omega)
        made = np.clip(told, -most, most)
        # The piston follows what the pump gives.
        x = x + np.cumsum(made - omega) * dt * rig.pump_displacement / rig.area_1
        v = np.gradient(x, dt)
    noisy = {"x": 2.5e-5 * np.round((x + 3e-6 * rng.standard_normal(len(t))) / 2.5e-5),
             "omega": made + 0.12 * rng.standard_normal(len(t)), "omega_d": told,
             "p1": p1 + 0.65e5 * rng.standard_normal(len(t)),
             "p2": p2 + 2.2e5 * rng.standard_normal(len(t))}
    return [Recording(dt, noisy)], settings


def hsm(case, seed):
    """Return both directions of a rotary rig with 0.03 N·m of torque noise."""
    settings, rng = load_settings(CONFIG / f"{HSM_CONFIG}.yaml"), np.random.default_rng(seed)
    dt, b = 1e-3, rng.uniform(5e-5, 3e-4)
    dry = rng.uniform(0.01, 0.04) if case == "coulomb" else 0.0
    found = []
    for way in (1.0, -1.0):
        t = np.arange(0.0, 20.0, dt)
        step = 6.283185e-4
        speed = way * gaussian_filter1d(np.interp(t, np.arange(0.0, 21.0, 2.5), np.r_[
            0.0, rng.uniform(30.0, 200.0, 8)]), 100)
        x = np.cumsum(speed) * dt
        torque = 1.2e-4 * np.gradient(speed, dt) + b * speed + dry * np.tanh(speed / 0.05)
        found.append(Recording(dt, {
            "x": step * np.round(x / step), "force": torque + 0.03 * rng.standard_normal(len(t))}))
    return found, settings


def seals(case, seed):
    """Return strokes at 1 and 5 bar of a rig whose motion answers within a sample."""
    settings, rng = load_settings(CONFIG / f"{SEALS_CONFIG}.yaml"), np.random.default_rng(seed)
    dt, b = 1e-2, rng.uniform(300.0, 900.0)
    found = []
    dry, slope = rng.uniform(3.0, 8.0), rng.uniform(2e-6, 6e-6)
    for bar in (1.0, 5.0):
        t = np.arange(0.0, 40.0, dt)
        x = ramps(t, [0.0, 0.05, 0.01, 0.06, 0.0, 0.04],
                  rng.uniform(0.008, 0.02, 5), rng, 0.1)
        v = np.gradient(x, dt)
        pressure = 1e5 * bar * (1.0 + 0.05 * x / 0.06)
        force = b * v + np.gradient(v, dt)
        if case == "coulomb":
            force = force + dry * np.tanh(v / 2e-4)
        if case == "pressure":
            force = force + 2.0 * slope * pressure * np.tanh(v / 2e-4)
        area = settings.rig.area_1
        found.append(Recording(dt, {
            "x": 1e-6 * np.round((x + 6e-6 * rng.standard_normal(len(t))) / 1e-6),
            "p1": pressure + force / area + 30.0 * rng.standard_normal(len(t)),
            "p2": pressure + 140.0 * rng.standard_normal(len(t))}))
    return found, settings


MAKERS = {"eha": eha, "hsm": hsm, "seals": seals}


def right(found, wanted):
    """Tell whether a diagnosis says what is there, and nothing more than its class."""
    names = [effect.name for effect in found.effects]
    if not wanted:
        return found.verdict == "consistent" and not names
    first = {names[0], *found.effects[0].indistinguishable_from} if names else set()
    return found.verdict == "mismatch" and bool(first & wanted)
