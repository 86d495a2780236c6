"""Which code runs the stages: compiled, or filterpy as the readable reference."""

from collections.abc import Callable

from eha_monitor.filters import kernel_one, kernel_two
from eha_monitor.settings.monitor import Settings


def engine_of(settings: Settings) -> tuple[Callable[..., int], Callable[..., int]]:
    """Return how stage one and stage two are run over rows, see :func:`kernel_one.run_one`."""
    if settings.engine == "compiled":
        return kernel_one.run_one, kernel_two.run_two
    from eha_monitor.filters import filterpy_stages  # takes 0.3 s to load

    return filterpy_stages.run_one, filterpy_stages.run_two
