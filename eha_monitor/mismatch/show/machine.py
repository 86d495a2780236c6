"""The answer of many recordings, and of the next one, from the machine's balances."""

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import stdtr

from eha_monitor.machine.alone import alone
from eha_monitor.machine.candidates import Scale, candidates_of
from eha_monitor.machine.course import course_of
from eha_monitor.machine.judge import Judged
from eha_monitor.machine.machine import (
    Machine,
    MachineBalance,
    Parameter,
    Setting,
    rms,
)
from eha_monitor.machine.policy import POLICY
from eha_monitor.machine.table import tables_of
from eha_monitor.mismatch.diagnosis import (
    Change,
    Diagnosis,
    Location,
    NamedEffect,
    RigFinding,
    SignalFit,
    Value,
)
from eha_monitor.quantity import share, side_by_side, with_uncertainty
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.monitor import Settings
from eha_monitor.words import listed

SIDES = {"force": "N", "flow": "m³/s"}
LINEAR = {"B", "F_0", "D_p", "C_h"}  # what the config's own model has; C_h is V / beta_e
ZERO = 0.1  # of a balance's size: a smaller constant load may be the sensors' zero
WRONG = 3.0  # deviations by which a number of the config is wrong
ALMOST = 0.99  # probability that no count of recordings exceeds: the catalogue is never complete
MOST = 0.5  # share of a balance's error that names leave, beyond which it is unexplained


def diagnosis_of(machine: Machine, recordings: Sequence[Recording], settings: Settings,
                 started: float) -> Diagnosis:
    """Return the answer that several recordings give together by their balances."""
    effects = tuple(effect for one in machine.balances for effect in _effects(one))
    wrong = _wrong(machine, settings)
    left = {one.balance: one.unexplained / max(rms(one.nominal), 1e-300)
            for one in machine.balances}
    open_ = [name for name, share_left in left.items() if share_left > MOST]
    verdict = ("mismatch" if (effects or wrong) and len(open_) < len(left) else
               "unexplained" if open_ and any(machine[name].unexplained > MOST
                                              for name in open_) else
               "mismatch" if effects or wrong else "consistent")
    sentences = [*(one.statement for one in wrong), *(one.statement for one in effects)]
    total = sum(max(rms(one.nominal) ** 2 - one.unexplained**2, 0.0)
                for one in machine.balances) or 1.0
    where = dict.fromkeys(("force", "flow", "drive", "sensor"), 0.0) | {
        one.balance: max(rms(one.nominal) ** 2 - one.unexplained**2, 0.0) / total
        for one in machine.balances}
    worst = max(machine.balances, key=lambda one: one.unexplained)
    regime = max(worst.regimes, key=lambda one: one.energy / max(one.time, 1e-3)).name
    b = next(p for p in machine["force"].parameters if p.name == "B")
    after = {"B": Value(b.value, b.stddev, "N·s/m")}
    before = {"B": Value(settings.rig.viscous_damping, np.nan, "N·s/m")}
    for c in (p for one in machine.balances for p in one.parameters if p.name == "C_h"):
        volume = settings.rig.volume_1
        if volume and c.value > 0.0:
            beta = volume / c.value
            after["beta_e"] = Value(beta, beta * c.stddev / c.value, "Pa")
            before["beta_e"] = Value(settings.rig.bulk_modulus, np.nan, "Pa")
    return Diagnosis(
        tuple(one.source for one in recordings), verdict,
        "; ".join(sentences) or f"the config explains all {len(recordings)} recordings",
        Location(where, regime, ()), effects, before, after, "held_out", {
            one.balance: SignalFit(SIDES[one.balance], rms(one.nominal) * one.size,
                                   one.unexplained * one.size, np.nan, signal_rms=one.size)
            for one in machine.balances},
        advice=advice_of(machine), health=lines_of(machine), rig_data=wrong,
        probability={"consistent": np.nan, "unexplained": np.nan},
        duration_s=sum(one.duration for one in recordings),
        wall_s=time.perf_counter() - started, machine=machine)


