"""What every command does with a recording that contradicts its config: refuse, and say how."""

from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from eha_monitor import __version__
from eha_monitor.commands.answer import finite
from eha_monitor.errors import InputError
from eha_monitor.output import write_text
from eha_monitor.plausibility.corrections import corrected
from eha_monitor.plausibility.judge import plausibility_of
from eha_monitor.recordings.finding import ChannelFinding
from eha_monitor.recordings.recording import SHORTEST_S, Recording
from eha_monitor.settings.document import annotated
from eha_monitor.settings.monitor import Settings

TIME = ("time",)
WAY_OUT = "implausible: warn in the config answers all the same"


def checked(recordings: Sequence[Recording], settings: Settings, config: Path | None = None,
            config_file: Path | None = None,
            refused: Callable[[tuple[ChannelFinding, ...], str], None] | None = None
            ) -> tuple[ChannelFinding, ...]:
    """Return what the recordings' channels say about the config, where an answer is possible.

    Parameters
    ----------
    recordings : of one rig; each is asked by itself.
    config, config_file : the config that was read, and where to write it corrected, or None.
    refused : told the findings and the message before the refusal, e.g. to write JSON.

    Raises
    ------
    InputError
        If no answer would be meaningful (exit status 2).
    """
    found: dict[str, ChannelFinding] = {}
    blocking: list[str] = []
    for recording in recordings:
        asked = plausibility_of(recording, settings)
        if recording.duration < SHORTEST_S and {f.channels for f in asked.findings} != {TIME}:
            continue  # too short to say more of than that its clock is wrong
        found |= {finding.finding: finding for finding in asked.findings}
        if asked.blocking:
            blocking.append(f"{recording.source}: {asked.message}")
    findings = tuple(found.values())
    if not blocking or settings.implausible == "warn":
        return findings
    written = config_file is not None and any(finding.correction for finding in findings)
    if written:
        write_text(config_file, corrected_config(findings, settings, config))
    way = (f"the corrected config is in {config_file}" if written else
           f"--write-config FILE writes the config corrected; {WAY_OUT}")
    message = f"{'; '.join(blocking)} ({way})"
    if refused is not None:
        refused(findings, message)
    raise InputError(message)


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
