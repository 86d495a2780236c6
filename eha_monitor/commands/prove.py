"""``prove``: effects are concealed in recordings, the key is sealed, the diagnosis is scored."""

from pathlib import Path

import click

from eha_monitor.commands.common import check_target
from eha_monitor.commands.diagnose import progress_bar

_PATH = click.Path(path_type=Path)


@click.command()
@click.option("--cases", type=click.IntRange(1, 10000), default=200, show_default=True,
              help="How many recordings.")
@click.option("--seed", type=click.IntRange(0, 2**31 - 1), default=1, show_default=True,
              help="Seed of the draws; the first cases of a longer trial are the same.")
@click.option("--json", "json_file", type=_PATH, metavar="FILE", help="Write the result as JSON.")
@click.option("--report", "report_file", type=_PATH, metavar="FILE.html",
              help="Write a self-contained HTML report; without it DIR/proof.html.")
@click.option("--work", type=_PATH, metavar="DIR",
              help="Folder of recordings, key and answers; by default out/proof/... here. A trial "
              "that was interrupted goes on.")
@click.option("--keep", type=click.Choice(("same", "all", "none")), default="same",
              show_default=True, help="Which answers of an earlier run stay: those of this very "
              "source of the program, all, or none.")
@click.option("--oracle/--no-oracle", default=False,
              help="Also fit each case with a model that is told the effects: the best that can "
              "be reached, and the evidence there is (half as long again).")
@click.option("--jobs", type=click.IntRange(1, 1024), default=None,
              help="Processes at a time; all cores by default.")
@click.option("--calibration/--no-calibration", default=True,
              help="As in diagnose; without it the usual threshold of evidence is used.")
def prove(cases: int, seed: int, json_file: Path | None, report_file: Path | None,
          work: Path | None, keep: str, oracle: bool, jobs: int | None,
          calibration: bool) -> int:
    """Conceal effects in recordings, seal the key, diagnose blindly, open the key and score.

    The key's SHA-256 is printed before any recording is read.
    """
    check_target(json_file)
    check_target(report_file)

    from eha_monitor.compiled import announce_first_compilation
    from eha_monitor.concealed.draws import draw_cases
    from eha_monitor.mismatch.prove import Trial, misses, write_json
    from eha_monitor.mismatch.prove import prove as run
    from eha_monitor.reports.proof_report import write_proof_report

    announce_first_compilation()
    work = (work or Path("out", "proof", f"seed{seed}-{cases}")).resolve()
    trial = Trial(tuple(draw_cases(cases, seed)), seed, work, oracle, jobs or 0, keep,
                  calibration)
    with progress_bar() as told:
        found = run(trial, lambda text: click.echo(text), told)
        told("writing the report", 1.0)
        report = report_file or work / "proof.html"
        write_proof_report(report, found, work)
    if json_file:
        write_json(json_file, found)
    click.echo(summary(found))
    click.echo(f"{len(misses(found))} of {found['cases']} missed; written: {report}, "
               f"{json_file or work / 'proof.json'}")
    return 0


def summary(found: dict) -> str:
    """Return the marks as lines, each beside the figure that is aimed at."""
    from eha_monitor.mismatch.prove_score import MARKS

    lines = []
    for name, (words, aim, _, _) in MARKS.items():
        value = found["score"].get(name)
        shown = "-" if value is None else f"{value:.1%}"
        lines.append(f"  {shown:>7}  {words}" + (f" (aim: {aim})" if aim else ""))
    return "\n".join(lines)