def _effects(one: MachineBalance) -> list[NamedEffect]:
    """Return an effect for each family of terms that is named, and loads beside it."""
    shared = {p.name: p for p in one.parameters}
    settings, found = {s.name: s for s in one.settings}, []

    def effect(first, names, gain, probability):
        values = {name: Value(shared[name].value, shared[name].stddev, shared[name].unit)
                  if name in shared else _of_setting(settings[name]) for name in names}
        said = "; ".join(_said(shared[name]) if name in shared else _over(settings[name])
                         for name in names)
        return NamedEffect(first.effect, one.balance, said, values, gain * one.effective,
                           probability=probability)

    count = max(len(one.error) - 1, 1)
    for named in one.named:
        if set(named.terms) <= LINEAR:
            continue
        first = shared.get(named.terms[0]) or settings[named.terms[0]]
        found.append(effect(first, named.terms, named.gain,
                            min(float(stdtr(count, named.t)), ALMOST)))
    for s in one.settings:
        if s.name in LINEAR and max(np.abs(v) - WRONG * d for v, d in zip(
                s.value, s.stddev, strict=True)) > ZERO * one.size:
            found.append(effect(s, (s.name,), 0.0, ALMOST))
    return sorted(found, key=lambda found_one: -found_one.log_evidence)


def _said(p: Parameter) -> str:
    spread = (f", ± {share(p.between / abs(p.value), 2)} between recordings"
              if p.between and p.value else "")
    return f"{p.words}: {with_uncertainty(p.value, p.stddev, p.unit)}{spread}"


def _over(s: Setting) -> str:
    values = np.array(s.value)
    low, high = side_by_side(values.min(), values.max(), float(np.median(s.stddev)), s.unit)
    return f"{s.words}: {low} to {high} over the recordings{', a setting' if s.varies else ''}"


def _of_setting(s: Setting) -> Value:
    return Value(float(np.mean(s.value)), float(np.std(s.value)), s.unit)


def _wrong(machine: Machine, settings: Settings) -> tuple[RigFinding, ...]:
    """Return the pump's displacement where the config's is far from the machine's."""
    configured, found = settings.rig.pump_displacement, []
    for one in machine.balances:
        for p in one.parameters:
            if p.name != "D_p" or configured is None:
                continue
            own = settings.rig.tolerance.log_spread("pump_displacement") * configured
            if abs(p.value - configured) > WRONG * np.hypot(p.stddev, own):
                shown = side_by_side(configured, p.value, p.stddev, p.unit)
                found.append(RigFinding(
                    "pump_displacement", configured, Value(p.value, p.stddev, p.unit), ALMOST,
                    f"pump_displacement: the config says {shown[0]}, the recordings {shown[1]}"))
    return tuple(found)


def lines_of(machine: Machine) -> tuple[str, ...]:
    """Return what else the recordings say together, as sentences."""
    found = []
    for one in machine.balances:
        found.append(
            f"{one.balance}, on recordings left out: {share(rms(one.nominal), 2)} of it open with "
            f"the config, {share(one.unexplained, 2)} with the named terms, "
            f"{share(rms(one.reference), 2)} with a flexible function of the signals instead")
        small = [p.words for p in (*one.parameters, *one.settings) if p.name not in LINEAR
                 and not any(p.name in named.terms for named in one.named)]
        if small:
            found.append(f"{one.balance}: corrections of form that help, too small to be named: "
                         f"{listed(small)}")
        if one.repeats:
            where = max(one.regimes, key=lambda regime: regime.energy / max(regime.time, 1e-3))
            found.append(
                f"{one.balance}: the catalogue is incomplete: {share(one.repeats, 2)} of the "
                f"squared error repeats from recording to recording; {share(where.energy, 2)} of "
                f"it lies {where.name}, {share(where.time, 2)} of the time")
    found += [f"{one.source} does not belong: {one.why}" for one in machine.odd]
    return tuple(found)


def advice_of(machine: Machine) -> tuple[str, ...]:
    """Return which setting would decide what stays open."""
    if machine.load_varied:
        return ()
    return ("vary the load between recordings: without it, friction that grows with pressure "
            "cannot be separated from dry friction",)


