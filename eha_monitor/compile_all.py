"""Compiles all that a recording or a live actuator can ask for: what `make setup` does once.

Run as ``python -m eha_monitor.compile_all``.  The commands' own functions are run over seconds of
simulation; what only some recordings or configs ask for is called by itself.
"""

import argparse
import shutil
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from eha_monitor.compiled import CACHE
from eha_monitor.compiled_cache import shipped
from eha_monitor.filters.live import LiveEstimator
from eha_monitor.filters.pipeline import estimate
from eha_monitor.mismatch.advise.advice import advise
from eha_monitor.mismatch.data.experiment import Experiment, experiment_of
from eha_monitor.mismatch.diagnose import diagnose
from eha_monitor.mismatch.likelihood.along import drive_along, played
from eha_monitor.mismatch.likelihood.smooth import smoothed
from eha_monitor.mismatch.locate.latent import latent_gains
from eha_monitor.mismatch.name.nominal import nominal
from eha_monitor.physics.contributions import circuit_of
from eha_monitor.physics.simulator import Simulator
from eha_monitor.recordings.read import read_recording
from eha_monitor.recordings.recording import Recording
from eha_monitor.recordings.write import write_recording
from eha_monitor.settings import Settings, settings_from_tree

SECONDS = 4.0  # of motion: enough for the estimators to converge
BATCH, SHORT = 100, 600  # samples
# Each runs code that the others do not: the printed equations, a drive whose effects open the
# loop, friction in the model.
CONFIGS = ({}, {"discretisation": "euler"}, {"command_hold": "sampled"},
           {"effects": {"command_delay": {"T": 1e-3}}},
           {"effects": {"coulomb_friction": {"F_c": 10.0}}})


def simulated(settings: Settings) -> Recording:
    """Return seconds of the paper's EHA as a bag would give them."""
    plant = Simulator(settings, seed=0)
    with tempfile.TemporaryDirectory() as scratch:
        bag = Path(scratch) / "bag"
        write_recording(bag, Recording(plant.dt, plant.advance(round(SECONDS / plant.dt))),
                        settings)
        return read_recording(bag, settings)


def compile_estimators(recording: Recording) -> None:
    """Run the offline pipeline and the live estimator under each kind of config."""
    for tree in CONFIGS:
        settings = settings_from_tree(tree, "compile_all")
        estimate(recording, settings)
        live = LiveEstimator(settings)
        for start in range(0, len(recording), BATCH):
            part = recording.part(start, start + BATCH)
            live.push_rows(recording.time[start : start + BATCH], part.channels)
        live.snapshot()
        live.rehearse()
        # Called from Python, the functions of a step are compiled by themselves.
        reference = settings_from_tree({**tree, "engine": "filterpy"}, "compile_all")
        estimate(recording.part(0, SHORT), reference)


def compile_diagnosis(recording: Recording) -> None:
    """Run the diagnosis and the advice; then what a mismatch alone asks for."""
    settings = Settings()
    rubbing = simulated(settings_from_tree(
        {"effects": {"coulomb_friction": {"F_c": 40.0}}}, "compile_all"))
    diagnose([rubbing], settings)
    advise([recording], settings, check=False)
    for names in (("x", "x_d", "omega", "p1", "p2"), ("x", "omega"), ("x", "p1", "p2")):
        part = replace(recording, channels={name: recording.channels[name] for name in names})
        compile_for_mismatch(experiment_of([part], settings, hold_out=True))


def compile_for_mismatch(experiment: Experiment) -> None:
    """Call what locates a mismatch and shows it, whether there is one or not."""
    experiment, fit = nominal(experiment)
    latent_gains(experiment, fit)
    smoothed(experiment, fit)
    stretch = experiment.stretches[0]
    position = np.ascontiguousarray(stretch.z[:, 0])
    drive_along(position, stretch.u, experiment.dt, 1, fit.theta,
                circuit_of(fit.theta, fit.active), np.zeros(len(position)))
    played(position, 1e-6)


def ship() -> None:
    """Put what is compiled beside the package of this virtual environment, for every user.

    Whoever runs the installed package with an empty home, as a service does, loads it from there.
    """
    if sys.prefix == sys.base_prefix:  # the system's Python is not ours to write into
        return
    place = shipped()
    place.mkdir(parents=True, exist_ok=True)
    for old in place.iterdir():
        shutil.rmtree(old)
    copy = Path(tempfile.mkdtemp(prefix="copy-", dir=place))
    shutil.copytree(CACHE, copy, dirs_exist_ok=True, ignore=shutil.ignore_patterns("*.tmp"))
    copy.chmod(0o755)
    copy.rename(place / CACHE.name)


def main() -> None:
    """Compile; with ``--ship``, for every user of this virtual environment."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--ship", action="store_true", help="also for the users of this .venv")
    asked = parser.parse_args()
    recording = simulated(Settings())
    compile_estimators(recording)
    compile_diagnosis(recording)
    if asked.ship:
        ship()


if __name__ == "__main__":
    main()
