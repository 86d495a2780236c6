"""What becomes of a recording that contradicts its config: refused, with what would mend it."""

from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from eha_monitor import __version__
from eha_monitor.api.config import Config
from eha_monitor.errors import InputError
from eha_monitor.output import finite
from eha_monitor.plausibility.judge import corrected, plausibility_of
from eha_monitor.recordings.recording import SHORTEST_S, ChannelFinding, Recording
from eha_monitor.settings.document import annotated
from eha_monitor.settings.monitor import Settings

TIME = ("time",)
WAY_OUT = "implausible: warn in the config continues with a warning"
OFFER = f"--write-config FILE writes the config corrected; {WAY_OUT}"


class ImplausibleError(InputError):
    """A recording whose channels contradict its config, so that no answer would mean anything.

    Attributes
    ----------
    channels : tuple of ChannelFinding
        What the channels say: finding, kind, channels, correction.
    corrected : Config or None
        The config with the signs, units and channels that the recording says; None where no
        change of the config would mend it.
    reason : str
        What contradicts, without the ways out of it.
    """

    def __init__(self, reason: str, channels: tuple[ChannelFinding, ...],
                 corrected: Config | None = None, way: str = OFFER,
                 recordings: Sequence[Recording] = ()):
        super().__init__(f"{reason} ({way})")
        self.reason, self.channels, self.corrected, self.way = reason, channels, corrected, way
        self.recordings = tuple(recordings)  # all that were checked; not kept in a pickle

    def __reduce__(self):
        return partial(type(self), way=self.way), (self.reason, self.channels, self.corrected)

    def instead(self, way: str) -> "ImplausibleError":
        """Return it with another way out."""
        return type(self)(self.reason, self.channels, self.corrected, way, self.recordings)


def checked(recordings: Sequence[Recording], settings: Settings) -> tuple[ChannelFinding, ...]:
    """Return what the recordings' channels say about the config, where an answer is possible.

    Parameters
    ----------
    recordings : of one rig; each is checked by itself.

    Raises
    ------
    ImplausibleError
        If no answer would be meaningful (exit status 2).
    """
    found: dict[str, ChannelFinding] = {}
    blocking: list[str] = []
    for recording in recordings:
        said = plausibility_of(recording, settings)
        if recording.duration < SHORTEST_S and {f.channels for f in said.findings} != {TIME}:
            continue  # too short to say more of than that its clock is wrong
        found |= {finding.finding: finding for finding in said.findings}
        if said.blocking:
            blocking.append(f"{recording.source}: {said.message}")
    findings = tuple(found.values())
    if not blocking or settings.implausible == "warn":
        return findings
    mended = None
    if any(finding.correction for finding in findings):
        mended = Config.of(corrected(settings, findings))
    raise ImplausibleError("; ".join(blocking), findings, mended, recordings=recordings)


def finding_tree(findings: Sequence[ChannelFinding]) -> list[dict[str, Any]]:
    """Return the findings as JSON's plain types."""
    return [finite(asdict(finding)) for finding in findings]


def corrected_config(findings: Sequence[ChannelFinding], settings: Settings,
                     source: Path | None) -> str:
    """Return the config with what the findings correct, as an annotated file."""
    lines = [f"Written by eha_monitor {__version__}: corrects "
             f"{source.name if source else 'the paper EHA'}.",
             *(f"  {finding.finding}" for finding in findings if finding.correction)]
    return annotated(corrected(settings, tuple(findings)), "\n".join(lines))
