"""What the commands write of a recording that contradicts its config, before they refuse it."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from eha_monitor.api.config import Config
from eha_monitor.api.plausible import ImplausibleError, corrected_config
from eha_monitor.output import write_json, write_text


@contextmanager
def refusing(config: Config, source: Path | None, json_file: Path | None,
             config_file: Path | None, tree: Callable[[ImplausibleError], dict]
             ) -> Iterator[None]:
    """Write what was asked for where a recording is refused, and say where it is.

    Parameters
    ----------
    config, source : that was read, and its file.
    json_file, config_file : to write, or None.
    tree : returns the JSON of a refusal.
    """
    try:
        yield
    except ImplausibleError as problem:
        told = problem
        if config_file is not None and problem.corrected is not None:
            write_text(config_file, corrected_config(problem.channels, config.settings, source))
            told = problem.instead(f"the corrected config is in {config_file}")
        if json_file:
            write_json(json_file, tree(told))
        raise told from None
