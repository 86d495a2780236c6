"""``estimate``: the monitor's pipeline on a bag, as fast as it goes."""

import time
from dataclasses import replace
from pathlib import Path

import click

from eha_monitor.commands.archive import Archive, answer_folder, archive_options, refuse
from eha_monitor.commands.common import (
    check_outputs,
    config_option,
    refuse_short,
    working,
)
from eha_monitor.output import write_json, write_text


@click.command()
@click.argument("bag", type=click.Path(path_type=Path))
@config_option
@click.option("--json", "json_file", type=click.Path(path_type=Path), metavar="FILE",
              help="Write the answer as JSON.")
@click.option("--report", "report_file", type=click.Path(path_type=Path), metavar="FILE.html",
              help="Write a self-contained HTML report.")
@click.option("--write-config", "config_file", type=click.Path(path_type=Path), metavar="FILE",
              help="Write the config with the signs, units and channels corrected that the "
              "recording contradicts; nothing is written where it contradicts none.")
@click.option("--exit-code", is_flag=True,
              help="Exit with 1 if an alarm stands or the model does not fit.")
@archive_options
def estimate(bag: Path, config: Path | None, json_file: Path | None, report_file: Path | None,
             config_file: Path | None, exit_code: bool, **asked) -> int:
    """Estimate B and the bulk modulus from BAG, and judge them against the thresholds.

    Where BAG is a folder that holds bags, all of them, into one table with trends over time.
    """
    archive = Archive(**asked)
    if archive.covers(bag):
        refuse(bag, json=json_file, report=report_file, write_config=config_file)
        return int(answer_folder("estimate", bag, config, archive) and exit_code)
    check_outputs({"--json": json_file, "--report": report_file, "--write-config": config_file},
                  (bag,), config)

    from eha_monitor.commands.answer import answer, judged, refusal, unhealthy
    from eha_monitor.commands.indicators import of_estimate, trees
    from eha_monitor.commands.plausible import checked, corrected_config, finding_tree
    from eha_monitor.compiled import load_runtime
    from eha_monitor.filters.observability import observability
    from eha_monitor.filters.pipeline import estimate as run
    from eha_monitor.recordings.read import read_recording
    from eha_monitor.settings import load_settings

    settings = load_settings(config)
    load_runtime()
    started = time.perf_counter()
    with working(f"reading {bag}"):
        recording = read_recording(bag, settings)

    def refused(findings, message: str) -> None:
        if json_file:
            write_json(json_file, refusal(recording, message, finding_tree(findings)))

    findings = checked([recording], settings, config, config_file, refused)
    refuse_short(recording)  # a clock that runs wrong has been told before
    with working("estimating"):
        found = run(recording, settings)
        findings = (*findings, *found.channels)
        alarms, history = judged(found)
    # What a user waits for: the bag is read within this time.
    found = replace(found, wall_s=time.perf_counter() - started, warnings=(
        *found.warnings, *(finding.finding for finding in findings)))
    if json_file or report_file:
        with working("asking what each combination of channels could tell"):
            observable = observability(found)
    indicators = of_estimate(found)
    if json_file:
        write_json(json_file, answer(found, alarms, history, observable)
                   | {"channels": finding_tree(findings), "indicators": trees(indicators)})
    if config_file and any(finding.correction for finding in findings):
        write_text(config_file, corrected_config(findings, settings, config))
    if report_file:
        from eha_monitor.reports.estimate_report import write_estimate_report

        with working(f"drawing {report_file}"):
            write_estimate_report(report_file, found, alarms, history, observable, indicators)

    from eha_monitor.commands.table import show

    show(found, alarms, [path for path in (json_file, report_file) if path], indicators)
    return int(exit_code and unhealthy(found, alarms))
