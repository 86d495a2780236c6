"""A newcomer's five steps on ten rigs that this project's makers did not think of.

    python benchmarks/newcomer.py [--rigs NAME ...] [--seed 0] [--no-diagnose] [--check]

The rigs are those of benchmarks/strangers: another set of equations, other areas, rates, drives,
friction, files.  The config says what the README's second step asks for and no more.  Then
`import`, `estimate`, `diagnose --write-config`, and `estimate` with what that wrote, each as a
process of its own.  Each answer is scored: *right number* (within three of its deviations or 2 %
of the truth), *honest word* (mismatch, unexplained, not excited, refused with a reason), or
**confidently wrong** (stated as converged, the model as consistent, and off).  `--check` looks at
the plant instead: balances, step size, stability, levels.
"""

import argparse
import json
import sys
import tempfile
from dataclasses import asdict, dataclass, field
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

from rich.console import Console
from rich.table import Table
from stranger_parts.commands import Answer, answer_of, off, shell, shown
from strangers.check import check
from strangers.record import config_of, write_config, write_csv
from strangers.rigs import RIGS, Rig

from eha_monitor.concealed.strangers.plant import DAHL, STRIBECK, recording

DIAGNOSE_S = 600.0  # wall
RIGHT, HONEST, WRONG, BROKEN = "right number", "honest word", "CONFIDENTLY WRONG", "broken"


@dataclass(frozen=True)
class Step:
    """One command of one newcomer, and what became of it."""

    command: str
    status: int | None
    score: str
    b: str = "–"
    beta: str = "–"
    verdict: str = "–"
    named: tuple[str, ...] = ()
    channels: tuple[str, ...] = ()
    wall: float = 0.0
    cpu: float = 0.0
    last_line: str = ""


@dataclass
class Story:
    """What a newcomer with one rig went through."""

    rig: str
    words: str
    b: float
    beta: float
    left_out: tuple[str, ...]
    steps: list[Step] = field(default_factory=list)


def left_out(rig: Rig) -> tuple[str, ...]:
    """Return what the linear model with the README's config does not know of a rig."""
    c, found = rig.plant, []
    if c.friction in (STRIBECK, DAHL):
        found.append(f"{c.dry:g} N {'Stribeck' if c.friction == STRIBECK else 'Dahl'}")
    if rig.drive.hold:
        found.append(f"hold {rig.drive.hold}x")
    if c.lag:
        found.append(f"lag {c.lag * 1e3:g} ms")
    if c.load:
        found.append(f"load {c.load:g} N")
    if c.area_1 != c.area_2:
        found.append("single rod")
    return tuple(found)


def judge(answer: Answer, rig: Rig, command: str) -> str:
    """Return the score of an answer."""
    if answer.status is None:
        return "time out"
    if answer.status == 2:
        return HONEST if answer.lines else BROKEN
    if answer.status != 0:
        return BROKEN
    truth = {"B": rig.plant.damping, "beta_e": rig.plant.bulk_modulus}
    stated = {key: one for key, one in answer.parameters.items()
              if key in truth and one.get("value") is not None
              and one.get("status", "converged") == "converged"}
    wrong = [key for key, one in stated.items() if off(one, truth[key])]
    # A diagnosis that names physics stands behind the numbers beside it.
    sure = answer.model == "consistent" if command == "estimate" else (
        answer.verdict in ("consistent", "mismatch"))
    if wrong and sure:
        return f"{WRONG} ({', '.join(wrong)})"
    if len(stated) == 2 and not wrong:
        return RIGHT + ("" if sure else ", in doubt")
    return HONEST


def step(command: str, ran, file: Path, rig: Rig) -> Step:
    """Return what a command answered, scored."""
    answer = answer_of(ran, file)
    named = tuple(_effect(one) for one in answer.tree.get("effects", ())
                  if isinstance(one, dict))
    return Step(
        command, answer.status, judge(answer, rig, command.split()[0]),
        shown(answer.parameters.get("B")), shown(answer.parameters.get("beta_e")),
        answer.model or answer.verdict or "–", named,
        tuple(str(f.get("finding", f)) for f in answer.findings), ran.wall, ran.cpu,
        answer.lines[-1] if answer.lines else "")


def _effect(one: dict) -> str:
    values = (f"{key}={value['value']:.4g}" for key, value in one["parameters"].items())
    return f"{one['name']}({', '.join(values)})"


