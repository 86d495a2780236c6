"""``prove``: effects are concealed in recordings, the key is sealed, the diagnosis is scored."""

from pathlib import Path

import click

from eha_monitor.commands import common
from eha_monitor.errors import InputError
from eha_monitor.output import write_text

GROUNDS = ("draws", "mcmaster", "simulator", "strangers", "triangle")
DRAWS = 200


@click.command()
@common.config_option
@click.option("--ground", type=click.Choice(GROUNDS), default="draws", show_default=True,
              help="Source of the test cases: draws of the independent plant; the published "
                   "McMaster plant "
              "in its three states; recordings of a fluid-power simulator (--data); strangers' "
              "rigs with several recordings each; the paper's "
              "triangle with Coulomb friction and a second recording as advised.")
@click.option("--cases", type=click.IntRange(1, 10000), default=None,
              help="How many recordings, or rigs; 200 draws, or all that a ground has.")
@click.option("--data", type=common.FILE, metavar="DIR",
              help="Folder of the simulator's recordings, with its key.json; needs --config.")
@click.option("--seed", type=click.IntRange(0, 2**31 - 1), default=1, show_default=True,
              help="Seed of the draws; the first cases of a longer trial are the same.")
@common.json_option
@click.option("--report", "report_file", type=common.FILE, metavar="FILE.html",
              help="Write a self-contained HTML report; without it DIR/proof.html.")
@click.option("--markdown", "text_file", type=common.FILE, metavar="FILE.md",
              help="Put the result into a Markdown file, between its two result marks.")
@click.option("--draw", type=click.Choice(("mixed", "ladder", "outside")), default="mixed",
              show_default=True, help="Sets of 0 to 3 effects on all rigs and motions; single "
              "effects over a ladder of strengths, for a detection curve of each; or effects "
              "that are not in the catalogue.")
@click.option("--rig", type=click.Choice(("exact", "within", "beyond", "mixed")), default="mixed",
              show_default=True, help="What the nominal configs say of the rig: the truth; each "
              "number off by one tolerance (standard deviation); one number off by 3 to 10 of "
              "them; or 40 %, 40 % and 20 % of these.")
@click.option("--work", type=common.FILE, metavar="DIR",
              help="Folder of recordings, key and answers; by default out/proof/... here. An "
                   "interrupted trial is resumed.")
@click.option("--keep", type=click.Choice(("same", "all", "none")), default="same",
              show_default=True, help="Which results of an earlier run are kept: those of this "
                                      "very "
              "source of the program, all, or none.")
@click.option("--oracle/--no-oracle", default=False,
              help="Also fit each case with a model that is given the true effects: the best "
                   "achievable result and the available evidence (takes half as long again).")
@click.option("--jobs", type=click.IntRange(1, 1024), default=None,
              help="Processes at a time; all cores by default.")
@click.option("--calibration/--no-calibration", hidden=True, expose_value=False,
              help="No effect, as in diagnose.")
def prove(config: Path | None, ground: str, cases: int | None, data: Path | None, seed: int,
          json_file: Path | None, report_file: Path | None, text_file: Path | None, draw: str,
          rig: str, work: Path | None, keep: str, oracle: bool, jobs: int | None) -> int:
    """Conceal effects in recordings, seal the key, diagnose blind, open the key and score.

    The key's SHA-256 is printed before any recording is read.  With a config all cases are on its
    rig; without one, on the paper's and others about it.
    """
    common.end_as_on_interrupt()
    check_ground(ground, config, data, oracle)
    common.check_target(json_file)
    common.check_target(report_file)
    if text_file and not text_file.is_file():
        raise InputError(f"{text_file}: no such file; expected one with the result marks")

    from eha_monitor.prove.files import write_json
    from eha_monitor.prove.trial import misses
    from eha_monitor.reports.proof_report import proof_page

    kind = draw if rig == "mixed" else f"{draw}-{rig}"
    folder = f"{kind}-seed{seed}-{cases or DRAWS}" if ground == "draws" else (
        f"{ground}-seed{seed}" + (f"-{cases}" if cases else ""))
    work = (work or Path("out", "proof", folder)).resolve()
    with common.progress_bar() as told:
        if ground == "draws":
            from eha_monitor.prove.trial import Trial
            from eha_monitor.prove.trial import prove as run

            found = run(Trial(drawn_cases(config, draw, cases or DRAWS, seed, rig), seed, work,
                              oracle, jobs or 0, keep), click.echo, told)
        else:
            from eha_monitor.prove.grounds import Ground

            found = on_ground(ground, Ground(work, seed, cases or 0, jobs or 0, keep), data,
                              config, told)
        told("writing the report", 1.0)
        report = report_file or work / "proof.html"
        write_text(report, proof_page(found, work))
    if json_file:
        write_json(json_file, found)
    if text_file:
        from eha_monitor.reports.proof_report import write_result

        write_result(text_file, found)
    for fact in found.get("facts", ()):
        click.echo(f"  {fact}")
    if "parameters" in found:
        click.echo(parameter_lines(found["parameters"]))
    click.echo(summary(found))
    click.echo(f"{len(misses(found))} of {found['cases']} missed; written: {report}, "
               f"{json_file or work / 'proof.json'}")
    return 0


