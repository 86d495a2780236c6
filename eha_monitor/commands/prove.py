"""``prove``: effects are concealed in recordings, the key is sealed, the diagnosis is scored."""

from pathlib import Path

import click

from eha_monitor.commands import common
from eha_monitor.output import write_text


@click.command()
@common.config_option
@click.option("--cases", type=click.IntRange(1, 10000), default=200, show_default=True,
              help="How many recordings.")
@click.option("--seed", type=click.IntRange(0, 2**31 - 1), default=1, show_default=True,
              help="Seed of the draws; the first cases of a longer trial are the same.")
@common.json_option
@click.option("--report", "report_file", type=common.FILE, metavar="FILE.html",
              help="Write a self-contained HTML report; without it DIR/proof.html.")
@click.option("--draw", type=click.Choice(("mixed", "outside")), default="mixed",
              show_default=True, help="Sets of 0 to 3 effects on all rigs and motions; or "
              "effects that are not in the catalogue.")
@click.option("--rig", type=click.Choice(("exact", "within", "beyond", "mixed")), default="mixed",
              show_default=True, help="What the nominal configs say of the rig: the truth; each "
              "number off by one tolerance (standard deviation); one number off by 3 to 10 of "
              "them; or 40 %, 40 % and 20 % of these.")
@click.option("--work", type=common.FILE, metavar="DIR",
              help="Folder of recordings, key and answers; by default out/proof/... here. An "
                   "interrupted trial is resumed.")
@click.option("--keep", type=click.Choice(("same", "all", "none")), default="same",
              show_default=True, help="Which results of an earlier run are kept: those of this "
                                      "very source of the program, all, or none.")
@click.option("--oracle/--no-oracle", default=False,
              help="Also fit each case with a model that is given the true effects: the best "
                   "achievable result and the available evidence (takes half as long again).")
@click.option("--jobs", type=click.IntRange(1, 1024), default=None,
              help="Processes at a time; all cores by default.")
def prove(config: Path | None, cases: int, seed: int, json_file: Path | None,
          report_file: Path | None, draw: str, rig: str, work: Path | None, keep: str,
          oracle: bool, jobs: int | None) -> int:
    """Conceal effects in recordings, seal the key, diagnose blind, open the key and score.

    The key's SHA-256 is printed before any recording is read.  With a config all cases are on its
    rig; without one, on the paper's and others about it.
    """
    common.end_as_on_interrupt()
    common.check_target(json_file)
    common.check_target(report_file)

    from eha_monitor.prove.trial import Trial, cases_of, misses, write_json
    from eha_monitor.prove.trial import prove as run
    from eha_monitor.reports.proof_report import proof_page
    from eha_monitor.settings import load_settings

    settings = load_settings(config) if config else None
    drawn = cases_of(draw, cases, seed, rig, settings, str(config))
    kind = draw if rig == "mixed" else f"{draw}-{rig}"
    work = (work or Path("out", "proof", f"{kind}-seed{seed}-{cases}")).resolve()
    with common.progress_bar() as told:
        found = run(Trial(drawn, seed, work, oracle, jobs or 0, keep), click.echo, told)
        told("writing the report", 1.0)
        report = report_file or work / "proof.html"
        write_text(report, proof_page(found, work))
    if json_file:
        write_json(json_file, found)
    click.echo(summary(found))
    click.echo(f"{len(misses(found))} of {found['cases']} missed; written: {report}, "
               f"{json_file or work / 'proof.json'}")
    return 0


def summary(found: dict) -> str:
    """Return the marks as lines, each beside the figure that is aimed at."""
    from eha_monitor.prove.score import MARKS

    lines = []
    for name, (words, aim, _, _) in MARKS.items():
        value = found["score"].get(name)
        shown = "-" if value is None else f"{100 * value:.1f} %"
        lines.append(f"  {shown:>7}  {words}" + (f" (aim: {aim})" if aim else ""))
    return "\n".join(lines)


