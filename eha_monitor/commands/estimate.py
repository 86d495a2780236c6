"""``estimate``: the monitor's pipeline on a bag, as fast as it goes."""

from pathlib import Path

import click

from eha_monitor.commands import common
from eha_monitor.output import write_json, write_text


@click.command()
@click.argument("bag", type=common.FILE)
@common.config_option
@common.json_option
@common.report_option
@common.write_config_option("Write the config with signs, units and channels corrected where "
                            "the recording contradicts them; not written if there is no "
                            "contradiction.")
@click.option("--exit-code", is_flag=True,
              help="Exit with 1 if an alarm is active or the model does not fit.")
@common.archive_options
def estimate(bag: Path, config: Path | None, json_file: Path | None, report_file: Path | None,
             config_file: Path | None, exit_code: bool, **of_folder) -> int:
    """Estimate B and the bulk modulus from BAG and check them against the thresholds.

    If BAG is a folder of bags, process all of them into one table with trends over time.
    """
    archive = common.Archive(**of_folder)
    if archive.covers(bag, json=json_file, report=report_file, write_config=config_file):
        from eha_monitor.commands.archive_rows import answer_folder

        return int(answer_folder("estimate", bag, config, archive) and exit_code)
    common.check_outputs({"--json": json_file, "--report": report_file,
                          "--write-config": config_file}, (bag,), config)

    from eha_monitor.api.answer import refusal
    from eha_monitor.api.config import config_of
    from eha_monitor.api.estimate import estimate as run
    from eha_monitor.api.read import corrected_config, finding_tree

    given = config_of(config)
    with common.refusing(given, config, json_file, config_file, lambda problem: refusal(
            problem.recordings[0], str(problem), finding_tree(problem.channels))), common.working(
            f"reading {bag}") as told:
        found = run(bag, given, progress=lambda text, share: told(text))
    if json_file or report_file:
        with common.working("computing what each combination of channels could identify"):
            found.observability  # noqa: B018  computed when it is asked for
    if json_file:
        write_json(json_file, found.to_dict())
    corrects = any(finding.correction for finding in found.channels)
    if config_file and corrects:
        write_text(config_file, corrected_config(found.channels, given.settings, config))
    if report_file:
        with common.working(f"drawing {report_file}"):
            found.report(report_file)

    from eha_monitor.commands.table import show

    show(found, found.alarms, [path for path in (json_file, report_file) if path],
         found.indicators, config)
    if config_file:
        click.echo(f"{config_file}: written" if corrects else f"{config_file}: not written, since "
                   "the recording contradicts no sign, unit or channel of the config")
    return int(exit_code and not found.healthy)
