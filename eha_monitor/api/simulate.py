"""The simulated actuator as a recording, or straight to a bag."""

import os
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any

from pydantic_core import PydanticCustomError

from eha_monitor.api.common import Progress, calling, reporter
from eha_monitor.api.config import Config, config_of
from eha_monitor.api.recording import Recording
from eha_monitor.errors import InputError
from eha_monitor.physics.simulator import Simulator, total_duration
from eha_monitor.recordings.columns import Column
from eha_monitor.recordings.recording import Recording as Inner
from eha_monitor.recordings.write import ChannelWriter
from eha_monitor.units import to_si

BATCH_S = 1.0  # simulated between two reports; the noise is drawn by the batch
START_NS = 1_000_000_000  # always the same, and not zero, which ROS takes for "no time"
SOURCE = "simulation"


def simulate(config: Config | str | os.PathLike | dict | None = None, *,
             duration: float | str | None = None, seed: int | None = None,
             progress: Progress = False) -> Recording:
    """Simulate the actuator of a config: what its sensors show.

    Parameters
    ----------
    config : Config, path, mapping or None
        Rig, motion (``simulation.excitation``), sensor noise, faults over time, effects; without
        it the paper's EHA.
    duration : float or str, optional
        Length in s, or with a unit ("2 min"); without it until the motion repeats.
    seed : int, optional
        Seed of the sensor noise; without it the config's.
    progress : bool or callable
        True: a line on the standard error; a function is called with (text, share from 0 to 1).

    Returns
    -------
    Recording
        The channels of ``simulation.publish``; the same numbers that the command ``simulate``
        writes to a bag.

    Raises
    ------
    InputError
        One line: the key or argument and what was expected.

    Examples
    --------
    >>> healthy = em.simulate({"rig": {"viscous_damping": 600}}, duration=2.0, seed=1)
    >>> len(healthy), healthy.channels["x"].max().round(3)
    (2000, np.float64(0.036))
    """
    with calling():
        config = config_of(config)
        plant, samples = _plant(config, duration, seed)
        columns: dict[str, Column] = {}
        for part in _parts(plant, samples, reporter(progress)):
            for name, values in part.items():
                columns.setdefault(name, Column()).append(values)
        return Recording.of(Inner(plant.dt, {name: column.values() for name, column
                                             in columns.items()}, START_NS, SOURCE), config)


def simulate_bag(out: Path, config: Config, *, duration: float | None = None,
                 seed: int | None = None, plain: bool = False, overwrite: bool = False,
                 progress: Progress = False) -> tuple[float, int, tuple[str, ...]]:
    """Simulate straight to a bag, of any length, as it comes; not compressed if ``plain``.

    Returns its length in s, samples and channels.
    """
    plant, samples = _plant(config, duration, seed)
    parts = _parts(plant, samples, reporter(progress))
    first = next(parts)
    with ChannelWriter(out, tuple(first), plant.dt, config.settings.monitor.namespace,
                       compression="none" if plain else "zstd", overwrite=overwrite,
                       start_ns=START_NS) as writer:
        for part in chain((first,), parts):
            writer.write(part)
    return samples * plant.dt, samples, tuple(first)


def _plant(config: Config, duration: Any, seed: Any) -> tuple[Simulator, int]:
    """Return the simulator and how many samples are requested."""
    if seed is not None and (isinstance(seed, bool) or not hasattr(seed, "__index__") or seed < 0):
        raise InputError(f"seed: expected a whole number from 0 on, got {seed!r}")
    seconds = _seconds(duration)
    plant = Simulator(config.settings, seed, source=config.source or "config")
    seconds = seconds or total_duration(config.settings.simulation.excitation)
    return plant, max(1, round(seconds / plant.dt))


def _seconds(duration: Any) -> float | None:
    if duration is None:
        return None
    try:
        seconds = float(to_si(duration, "s"))
    except (PydanticCustomError, TypeError, ValueError):
        seconds = 0.0
    if not 0.0 < seconds < float("inf"):
        raise InputError(f"duration: expected seconds, more than 0, got {duration!r}")
    return seconds


def _parts(plant: Simulator, samples: int, say) -> Iterator[dict]:
    """Run the plant batch by batch; yields channel -> (m,)."""
    batch = max(1, round(BATCH_S / plant.dt))
    while plant.samples < samples:
        count = min(batch, samples - plant.samples)
        yield plant.batch(count)
        say("simulating", plant.samples / samples)
