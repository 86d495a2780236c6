"""How much evidence chance alone gives: the search run on simulated clean recordings.

The nominal model with its fitted B and beta_e is driven with the recording's own input; its
outputs get the recording's sensor noise and encoder steps; the same fit and the same score test
are run on them.  What the best of the catalogue gains there is chance, and numerical error.
"""

import hashlib
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from eha_monitor.compiled import CACHE
from eha_monitor.errors import InputError
from eha_monitor.mismatch.clean_balances import simulated_balances
from eha_monitor.mismatch.experiment import Experiment, Stretch
from eha_monitor.mismatch.fit import Fit, free_run, spread
from eha_monitor.mismatch.innovations import CLOSED
from eha_monitor.mismatch.inputs import cubics
from eha_monitor.mismatch.screen import Start, possible, screen, starts_of
from eha_monitor.mismatch.search import first_fit, settle, stiffened
from eha_monitor.output import write_text
from eha_monitor.physics.effects import NAMES
from eha_monitor.source import source_digest

DRAWS = 8
FALSE_ALARM = 0.002  # probability that a clean record names something
LEAST = 10.0  # log units: never ask for less
STRAY = 10.0  # log units in a clean draw: the fit is looked at again
# What a calibration comes from: rooms of the source, and sections of the config.
ROOMS = ("physics", "filters", "mismatch", "settings", "recordings", "compiled.py", "units.py")
SHAPING = {"rig", "noise", "stage_one", "stage_two", "effects", "command_hold", "discretisation"}
SMALLEST_SCALE = 1.0  # of the Gumbel law: that of a chi-squared's tail


@dataclass(frozen=True)
class Calibration:
    """Threshold of evidence for one rig, motion and set of sensors.

    Attributes
    ----------
    threshold : log units that an effect must gain.
    gains : best gain of the catalogue in each clean draw, log units.
    per_sample : log likelihood of a right model over the number of counted samples.
    """

    threshold: float
    gains: tuple[float, ...]
    per_sample: float


def simulated(experiment: Experiment, fit: Fit, seed: int) -> Experiment:
    """Return the experiment with the fitted model's own outputs in place of the measured ones."""
    if experiment.inverse:
        return simulated_balances(experiment, fit, seed)
    rng = np.random.default_rng(seed)
    parts = []
    for stretch in experiment.stretches:
        clean = free_run(experiment, stretch, fit)
        z = clean + np.nan_to_num(experiment.noise) * rng.standard_normal(clean.shape)
        step = experiment.position_step
        if step > 0:
            z[:, 0] = step * np.round(
                (clean[:, 0] + white_part(experiment) * rng.standard_normal(len(stretch))) / step)
        z[~np.isfinite(stretch.z)] = np.nan
        parts.append(replace(stretch, z=z, u=noisy_input(experiment, stretch, rng)))
    return experiment.only(tuple(parts))


def white_part(experiment: Experiment) -> float:
    """Return the position noise that is not rounding, m."""
    rounding = experiment.position_step / np.sqrt(12.0)
    return float(np.sqrt(max(experiment.noise[0] ** 2 - rounding**2, 0.0)))


def noisy_input(experiment: Experiment, stretch: Stretch, rng: np.random.Generator) -> np.ndarray:
    """Return the input as it would be measured: x_d is known, a sensor's is not."""
    if experiment.mode == CLOSED:
        return stretch.u
    noise = experiment.input_noise
    if noise <= 0:
        return stretch.u
    return cubics(stretch.u[:, 0] + noise * rng.standard_normal(len(stretch)), noise,
                  experiment.held)


def calibrate(experiment: Experiment, fit: Fit, draws: int = DRAWS,
              report: Callable[[str, float], None] | None = None) -> Calibration:
    """Run the search on clean draws, or read what an earlier run for the same rig found.

    Parameters
    ----------
    fit : nominal model at this recording (:func:`search.first_fit`).
    report : told how far it is, 0 to 1.
    """
    path = CACHE.parent / "calibration" / f"{fingerprint(experiment, fit, draws)}.json"
    kept = read(path)
    if kept is not None:
        return kept
    starts = [start for name in NAMES
              if possible(name, experiment) and not experiment.active[NAMES.index(name)]
              for start in starts_of(name, experiment)]
    done = []

    def one(seed: int) -> tuple[float, float]:
        found = gain_of_chance(simulated(experiment, fit, seed), fit, starts)
        done.append(seed)
        if report is not None:
            report(f"calibrating on clean simulations, {len(done)} of {draws}",
                   len(done) / draws)
        return found

    found = spread(one, range(draws))
    gains = np.array([gain for gain, _ in found])
    scale = max(float(np.std(gains)) * np.sqrt(6.0) / np.pi, SMALLEST_SCALE)
    place = float(np.mean(gains)) - 0.5772 * scale
    threshold = max(LEAST, place - scale * np.log(-np.log1p(-FALSE_ALARM)))
    result = Calibration(float(threshold), tuple(float(g) for g in gains),
                         float(np.mean([level for _, level in found])))
    keep(path, result)
    return result


def gain_of_chance(drawn: Experiment, fit: Fit, starts: list[Start]) -> tuple[float, float]:
    """Return what the best of the catalogue gains in a clean draw, and a sample's likelihood.

    The fit begins where the draw comes from.  One that ends where much is still to be gained, or
    below its start, went astray; it is made again from elsewhere, and the likeliest counts: what
    the catalogue gains beside a stray one is the fit's doing, and not chance.

    Parameters
    ----------
    fit : the model that the draw was made of.
    """
    begun = stiffened(drawn, fit)
    clean = settle(drawn, begun)
    best = screen(drawn, clean, starts)
    gain = best[0].gain if best else 0.0
    if gain > STRAY or not clean.log_likelihood >= begun.log_likelihood:
        again = max([clean, settle(drawn, begun, 4, 12), first_fit(drawn)],
                    key=lambda one: one.log_likelihood)
        best = screen(drawn, again, starts) if again is not clean else best
        clean, gain = again, best[0].gain if best else 0.0
    return gain, clean.log_likelihood / max(1, len(clean.e))


@lru_cache(maxsize=1)
def source() -> str:
    """Return a digest of all the source that a calibration comes from."""
    return source_digest(ROOMS, lambda path: not path.name.startswith("prove"))


def fingerprint(experiment: Experiment, fit: Fit, draws: int) -> str:
    """Return a key for the rig, its motion, its sensors and this very source."""
    digest = hashlib.sha256(source().encode())
    digest.update(experiment.settings.model_dump_json(include=SHAPING).encode())
    digest.update(repr((experiment.mode, experiment.held, experiment.inverse, experiment.steps,
                        experiment.dt, experiment.used.tolist(), draws,
                        [f"{level:.1e}" for level in experiment.noise],
                        f"{fit.value('B'):.1e}", experiment.position_step)).encode())
    for stretch in experiment.stretches:
        digest.update(np.round(stretch.u[::10, 0], 5).tobytes())
    return digest.hexdigest()[:32]


def read(path: Path) -> Calibration | None:
    """Return a kept calibration, or None where there is none that can be read."""
    try:
        raw = json.loads(path.read_text())
        return Calibration(float(raw["threshold"]), tuple(map(float, raw["gains"])),
                           float(raw["per_sample"]))
    except (OSError, ValueError, KeyError, TypeError):
        return None


def keep(path: Path, calibration: Calibration) -> None:
    """Keep a calibration for the next record of the same rig; no matter if it cannot be."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, json.dumps(asdict(calibration)))
    except (OSError, InputError):
        pass
