"""Forty mistakes of people: is each named, is none answered with confidence; and no false word.

    python benchmarks/wrong_inputs.py [--only NAME ...] [--diagnose] [--right 200] [--seed 0]

A mistake is injected as a person makes it: a wrong scale, column or number in the config that
`import` and `estimate` get; what is true stands in stranger_parts/mistakes.py and is opened only
for the score.  Named rightly: an entry of the JSON's `channels`, or a line on the error stream,
has the kind, the channel (or config key) and the size of the mistake.  Confidently wrong: a
number that is `converged`, beyond three of its deviations and 2 % of the truth, under a model that
is `consistent` or without any finding.  Then the reverse: right recordings, on which every finding
that is not of kind `hold`, and every refusal, is a false word.
"""

import argparse
import json
import tempfile
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table
from stranger_parts.bases import Base, base_of, data_folder, edited
from stranger_parts.commands import Answer, answer_of, converged_off, here, shell, shown
from stranger_parts.mistakes import MISTAKES, Mistake
from stranger_parts.right import right_ones
from stranger_parts.scoring import named, numbers_that_differ
from strangers.record import write_config

DIAGNOSE_S = 300.0
EVERY_CLI = 8  # of the right recordings, one in so many runs as a process of its own


@dataclass(frozen=True)
class Score:
    """What became of one mistake, with one command."""

    name: str
    words: str
    command: str
    status: int | None
    full: bool
    place: bool
    wrong: tuple[str, ...]  # converged, and off
    confident: bool  # and consistent, or without any finding
    consistent: bool  # the verdict of diagnose
    model: str
    said: str
    b: str
    beta: str
    wall: float


def score(mistake: Mistake, answer: Answer, command: str, right: tuple[float, ...],
          truth: dict, wall: float) -> Score:
    """Open the truth of one mistake and judge what was answered."""
    full, place = named(answer, mistake.truths, right)
    wrong = converged_off(answer, truth)
    if command == "diagnose":
        wrong = []  # its numbers have no status; its verdict is judged
    spoken = bool(answer.findings) or answer.status == 2
    return Score(
        mistake.name, mistake.words, command, answer.status, full, place, tuple(wrong),
        bool(wrong) and (answer.model == "consistent" or not spoken),
        answer.verdict == "consistent", answer.model or answer.verdict, answer.said(),
        shown(answer.parameters.get("B")), shown(answer.parameters.get("beta_e")), wall)


class Trial:
    """Runs mistakes in a folder; the bases' files and right answers are made once."""

    def __init__(self, folder: Path, data: Path | None, seed: int, run=shell):
        self.folder, self.data, self.seed, self.run = folder, data, seed, run
        self.bases: dict[str, tuple[Base, dict] | None] = {}

    def base(self, name: str) -> tuple[Base, dict] | None:
        """Return a base and what is true of it, or None where its data are missing."""
        if name not in self.bases:
            base = base_of(name, self.folder, self.data, self.seed)
            self.bases[name] = base and (base, self._truth(name, base))
        return self.bases[name]

    def _truth(self, name: str, base: Base) -> dict:
        if all(value is not None for value in base.truth.values()):
            return base.truth
        answer, _ = self.ask(f"right_{name}", base.file, base.tree, "estimate")
        return {key: one["value"] if one.get("status") == "converged" else None
                for key, one in answer.parameters.items()}

    def ask(self, name: str, file: Path, tree: dict, command: str) -> tuple[Answer, float]:
        """Import with a config and ask a command; what import refuses is its answer."""
        config = write_config(tree, self.folder / f"{name}.yaml")
        bag, answer = self.folder / name, self.folder / f"{name}_{command}.json"
        if not bag.exists():
            done = self.run("import", str(file), "--map", str(config), "--out", str(bag))
            if done.status:
                return answer_of(done, answer), done.wall
        limit = {"timeout": DIAGNOSE_S} if self.run is shell and command == "diagnose" else {}
        ran = self.run(command, str(bag), "--config", str(config), "--json", str(answer), **limit)
        return answer_of(ran, answer), ran.wall

    def scores(self, mistake: Mistake, commands: tuple[str, ...]) -> list[Score]:
        """Return the scores of one mistake; none where its base is missing."""
        found = self.base(mistake.base)
        if found is None:
            return []
        base, truth = found
        wrong = edited(base, mistake.edit)
        right = numbers_that_differ(base.tree, wrong)
        scores = []
        for command in commands:
            answer, wall = self.ask(mistake.name, base.file, wrong, command)
            scores.append(score(mistake, answer, command, right, truth, wall))
        return scores