def judged_diagnosis(judged: Judged, machine: Machine, recording: Recording, started: float
                     ) -> Diagnosis:
    """Return the answer for the next recording of a machine."""
    units = {p.name: (p, one.balance) for one in machine.balances for p in one.parameters}
    changes = []
    for moved in judged.changed:
        p, balance = units[moved.name]
        shown = with_uncertainty(moved.here, moved.stddev, moved.unit)
        changes.append(Change(
            moved.words, moved.name, balance, Value(p.value, float(np.hypot(p.between, p.stddev)),
                                                    p.unit),
            Value(moved.here, moved.stddev, moved.unit), moved.unit,
            f"{moved.words}: {shown}, {abs(moved.deviations):.1f} deviations from the machine's "
            f"{with_uncertainty(p.value, float(np.hypot(p.between, p.stddev)), p.unit)}"))
    loud = [f"{name}: {share(judged.error[name], 2)} of it unexplained, at most "
            f"{share(judged.usual[name], 2)} in the machine's own recordings"
            for name in judged.error]
    verdict = "consistent" if judged.belongs else "mismatch" if changes else "unexplained"
    message = ("; ".join(one.statement for one in changes) if changes else
               f"like the {len(machine.sources)} recordings of the machine" if judged.belongs
               else listed(list(loud)))
    nowhere = Location(dict.fromkeys(("force", "flow", "drive", "sensor"), 0.0), "", ())
    b = next((one for one in judged.moved if one.name == "B"), None)
    after = {"B": Value(b.here, b.stddev, "N·s/m")} if b else {}
    before = {"B": Value(b.machine, np.nan, "N·s/m")} if b else {}
    return Diagnosis((recording.source,), verdict, message, nowhere, (), before, after,
                     "held_out", {}, changes=tuple(changes), references=machine.sources,
                     health=tuple(loud), duration_s=recording.duration,
                     probability={"consistent": np.nan, "unexplained": np.nan},
                     wall_s=time.perf_counter() - started, machine=machine)


def alone_diagnosis(found: Diagnosis, drive: Sequence[NamedEffect], recording: Recording,
                    settings: Settings) -> Diagnosis:
    """Return a diagnosis whose force and flow balances are what the recording alone supports.

    Where a valve circuit's balances are compared, an evidence that counts every sample names what
    another day does not repeat.  Here a name of these balances has to gain on halves of the
    recording that its fit has not seen (:mod:`eha_monitor.machine.alone`); the drive's names stay.

    Parameters
    ----------
    found : by evidence; its pictures and its first view are kept.
    drive : effects of the drive's balance, which has a likelihood of its own.
    """
    course = course_of(recording, settings)
    effects, signals, open_, after, weights = [], dict(found.signals), [], dict(found.after), {}
    for balance in ("force", "flow"):
        candidates = candidates_of(balance, Scale.of([course]), settings.rig)
        (table,) = tables_of([course], settings.rig, balance, candidates, POLICY)
        of, one = {c.name: c for c in table.candidates}, alone(table, POLICY)
        gained = table.effective * float(np.log(max(one.nominal / max(one.error, 1e-9), 1.0)))
        weights[balance] = max(one.nominal**2 - one.error**2, 0.0)
        closed = one.nominal < POLICY.worse  # the config's own terms leave next to nothing
        for name in one.names:
            value = Value(name.value, name.stddev, of[name.term].unit)
            if name.term == "B":
                after["B"] = value
            if closed or (name.term in LINEAR and (name.term != "F_0" or abs(name.value) < max(
                    WRONG * name.stddev, ZERO * table.size))):
                continue
            effects.append(NamedEffect(
                name.effect, balance, f"{of[name.term].words}: "
                f"{with_uncertainty(name.value, name.stddev, value.unit)}",
                {name.term: value}, gained, name.rivals, probability=name.probability))
        left = signals.get(balance)
        signals[balance] = SignalFit(SIDES[balance], one.nominal * table.size,
                                     one.error * table.size, left.noise_rms if left else np.nan,
                                     signal_rms=table.size)
        open_.append(one.error > MOST)
    effects = tuple(sorted((*effects, *(replace(effect, probability=min(
        effect.probability, POLICY.certain)) for effect in drive)),
        key=lambda effect: -effect.log_evidence))
    verdict = "unexplained" if all(open_) or (not effects and any(open_)) else (
        "mismatch" if effects else "consistent")
    if verdict != "mismatch":
        effects = ()
    total = sum(weights.values()) or 1.0
    return replace(
        found, verdict=verdict, effects=effects, signals=signals, rig_data=(), rig_within=(),
        after={"B": after["B"]} if verdict == "mismatch" and "B" in after else {}, health=(),
        message="; ".join(effect.statement for effect in effects) or (
            "the balances hold more than the catalogue explains" if verdict == "unexplained"
            else "the config's own model explains both balances of this recording"),
        location=replace(found.location, balance=dict.fromkeys(
            ("force", "flow", "drive", "sensor"), 0.0) | {
            name: value / total for name, value in weights.items()})
        if verdict != "consistent" else found.location,
        config_effects=dict(settings.effects), fitted=None, learned=(), gates=(),
        probability={"consistent": np.nan, "unexplained": np.nan},
        advice=("record the same machine again, with another load, another speed and on another "
                "day, and diagnose all together: what one recording supports is not always there "
                "on another day", *found.advice))