def play(rig: Rig, folder: Path, seed: int, diagnose: bool, limit: float) -> Story:
    """Go through the README's steps with one rig."""
    story = Story(rig.name, rig.words, rig.plant.damping, rig.plant.bulk_modulus, left_out(rig))
    csv = write_csv(rig, recording(rig, seed), folder / f"{rig.name}.csv")
    config = str(write_config(config_of(rig), folder / f"{rig.name}.yaml"))
    bag, second = str(folder / rig.name), str(folder / f"{rig.name}_2.yaml")

    def do(command, *arguments, timeout=DIAGNOSE_S):
        answer = folder / f"{rig.name}_{len(story.steps)}.json"
        ran = shell(command.split()[0], *arguments, "--json", str(answer), timeout=timeout)
        story.steps.append(step(command, ran, answer, rig))

    ran = shell("import", str(csv), "--map", config, "--out", bag)
    if ran.status:
        line = ran.err.strip().splitlines()[-1:] or [""]
        story.steps.append(Step("import", ran.status, HONEST if ran.status == 2 else BROKEN,
                                wall=ran.wall, cpu=ran.cpu, last_line=line[0]))
        return story
    do("estimate", bag, "--config", config, "--report", str(folder / "report.html"))
    if diagnose:
        do("diagnose", bag, "--config", config, "--write-config", second, timeout=limit)
        if Path(second).is_file():
            do("estimate (2)", bag, "--config", second)
    return story


def show(stories: list[Story]) -> None:
    """Print what was true, what was said, and the score."""
    table = Table(title="the five steps of a newcomer")
    for head in ("rig", "step", "B", "βe", "verdict", "named", "channels", "cpu s", "score"):
        table.add_column(head, overflow="fold")
    for one in stories:
        table.add_row(one.rig, "truth", f"{one.b:g}", f"{one.beta / 1e6:g} M", "",
                      ", ".join(one.left_out), "", "", "", style="bold")
        for s in one.steps:
            table.add_row("", s.command, s.b, s.beta, s.verdict, "; ".join(s.named),
                          "; ".join(s.channels), f"{s.cpu:.0f}",
                          s.score + (f": {s.last_line[:80]}" if s.status else ""),
                          end_section=s is one.steps[-1])
    Console(width=200).print(table)
    for command in dict.fromkeys(s.command for one in stories for s in one.steps):
        own = [s for one in stories for s in one.steps if s.command == command]
        print(f"{command}: right number {_count(own, RIGHT)}, honest word {_count(own, HONEST)}, "
              f"confidently wrong {_count(own, WRONG)}, broken {_count(own, BROKEN)}, time out "
              f"{_count(own, 'time out')} of {len(own)}; "
              f"{sum(s.cpu for s in own):.0f} s of processor")
    last = [one.steps[-1] for one in stories]
    print(f"at the end of the steps: right number {_count(last, RIGHT)}, honest word "
          f"{_count(last, HONEST)}, confidently wrong {_count(last, WRONG)}, neither "
          f"{sum(not s.score.startswith((RIGHT, HONEST, WRONG)) for s in last)} of {len(last)}")


def _count(steps: list[Step], score: str) -> int:
    return sum(s.score.startswith(score) for s in steps)


def show_check(rigs: list[Rig]) -> bool:
    """Print what the plant's own checks find; tell whether all is well."""
    table = Table(title="the strangers' plant, checked")
    for head in ("rig", "flow balance", "work balance", "Δx on half the step / noise", "Δp",
                 "damping 1/s", "lowest bar", "rpm", "m/s", "swept/V", "faults"):
        table.add_column(head)
    good = True
    for rig in rigs:
        c = check(rig)
        faults = c.faults()
        good = good and not faults
        table.add_row(rig.name, f"{c.flow:.1e}", f"{c.energy:.1e}", f"{c.step:.1e}",
                      f"{c.step_p:.1e}", f"{c.damping:.1f}", f"{c.lowest / 1e5:.2f}",
                      f"{c.rpm:.0f}", f"{c.speed:.3f}", f"{c.swept:.2f}",
                      ", ".join(faults) or "none")
    Console(width=150).print(table)
    return good


def main() -> int:
    """Run it and print its tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rigs", nargs="+", choices=list(RIGS), metavar="NAME")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--no-diagnose", action="store_true")
    parser.add_argument("--timeout", type=float, default=DIAGNOSE_S, metavar="S",
                        help="wall time that diagnose may take")
    parser.add_argument("--check", action="store_true", help="check the plant, and end")
    parser.add_argument("--json", type=Path, metavar="FILE")
    asked = parser.parse_args()
    rigs = [RIGS[name] for name in asked.rigs or RIGS]
    if asked.check:
        return int(not show_check(rigs))
    stories = []
    with tempfile.TemporaryDirectory(prefix="newcomer_") as folder:
        for rig in rigs:
            stories.append(play(rig, Path(folder), asked.seed, not asked.no_diagnose,
                                asked.timeout))
            for s in stories[-1].steps:
                print(f"{rig.name}: {s.command}: {s.score} ({s.wall:.0f} s)", flush=True)
    show(stories)
    if asked.json:
        asked.json.write_text(json.dumps([asdict(one) for one in stories], indent=1,
                                         ensure_ascii=False) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
