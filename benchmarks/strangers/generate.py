"""From a stranger's rig to what the monitor gets: recording, and the config that init drafts."""

import math
from functools import lru_cache
from pathlib import Path

import numpy as np

from eha_monitor.concealed.generate import START_NS, write_both
from eha_monitor.draft.rig import Answers, rig_entries, seen_in
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.load import settings_from_tree, text_tree
from eha_monitor.settings.monitor import Settings
from eha_monitor.settings.rig import Tolerance
from strangers.draw import ERRORS, Setting, StrangerRig
from strangers.plant import ATMOSPHERE, DAHL, NO_FRICTION, PREROLL, recording

DRY = ("coulomb_friction", "stribeck_friction", "presliding_friction")
# What is as good a name as the effect's own on these rigs: dry friction of another law is the
# family's, and a leak to the tank is the make-up path's to a lower pressure.
CLASSES = {
    "coulomb_friction": DRY, "stribeck_friction": DRY,
    "external_leakage": ("external_leakage", "makeup_conductance", "charge_pressure"),
    "cross_port_leakage": ("cross_port_leakage", "leakage"),
    "drive_lag": ("drive_lag", "command_delay"),
}
SURE = 3.0  # deviations from a data sheet's number: nearer to it nobody can tell that it is wrong


def record(rig: StrangerRig, setting: Setting, seed: int, length: float | None = None
           ) -> tuple[Recording, Settings]:
    """Return a recording of a rig and the config of its owner.

    Parameters
    ----------
    seed : of the sensors' noise.
    length : s in place of the setting's.
    """
    return recorded(rig, setting, seed, length), settings_of(rig)


def recorded(rig: StrangerRig, setting: Setting, seed: int, length: float | None = None
             ) -> Recording:
    """Return the recording of a setting, in SI, pressures absolute as the config reads them."""
    channels = recording(rig.run(setting, length), seed)
    channels.pop("time")
    if rig.sensors.gauge:
        for name in ("p1", "p2"):
            channels[name] = channels[name] + ATMOSPHERE
    return Recording(1.0 / rig.rate, channels, START_NS, f"{rig.name}_{setting.name}")


@lru_cache(maxsize=256)
def settings_of(rig: StrangerRig) -> Settings:
    """Return the config that ``init`` drafts from the sheet and the first setting's recording."""
    return settings_from_tree(tree_of(rig), f"{rig.name}.yaml")


def tree_of(rig: StrangerRig) -> dict:
    """Return that config as plain data."""
    sheet = rig.sheet
    answers = {
        "bore": f"{1e3 * sheet.bore:g} mm", "rod": f"{1e3 * sheet.rod:g} mm",
        "rods": f"{sheet.rods}", "stroke": f"{1e3 * sheet.stroke:g} mm",
        "line_volume": f"{1e6 * sheet.line_volume:g} cm^3", "mass": f"{sheet.mass:g} kg",
        "pump_displacement": f"{sheet.displacement:.3g}", "leakage": f"{sheet.leakage:.2g}",
        "makeup_conductance": f"{sheet.makeup:.2g}",
        "charge_pressure": f"{1e-5 * sheet.charge:g} bar"}
    if sheet.gain is not None:
        answers["position_gain"] = f"{sheet.gain:.3g}"
    shown = seen_in(recorded(rig, rig.settings[0], 0))
    entries = rig_entries(Answers(answers, {}), shown, False, rig.name)
    return text_tree("rig:\n" + "".join(f"  {one.key}: {one.value}\n" for one in entries),
                     rig.name)


def truth_of(rig: StrangerRig, setting: Setting, length: float | None = None) -> dict:
    """Return what is true of a recording, in the form of a trial's key.

    Returns
    -------
    dict
        ``B`` its mean over the recording, ``B_span`` at the start and at the end (N s/m),
        ``beta_e`` (Pa), ``load`` (N), ``hold`` (samples), ``effects`` beyond the drafted config,
        each with the ``class`` of names that are right for it, ``beside`` what is true as well
        and need not be found, and ``rig_off``, the config's numbers beside the true ones, in
        tolerances.
    """
    c, length = rig.plant, length or setting.length
    running = PREROLL - min(setting.motion.before, 0.0)
    warm = 1.0 - np.exp(-(running + np.array([0.0, length])) / c.warming)
    mean = 1.0 - c.warming / length * float(
        np.exp(-running / c.warming) - np.exp(-(running + length) / c.warming))
    ends = setting.damping * (1.0 - c.damping_drop * warm)
    return {"rig": rig.name, "kind": rig.kind, "law": rig.law,
            "B": setting.damping * (1.0 - c.damping_drop * mean),
            "B_span": [float(end) for end in ends], "beta_e": c.bulk_modulus,
            "load": setting.load, "hold": rig.drive.hold,
            "effects": effects_of(rig, setting), "beside": beside_of(rig),
            "rig_off": rig_off(rig)}


def effects_of(rig: StrangerRig, setting: Setting) -> list[dict]:
    """Return the key's entries of the effects beyond the drafted config."""
    c, found = rig.plant, []

    def add(name, balance, **parameters):
        found.append(entry(name, balance, parameters))

    if c.friction == DAHL:
        add("coulomb_friction", "force", F_c=c.dry)
    elif c.friction != NO_FRICTION:
        add("stribeck_friction", "force", F_c=c.dry, F_d=c.breakaway - c.dry)
    if setting.load:
        add("constant_load", "force", F_0=setting.load)
    if leak_shows(rig):
        add("external_leakage", "flow", L_1=c.case_leakage, L_2=c.case_leakage_2)
    if leaks_by(rig) > SURE + 1.0:
        add("cross_port_leakage", "flow", L=leak_beyond(rig))
    return found


