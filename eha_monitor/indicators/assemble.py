"""From an estimate, or a diagnosis, and the config to the indicators."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from operator import attrgetter

import numpy as np

from eha_monitor.estimation.results import Estimate, ParameterEstimate, units_of
from eha_monitor.indicators import indicator, laws
from eha_monitor.indicators.indicator import Indicator
from eha_monitor.indicators.laws import LEAKS, SHEARED, viscosity_factor
from eha_monitor.mismatch.diagnosis import Diagnosis
from eha_monitor.physics.effects import DRY_LAWS
from eha_monitor.quantity import number, quantity
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.monitor import Settings
from eha_monitor.words import effect_words, listed

SAME_OIL = 5.0  # K: recordings within it show B of one oil
MOMENTS = 400  # of the pressures: their distribution is wanted, not their course
NO_LEAKAGE = "the leakage is not determined: it needs x, p1, p2 and omega, and volumes"
RIG = ("leakage", "pump_displacement")
UNKNOWN = {"unexplained": "what the model lacks is not known",  # verdict -> why no B, no beta_e
           "insufficient_data": "there are too few data"}
UNSEEN = "the diagnosis does not identify the leakage beyond the configured value: {}"


@dataclass(frozen=True)
class Evidence:
    """What an estimate or a diagnosis found, as plain numbers."""

    # ``B``, ``beta_e``, ``leakage`` (C_T), ``pump_displacement``, and ``<effect>.<parameter>`` of
    # each named effect; SI
    values: Mapping[str, float]
    covariance: np.ndarray  # (k, k) in their order
    # effects that the config has and that were therefore not measured, with their parameters; none
    # that another law has taken the place of
    assumed: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    # name of a value -> why it is not there, or why it is there and in doubt
    why: Mapping[str, str] = field(default_factory=dict)
    doubts: Mapping[str, str] = field(default_factory=dict)
    channels: tuple[str, ...] = ()  # that were recorded
    # (m,) absolute pressures of both chambers at times spread over the recording, Pa; empty where
    # they were not measured
    pressures: np.ndarray = field(default_factory=lambda: np.empty(0))
    temperature: float | None = None  # of the oil, °C, or None
    measured: bool = False  # whether a channel gave it
    # the lowest and the highest of recordings that are too far apart for one
    warmth: tuple[float, float] | None = None
    diagnosed: bool = False  # whether effects were looked for
    settled: bool = True  # and what was found explains the recording

    def part(self, *names: str) -> tuple[dict[str, float], np.ndarray]:
        """Return those of the values that are there, and their covariance."""
        order = list(self.values)
        kept = [name for name in order if name in names]
        places = [order.index(name) for name in kept]
        return ({name: self.values[name] for name in kept},
                np.asarray(self.covariance, dtype=float)[np.ix_(places, places)])

    def named(self, *effects: str) -> list[str]:
        """Return which of the effects were named."""
        there = {name.partition(".")[0] for name in self.values if "." in name}
        return [effect for effect in effects if effect in there]

    def beside(self, *effects: str) -> dict[str, float]:
        """Return ``<effect>.<parameter>`` of those that the config has beside what was named."""
        there = self.named(*effects)
        return {f"{name}.{key}": value for name in effects
                if name in self.assumed and name not in there
                for key, value in self.assumed[name].items()}


def evidence_of_estimate(found: Estimate) -> Evidence:
    """Return the evidence of an estimate: what converged, after the last change of a stage."""
    values, variances, why = {}, [], {}
    parameters, doubts = dict(found.parameters), found.doubted
    if found.joint is not None and not found.joint_doubt:
        parameters["leakage"] = found.joint.parameters["L"]
        # Stage two takes the config's leakage for true: where another one leads it astray, the
        # joint estimator, which has the leakage among its unknowns, knows beta_e.
        stiffness = found.joint.parameters["beta_e"]
        if (("beta_e" in doubts or parameters["beta_e"].status != "converged")
                and found.joint.fits and stiffness.status == "converged"):
            parameters["beta_e"] = stiffness
            doubts = {name: taint for name, taint in doubts.items() if name != "beta_e"}
    elif found.leakage is not None:
        parameters["leakage"] = found.leakage
    else:
        why["leakage"] = f"in doubt: {found.joint_doubt}" if found.joint_doubt else NO_LEAKAGE
    if "leakage" in parameters and found.leakage is parameters["leakage"]:
        known = leaks_of(found.settings)  # beside which it stands
        values |= known
        variances += [0.0] * len(known)
    for name, one in parameters.items():
        if one.status == "converged":
            values[name] = one.value
            variances.append(one.stddev**2)
        else:
            why[name] = one.message or one.status.replace("_", " ")
    changes = found.stage_two.changes
    since = int(changes[-1][0]) if len(changes) else 0
    made = evidence([found.recording], found.settings, values, np.diag(variances), why,
                    since=since)
    return replace(made, doubts={name: taint.reason for name, taint in doubts.items()})


def leaks_of(settings: Settings) -> dict[str, float]:
    """Return ``<effect>.<parameter>`` of the leakages that the config has, SI."""
    return {f"{name}.{key}": value for name in LEAKS
            for key, value in settings.effects.get(name, {}).items()}


def evidence(recordings: Sequence[Recording], settings: Settings, values: Mapping[str, float],
             covariance: np.ndarray, why: Mapping[str, str], diagnosed: bool = False,
             settled: bool = True, since: int = 0) -> Evidence:
    """Return evidence with the pressures, from a sample on, and the temperature of recordings."""
    pressures = [moments(one, name, since) for one in recordings for name in ("p1", "p2")
                 if one.has("p1", "p2")]
    warmth = [float(shown[-1]) for one in recordings
              if len(shown := moments(one, "temperature", 0))]
    measured = bool(warmth) and max(warmth) - min(warmth) < SAME_OIL
    temperature = (warmth[-1] if measured else None) if warmth else settings.health.oil_temperature
    channels = tuple(name for name in recordings[0].channels
                     if all(one.has(name) for one in recordings)) if recordings else ()
    return Evidence(values, covariance, settings.effects, why, channels=channels,
                    pressures=np.concatenate(pressures) if pressures else np.empty(0),
                    temperature=temperature, measured=measured, diagnosed=diagnosed,
                    warmth=(min(warmth), max(warmth)) if warmth and not measured else None,
                    settled=settled)


def moments(recording: Recording, name: str, since: int) -> np.ndarray:
    """Return finite values of a channel at moments spread evenly over a recording."""
    if name not in recording.channels:
        return np.empty(0)
    rows = recording.channels[name]
    start = since if since < len(rows) else 0
    chosen = np.asarray(rows[start::max((len(rows) - start) // MOMENTS, 1)], dtype=float)
    if not np.isfinite(chosen).any():
        chosen = np.asarray(rows[:], dtype=float)
    return chosen[np.isfinite(chosen)]


def evidence_of_diagnosis(found: Diagnosis, recordings: Sequence[Recording], settings: Settings,
                          leakage: ParameterEstimate | None = None) -> Evidence:
    """Return the evidence of a diagnosis of these recordings, in SI of a linear rig.

    ``leakage`` : C_T by least squares, which stands where the diagnosis has none.
    """
    values, covariance = fitted_values(found)
    why = {}
    if "leakage" not in values:
        grown = next((one.now for one in found.changes if one.symbol == "L"), None)
        if grown is not None:  # of a comparison: all that leaks across the piston, the half of C_T
            values = values | {"leakage": 2.0 * grown.value}
            covariance = wider(covariance, [2.0 * grown.stddev])
        elif any(name.partition(".")[0] in LEAKS for name in values):
            # The config's leakage, as uncertain as its tolerance says.
            values = values | {"leakage": settings.rig.leakage}
            covariance = wider(covariance, [
                settings.rig.leakage * settings.rig.tolerance.log_spread("leakage")])
        elif leakage is not None and leakage.status == "converged":
            values = values | {"leakage": leakage.value} | (known := leaks_of(settings))
            covariance = wider(covariance, [leakage.stddev] + [0.0] * len(known))
        else:
            why["leakage"] = UNSEEN.format(
                "it compares healthy recordings" if found.references else
                "the recording needs pressures and the flow of the pump")
    for name in ("B", "beta_e"):
        if name not in values:
            why[name] = UNKNOWN.get(found.verdict, "the recording does not determine it")
    if found.config_effects:
        settings = settings.model_copy(update={"effects": {
            name: one for name, one in settings.effects.items() if name in found.config_effects}})
    return evidence(recordings, settings, values, covariance, why, diagnosed=not found.references,
                    settled=found.verdict in ("consistent", "mismatch"))


def fitted_values(found: Diagnosis) -> tuple[dict[str, float], np.ndarray]:
    """Return B, beta_e, leakage, displacement and the named effects' parameters, (k, k) too.

    Effects that the answer does not name stay out.  A standard deviation that the answer states
    larger than the fit's own (delays, B and beta_e of a model that lacks something) is taken.
    """
    named = {effect.name: effect for effect in found.effects}
    stated = {name: value.stddev for name, value in found.after.items()} | {
        f"{effect.name}.{symbol}": value.stddev for effect in found.effects
        for symbol, value in effect.parameters.items()}
    if found.fitted is None:
        names = list(found.after)
        return ({name: found.after[name].value for name in names},
                np.diag([found.after[name].stddev ** 2 for name in names]))
    wanted = [(name.removeprefix("rig."), place) for place, name in enumerate(found.fitted.names)
              if name in ("B", "beta_e", *(f"rig.{key}" for key in RIG))
              or name.partition(".")[0] in named]
    places = [place for _, place in wanted]
    values = {name: float(found.fitted.values[place]) for name, place in wanted}
    covariance = np.array(found.fitted.covariance[np.ix_(places, places)], dtype=float)
    for i, name in enumerate(values):
        more = stated.get(name, 0.0) ** 2 - covariance[i, i]
        covariance[i, i] += max(more, 0.0) if np.isfinite(more) else 0.0
    fixed = {f"{effect.name}.{symbol}": value.value for effect in found.effects
             for symbol, value in effect.parameters.items()
             if f"{effect.name}.{symbol}" not in values}
    return values | fixed, wider(covariance, [0.0] * len(fixed))


def wider(covariance: np.ndarray, spread: list[float]) -> np.ndarray:
    """Return a covariance with further numbers, independent of all others."""
    size, whole = len(covariance), np.pad(covariance, (0, len(spread)))
    whole[size:, size:] = np.diag(np.square(spread))
    return whole


CLEAR = 2.0  # standard deviations from nothing: what is less is not reported
SIDE = 1.96  # standard deviations of the bound that is reported in its place
SLOW, FAST = 1.0, 1.4  # polytropic exponent of air that keeps, and of air that loses, no heat
LAWS = {
    "leakage": "flow that the pump must deliver to hold the rated pressure with the rod blocked, "
    "all paths together (piston, pump, make-up): laminar part over the viscosity, orifice part "
    "with the root of the pressure; not seen: what leaks at pressures far from those recorded",
    "free_air": "1/βe = 1/β_oil + (α/(n p)) (p_atm/p)^(1/n): polytropic air beside the oil; all "
    "softness beyond the air-free modulus counts as air, also a hose; dissolved air is not seen",
    "damping": "B goes as the viscosity (laminar shear); that half of it may be seal friction, "
    "which does not, is in the ±",
    "friction": "dry friction at speed, in the worse direction, of the named effects; "
    "viscous friction is in B",
    "friction_share": "the same over the rated pressure times the smaller piston area",
    "pump_efficiency": "flow into the load over D_p ω of the config at rated speed and pressure; "
    "every leak counts as the pump's, so a leaking piston seal lowers it too",
    "drive_lag": "time constant plus dead time from speed command to speed"}
Values = Mapping[str, float]


def indicators(found: Evidence, settings: Settings) -> tuple[Indicator, ...]:
    """Return every indicator, known or not, in the order of ``NAMES``."""
    friction = _friction(found, settings)
    return (_leakage(found, settings), _doubted(_free_air(found, settings), "beta_e", found),
            _doubted(_damping(found, settings), "B", found), friction,
            _friction_share(friction, settings), _efficiency(found, settings),
            _drive_lag(found))


def _doubted(made: Indicator, parameter: str, found: Evidence) -> Indicator:
    """Return an indicator with what speaks against the parameter that it is made of."""
    if math.isnan(made.value) or parameter not in found.doubts:
        return made
    return replace(made, doubtful=True,
                   message=f"{made.message}; in doubt: {found.doubts[parameter]}")


def _leakage(found: Evidence, settings: Settings) -> Indicator:
    if lacks := _lacking("leakage", settings, "health.rated_pressure"):
        return lacks
    if "leakage" not in found.values:
        return _unknown("leakage", found.why.get("leakage", "not identified from this recording"))
    pressure, names = settings.health.rated_pressure, ("leakage", *_parameters(found, laws.LEAKS))
    at = f"at {quantity(pressure, 'Pa', 3)}{_temperature_words(found, settings)}"

    def flow(values: Values) -> float:
        return laws.leakage_flow(values, pressure, _thinner(values, settings))

    return _made("leakage", flow, *_with_temperature(found, settings, names), (), at)


def _efficiency(found: Evidence, settings: Settings) -> Indicator:
    health, rig = settings.health, settings.rig
    if lacks := _lacking("pump_efficiency", settings, "health.rated_pressure",
                         "health.rated_speed", "rig.pump_displacement"):
        return lacks
    if "leakage" not in found.values:
        return _unknown("pump_efficiency",
                        found.why.get("leakage", "leakage not identified from this recording"))
    names = ("leakage", "pump_displacement", *_parameters(found, laws.LEAKS + laws.LOSSES))

    def efficiency(values: Values) -> float:
        return laws.volumetric_efficiency(values, rig.pump_displacement, health.rated_speed,
                                          health.rated_pressure, _thinner(values, settings))

    at = (f"at {quantity(health.rated_pressure, 'Pa', 3)}, {health.rated_speed:.4g} rad/s"
          f"{_temperature_words(found, settings)}")
    return _made("pump_efficiency", efficiency, *_with_temperature(found, settings, names), (), at)


def _damping(found: Evidence, settings: Settings) -> Indicator:
    unit = units_of(settings.rig.motion)["B"]
    if "B" not in found.values:
        return _unknown("damping", found.why.get("B", "not identified from this recording"), unit)

    def damping(values: Values) -> float:
        return values["B"] / _thinner(values, settings) ** values["sheared"]

    at = _temperature_words(found, settings).removeprefix(", ")
    if found.temperature is None and found.warmth is None:
        at += ": record it, or set health.oil_temperature"
    values, covariance = _with_temperature(found, settings, ("B",))
    return _made("damping", damping, {**values, "sheared": 1.0}, wider(covariance, [SHEARED]), (),
                 at, unit)


def _free_air(found: Evidence, settings: Settings) -> Indicator:
    health = settings.health
    at = f"at {quantity(health.air_pressure, 'Pa', 4)} absolute"
    if "entrained_air.alpha" in found.values:
        values, covariance = found.part("entrained_air.alpha")
        exponent = found.values.get("entrained_air.n", FAST)
        return _made("free_air", lambda v: laws.moved(v["entrained_air.alpha"],
                                                      health.air_pressure, exponent),
                     values, covariance, (), f"{at}, named by the diagnosis")
    if lacks := _lacking("free_air", settings, "health.air_free_modulus"):
        return lacks
    if "beta_e" not in found.values:
        return _unknown("free_air", found.why.get("beta_e", "βe not identified from this "
                                                            "recording"))
    if not len(found.pressures):
        return _unknown("free_air", "the pressure is unknown: p1 and p2 are not recorded")
    values, covariance = found.part("beta_e")
    values["oil"] = health.air_free_modulus
    values["n"] = health.polytropic_exponent or 0.5 * (SLOW + FAST)
    spread = [health.air_free_tolerance * health.air_free_modulus,
              0.0 if health.polytropic_exponent else (FAST - SLOW) / math.sqrt(12.0)]
    covariance = wider(covariance, spread)
    pressures = found.pressures

    def share(v: Values) -> float:
        return laws.free_air(max(v["beta_e"], 1.0), max(v["oil"], 1.0), max(v["n"], SLOW),
                             pressures, health.air_pressure)

    made = _made("free_air", share, values, covariance, ("oil", "n"),
                 f"{at}, from βe at {quantity(float(np.mean(pressures)), 'Pa', 3)} on average")
    if made.status == indicator.UNKNOWN:
        return replace(made, message="βe is not clearly below the air-free modulus; "
                       f"below {number(made.below, 2)} % {at}")
    return made


def _friction(found: Evidence, settings: Settings) -> Indicator:
    unit = "N·m" if settings.rig.motion == "rotary" else "N"
    if none := _not_looked_for("friction", found, DRY_LAWS, "dry friction", ("x",), unit):
        return none
    total = (2.0 * float(np.mean(found.pressures)) if len(found.pressures)
             else 2.0 * settings.rig.charge_pressure)
    values, covariance = found.part(*_parameters(found, DRY_LAWS))
    configured = found.beside(*DRY_LAWS)
    at = listed([effect_words(name) for name in found.named(*DRY_LAWS)])
    if "pressure_friction" in found.named(*DRY_LAWS):
        at += f", at p₁ + p₂ = {quantity(total, 'Pa', 3)}"
    return _made("friction", lambda v: laws.dry_friction(configured | v, total), values,
                 covariance, (), at, unit)


def _friction_share(friction: Indicator, settings: Settings) -> Indicator:
    if friction.status != indicator.AVAILABLE:
        return replace(friction, name="friction_share", unit="%", law=LAWS["friction_share"])
    if lacks := _lacking("friction_share", settings, "health.rated_pressure", "rig.area_1",
                         "rig.area_2"):
        return lacks
    stall = settings.health.rated_pressure * min(settings.rig.area_1, settings.rig.area_2)
    share = 100.0 / stall
    return Indicator("friction_share", share * friction.value, share * friction.stddev,
                     share * friction.noise, "%", indicator.AVAILABLE,
                     f"of {quantity(stall, friction.unit, 3)} at "
                     f"{quantity(settings.health.rated_pressure, 'Pa', 3)}",
                     LAWS["friction_share"])


def _drive_lag(found: Evidence) -> Indicator:
    effects = ("drive_lag", "command_delay")
    if none := _not_looked_for("drive_lag", found, effects, "lag of the drive", ("x_d", "omega")):
        return none
    values, covariance = found.part("drive_lag.tau", "command_delay.T")
    beside = found.beside(*effects)
    own = beside.get("drive_lag.tau", 0.0) + beside.get("command_delay.T", 0.0)
    at = listed([effect_words(name) for name in (
        *found.named(*effects), *sorted({key.partition(".")[0] for key in beside}))])
    return _made("drive_lag", lambda v: own + sum(v.values()), values, covariance, (), at)


def _not_looked_for(name: str, found: Evidence, effects: tuple[str, ...], words: str,
                    channels: tuple[str, ...], unit: str = "") -> Indicator | None:
    """Return why an indicator that only a named effect makes is not there, or None."""
    if not found.diagnosed:
        return _unknown(name, indicator.NOT_LOOKED_FOR, unit)
    if found.named(*effects):
        return None
    if assumed := [effect for effect in effects if effect in found.assumed]:
        return _unknown(name, f"{listed([effect_words(one) for one in assumed])} is in the "
                              "config, so it is known to 5 %, not measured", unit)
    if lost := [channel for channel in channels if channel not in found.channels]:
        return _unknown(name, f"{listed(lost)} not recorded", unit)
    if not found.settled:
        return _unknown(name, "the diagnosed model does not fit the recording", unit)
    return _unknown(name, f"the recording shows no {words}", unit, indicator.NONE)


def _made(name: str, function: Callable[[Values], float], values: Values, covariance: np.ndarray,
          common: tuple[str, ...], message: str, unit: str = "") -> Indicator:
    """Return an indicator from its law; ``common`` values are the same in every recording."""
    factor, unit = (1.0, unit) if unit else indicator.UNITS[name]
    value, stddev = indicator.propagated(function, values, covariance)
    places = [i for i, one in enumerate(values) if one in common]
    random = covariance.copy()
    random[places, :] = random[:, places] = 0.0
    noise = indicator.propagated(function, values, random)[1]
    value, stddev, noise = factor * value, factor * stddev, factor * noise
    if not (math.isfinite(value) and math.isfinite(stddev)):
        return _unknown(name, "its equation gives no finite number here", unit)
    if value <= CLEAR * stddev:
        below = max(value, 0.0) + SIDE * stddev
        return Indicator(name, value, stddev, noise, unit, indicator.UNKNOWN,
                         f"too uncertain: below {quantity(below, unit, 2)} {message}", LAWS[name],
                         below=below)
    return Indicator(name, value, stddev, noise, unit, indicator.AVAILABLE, message, LAWS[name])


def _unknown(name: str, why: str, unit: str = "", status: str = indicator.UNKNOWN,
             keys: tuple[str, ...] = ()) -> Indicator:
    return Indicator(name, math.nan, math.nan, math.nan, unit or indicator.UNITS[name][1], status,
                     why, LAWS[name], keys)


def _lacking(name: str, settings: Settings, *keys: str) -> Indicator | None:
    """Return the indicator that asks for those keys that the config does not have, or None."""
    lacks = tuple(key for key in keys if attrgetter(key)(settings) is None)
    return _unknown(name, f"set {listed(lacks)} in the config", status=indicator.NEEDS,
                    keys=lacks) if lacks else None


def _parameters(found: Evidence, effects: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(name for name in found.values if name.partition(".")[0] in effects)


def _with_temperature(found: Evidence, settings: Settings, names: tuple[str, ...]
                      ) -> tuple[dict[str, float], np.ndarray]:
    """Return values with the oil's temperature among them, where it is known."""
    values, covariance = found.part(*names)
    if found.temperature is None:
        return values, covariance
    values["temperature"] = found.temperature
    return values, wider(covariance, [settings.health.oil_temperature_stddev])


def _thinner(values: Values, settings: Settings) -> float:
    """Return the viscosity at the recording's temperature over that at the reference."""
    return 1.0 / viscosity_factor(settings.viscosity, values["temperature"]) \
        if "temperature" in values else 1.0


def _temperature_words(found: Evidence, settings: Settings) -> str:
    if found.warmth is not None:
        low, high = found.warmth
        return (f", of recordings with oil from {low:.1f} to {high:.1f} °C, so not converted to "
                f"{settings.viscosity.reference_temperature:g} °C")
    if found.temperature is None:
        return ", at an unknown temperature of the oil"
    law = "Walther's law" if settings.viscosity.grade else "the Reynolds law"
    given = "measured" if found.measured else "config"
    return (f", at {settings.viscosity.reference_temperature:g} °C by {law} from "
            f"{found.temperature:.1f} °C ({given})")
