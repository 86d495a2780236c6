"""``diagnose --out-bag``: the signals behind a diagnosis, for PlotJuggler and Foxglove."""

from collections.abc import Sequence
from pathlib import Path

import click

from eha_monitor.commands.common import check_new
from eha_monitor.errors import InputError


def check_out_bag(place: Path | None, bags: Sequence[Path]) -> None:
    """Refuse, before the work, a place for the bag that is taken, or is in a bag that is read."""
    if place is None:
        return
    if place.resolve() in [bag.resolve() for bag in bags]:
        raise InputError(f"{place}: is a bag that is read, expected another place for --out-bag")
    if not place.absolute().parent.is_dir():
        raise InputError(f"{place}: the folder {place.parent} does not exist")
    check_new(place, False)


def write_out_bag(place: Path | None, found, bags: Sequence[Path], settings) -> None:
    """Write the bag of a diagnosis, and say what is in it; nothing without a place."""
    if place is None:
        return
    if found.verdict == "insufficient_data":
        click.echo(f"{place}: not written, there is no model: {found.message}")
        return
    from eha_monitor.api.diagnosis_answer import written_config
    from eha_monitor.exports.diagnosis_bag import write_diagnosis_bag
    from eha_monitor.mismatch.show.series import series_of
    from eha_monitor.recordings.read import read_recording
    from eha_monitor.settings.load import settings_of

    named = settings_of(written_config(found, settings, None), "the diagnosed config")
    recordings = [read_recording(bag, settings) for bag in bags]
    series = series_of(recordings, settings, named)
    topics = write_diagnosis_bag(place, series, recordings, settings.monitor.namespace)
    seconds = sum(len(next(iter(one.measured.values()))) * one.dt for one in series)
    click.echo(f"{place}: {seconds:.1f} s, topics {', '.join(topics)}")