def leaks_by(rig: StrangerRig) -> float:
    """Return how far the leakage is from the sheet's, in deviations of its order of magnitude."""
    c = rig.plant
    return math.log((2 * c.cross_leakage + c.makeup) / rig.sheet.leakage) / ERRORS["leakage"]


def leakage_of_both(rig: StrangerRig) -> float:
    """Return C_T, by which the mean of both chambers leaks, of equal areas, m^3/(s Pa)."""
    c = rig.plant
    makeup = c.makeup if c.makeup_2 < 0 else c.makeup_2
    case = c.case_leakage if c.case_leakage_2 < 0 else c.case_leakage_2
    return 2.0 * c.cross_leakage + 0.5 * (c.makeup + makeup + c.case_leakage + case)


def leak_beyond(rig: StrangerRig) -> float:
    """Return the conductance between the chambers beyond the sheet's, m^3/(s Pa)."""
    return rig.plant.cross_leakage - 0.5 * (rig.sheet.leakage - rig.sheet.makeup)


def held(rig: StrangerRig) -> float:
    """Return by how much the controller's hold delays its command on the mean, s."""
    drive = rig.drive
    return (0.5 * drive.hold + drive.phase) / rig.rate if drive.hold else 0.0


def entry(name: str, balance: str, parameters: dict[str, float]) -> dict:
    """Return the key's entry of an effect."""
    return {"name": name, "balance": balance, "strength": 1.0, "in_catalogue": True,
            "parameters": parameters, "class": list(CLASSES.get(name, (name,)))}


def leak_shows(rig: StrangerRig) -> bool:
    """Tell whether a leak to ambient leaves a mean pressure beyond what the source may have.

    The chambers settle where make-up and leak are equal, at G / (G + L) of the source's pressure,
    which its owner knows to a tolerance; who knows of no make-up path expects no pressure.
    """
    c = rig.plant
    leak = 0.5 * (c.case_leakage + c.case_leakage_2)
    level = c.reservoir * c.makeup / max(c.makeup + leak, 1e-300)
    return leak > 0.0 and rig.sheet.makeup > 0.0 and (
        math.log(rig.sheet.charge / level) > SURE * ERRORS["charge"])


def beside_of(rig: StrangerRig) -> list[dict]:
    """Return entries of what need not be found.

    Every such rig has the stroke in its volumes and an encoder's steps.  Lag, hold and play are a
    per cent or two of what their balance does, which is no difference to a diagnosis that has
    milliseconds of doubt about its channels; to first order a hold delays by half of itself, and
    the anti-alias filter of second order the pressures by sqrt(2) / (2 pi f).
    """
    c = rig.plant
    found = [entry("position_dependent_volume", "flow", {"A_v": 0.5 * (c.area_1 + c.area_2)}),
             entry("position_quantisation", "sensor", {"q": rig.sensors.encoder})]
    if c.play:
        found.append(entry("backlash", "force", {"b": c.play, "in_loop": 1.0}))
    if c.lag + held(rig):
        found.append(entry("drive_lag", "drive", {"tau": c.lag + held(rig)}))
    if rig.sensors.filter_hz:
        found.append(entry("pressure_delay", "sensor", {
            "T": math.sqrt(0.5) / (math.pi * rig.sensors.filter_hz)}))
    if SURE - 1.0 < leaks_by(rig) <= SURE + 1.0:
        found.append(entry("cross_port_leakage", "flow", {"L": leak_beyond(rig)}))
    if (c.case_leakage or c.case_leakage_2) and not leak_shows(rig):
        found.append(entry("external_leakage", "flow", {"L_1": c.case_leakage,
                                                        "L_2": c.case_leakage_2}))
    return found


def rig_off(rig: StrangerRig) -> list[dict]:
    """Return the config's numbers beside the true ones."""
    c, said, spreads = rig.plant, settings_of(rig).rig, Tolerance()
    true = {"area_1": c.area_1, "area_2": c.area_2, "volume_1": c.volume_1,
            "volume_2": c.volume_2, "mass": c.mass, "pump_displacement": c.displacement_1,
            "position_gain": c.gain, "charge_pressure": c.reservoir,
            "makeup_conductance": c.makeup}
    if leaks_by(rig) <= SURE - 1.0:
        true["leakage"] = 2 * c.cross_leakage + c.makeup
    found = []
    for key, value in true.items():
        configured = getattr(said, key)
        if configured:
            found.append({"key": key, "true": value, "configured": configured, "tolerances":
                          math.log(configured / value) / spreads.log_spread(key)})
    return found


def write(rig: StrangerRig, setting: Setting, folder: Path, seed: int,
          length: float | None = None) -> tuple[Path, Path]:
    """Write ``RIG_SETTING`` (a bag) and ``RIG_SETTING.yaml`` (its config) into ``folder``."""
    return write_both(folder, f"{rig.name}_{setting.name}", tree_of(rig),
                      recorded(rig, setting, seed, length))