def trial_of_right(count: int, folder: Path, data: Path | None, seed: int) -> list[dict]:
    """Return what was said of each right recording."""
    rows = []
    for k, one in enumerate(right_ones(count, folder, data, seed, here)):
        file = folder / "right.json"
        file.unlink(missing_ok=True)
        answer, run = None, shell if k % EVERY_CLI == 0 else here
        if not one.problem:
            ran = run("estimate", str(one.bag), "--config", str(one.config), "--json", str(file))
            answer = answer_of(ran, file)
        words = [one.problem] if answer is None else [
            str(f.get("finding", f)) for f in answer.findings if f.get("kind") != "hold"]
        if answer is not None and answer.status:
            words += [f"exit {answer.status}: {answer.lines[-1] if answer.lines else ''}"]
        # Beside the false words: left-out physics that the answer does not see, but stands by.
        unseen = [] if answer is None or answer.model != "consistent" else converged_off(
            answer, one.truth)
        rows.append({"name": one.name, "kind": one.kind, "cli": run is shell, "false": words,
                     "consistent_and_off": [
                         f"{key} {shown(answer.parameters[key])}, true {one.truth[key]:.5g}"
                         for key in unseen]})
        if words:
            print(f"  false word: {one.name}: {words[0][:160]}", flush=True)
    return rows


def show(scores: list[Score], right: list[dict], missing: int) -> dict:
    """Print the tables; return the figures."""
    table = Table(title="mistakes, and what was answered")
    for head in ("mistake", "command", "exit", "named", "B", "βe", "model", "s", "said"):
        table.add_column(head, overflow="fold")
    for s in scores:
        mark = "yes" if s.full else ("place only" if s.place else "no")
        mark += ", CONFIDENTLY WRONG" if s.confident else ""
        table.add_row(s.name, s.command, "time out" if s.status is None else str(s.status), mark,
                      s.b, s.beta, s.model, f"{s.wall:.0f}", s.said[:150])
    if scores:
        Console(width=190).print(table)
    figures = {}
    for command in dict.fromkeys(s.command for s in scores):
        own = [s for s in scores if s.command == command]
        figures[command] = {
            "mistakes": len(own), "named_rightly": sum(s.full for s in own),
            "kind_and_place": sum(s.place for s in own),
            "confidently_wrong": sum(s.confident for s in own),
            "converged_and_wrong": sum(bool(s.wrong) for s in own),
            "verdict_consistent": sum(s.consistent for s in own),
            "crashed_or_out_of_time": sum(s.status not in (0, 2) for s in own)}
        f = figures[command]
        print(f"{command}: named rightly {f['named_rightly']} of {f['mistakes']} (kind and place "
              f"{f['kind_and_place']}); confident wrong answers {f['confidently_wrong']}; "
              f"converged and wrong, whatever else was said, {f['converged_and_wrong']}; verdict "
              f"consistent {f['verdict_consistent']}; crashed or out of time "
              f"{f['crashed_or_out_of_time']}")
        for s in own:
            if not s.full:
                print(f"  missed: {s.name} ({s.words}): {s.said[:200] or 'nothing said'}")
    if missing:
        print(f"{missing} mistakes left out: the real recordings are not here")
    if right:
        false = [row for row in right if row["false"]]
        kinds = Counter(row["kind"] for row in right)
        figures["right"] = {"recordings": len(right), "false_words": len(false),
                            "kinds": dict(kinds)}
        print(f"right recordings: false words {len(false)} of {len(right)} "
              f"({', '.join(f'{kind} {n}' for kind, n in kinds.items())}; "
              f"{sum(row['cli'] for row in right)} by a process of its own)")
        for row in false:
            print(f"  {row['name']}: {'; '.join(row['false'])[:300]}")
        unseen = [row for row in right if row["consistent_and_off"]]
        figures["right"]["consistent_and_off"] = len(unseen)
        print(f"right recordings answered as converged and consistent, but off: {len(unseen)}")
        for row in unseen:
            print(f"  {row['name']}: {'; '.join(row['consistent_and_off'])}")
    return figures


def main() -> None:
    """Run the trial and print its tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", metavar="NAME", help="mistakes by name or beginning")
    parser.add_argument("--diagnose", action="store_true", help="ask diagnose as well")
    parser.add_argument("--right", type=int, default=200, metavar="N")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--here", action="store_true",
                        help="run the mistakes within this process: faster, same entry")
    parser.add_argument("--data", type=Path)
    parser.add_argument("--json", type=Path, metavar="FILE")
    asked = parser.parse_args()
    chosen = [m for m in MISTAKES
              if not asked.only or any(m.name.startswith(name) for name in asked.only)]
    data = data_folder(asked.data)
    commands = ("estimate", "diagnose") if asked.diagnose else ("estimate",)
    with tempfile.TemporaryDirectory(prefix="wrong_inputs_") as folder:
        trial = Trial(Path(folder), data, asked.seed, here if asked.here else shell)
        scores, missing = [], 0
        for mistake in chosen:
            found = trial.scores(mistake, commands)
            missing += not found
            scores += found
            for one in found:
                print(f"{one.name}: {one.command}, exit {one.status}, "
                      f"{'named' if one.full else 'not named'}", flush=True)
        right = trial_of_right(asked.right, Path(folder), data, asked.seed) if asked.right else []
    figures = show(scores, right, missing)
    if asked.json:
        asked.json.write_text(json.dumps(
            {"figures": figures, "mistakes": [asdict(s) for s in scores], "right": right},
            indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