def check_ground(ground: str, config: Path | None, data: Path | None, oracle: bool) -> None:
    """Refuse options that a ground has no use for, and say what it needs."""
    if ground == "simulator" and (data is None or config is None):
        raise InputError("--ground simulator: expected --data DIR, the folder of the recordings "
                         "and key.json, and --config FILE, the nominal config with the table "
                         "section of the import")
    if ground != "simulator" and data is not None:
        raise InputError(f"--data: --ground {ground} reads no recordings, expected --ground "
                         "simulator")
    if ground in ("mcmaster", "strangers", "triangle") and config is not None:
        raise InputError(f"--config: --ground {ground} has its own rig, expected none")
    if ground != "draws" and oracle:
        raise InputError(f"--oracle: --ground {ground} has none, expected --ground draws")


def drawn_cases(config: Path | None, draw: str, count: int, seed: int, rig: str) -> tuple:
    """Return the draws of the independent plant, on the rig of a config if there is one."""
    from eha_monitor.prove.trial import cases_of
    from eha_monitor.settings import load_settings

    settings = load_settings(config) if config else None
    return cases_of(draw, count, seed, rig, settings, str(config))


def on_ground(name: str, ground, data: Path | None, config: Path | None, told) -> dict:
    """Run the trial on one of the other grounds."""
    if name == "mcmaster":
        from eha_monitor.prove.grounds.mcmaster import prove_mcmaster

        return prove_mcmaster(ground, click.echo, told)
    if name == "simulator":
        from eha_monitor.prove.grounds.simulator import prove_simulator

        return prove_simulator(ground, data, config, click.echo, told)
    if name == "strangers":
        from eha_monitor.prove.grounds.strangers import prove_strangers

        return prove_strangers(ground, click.echo, told)
    from eha_monitor.prove.grounds.triangle import prove_triangle

    return prove_triangle(ground, click.echo, told)


def parameter_lines(rows: list[dict]) -> str:
    """Return the parameters of a ground as lines: true, said, error."""
    from eha_monitor.quantity import quantity, with_uncertainty

    lines = []
    for row in rows:
        unit = row.get("unit", "")
        said = ("not named" if row["said"] is None else
                with_uncertainty(row["said"], row["stddev"], unit))
        error = "" if row["relative"] is None else f" ({row['relative']:.1%} off)"
        mark = "" if not row["aim"] else "  " if row["within"] else "! "
        lines.append(f"  {mark:2}{row['group']}  {row['name']}: "
                     f"{quantity(row['true'], unit)} true, {said}{error}")
    return "\n".join(lines)


def summary(found: dict) -> str:
    """Return the marks as lines, each beside the figure that is aimed at."""
    from eha_monitor.prove.score import MARKS

    lines = []
    for name, (words, aim, _, _) in MARKS.items():
        value = found["score"].get(name)
        shown = "-" if value is None else f"{value:.1%}"
        lines.append(f"  {shown:>7}  {words}" + (f" (aim: {aim})" if aim else ""))
    return "\n".join(lines)


