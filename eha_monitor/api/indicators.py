"""Indicators of health in the answers of ``estimate`` and ``diagnose``."""

from collections.abc import Sequence

from eha_monitor.estimation.results import Estimate
from eha_monitor.indicators import diagnosed
from eha_monitor.indicators import found as evidence
from eha_monitor.indicators.assemble import indicators
from eha_monitor.indicators.indicator import Indicator
from eha_monitor.mismatch.diagnosis import Diagnosis
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.monitor import Settings


def of_estimate(found: Estimate) -> tuple[Indicator, ...]:
    """Return the indicators of an estimate."""
    return indicators(evidence.of_estimate(found), found.settings)


def of_diagnosis(found: Diagnosis, recordings: Sequence[Recording], settings: Settings
                 ) -> tuple[Indicator, ...]:
    """Return the indicators of a diagnosis of these recordings."""
    return indicators(diagnosed.of_diagnosis(found, list(recordings), settings), settings)


def trees(found: Sequence[Indicator]) -> list[dict]:
    """Return indicators as they stand in a JSON answer."""
    return [one.tree() for one in found]
