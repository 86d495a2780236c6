"""Fit on some records of a real rig and show on its others whether names and sizes are the same.

    python benchmarks/real_across.py [--data ../shared/data] [--only emps]

Each record is left out in turn.  `diagnose` names effects on the others and the fit is shown on
the one that was left out; the record alone is diagnosed as well, and what both name is compared,
in units of both standard deviations together.  EMPS has one record here, which is cut in halves.

The recordings state no licence, so they stay where they are; without them this says so and ends.
"""

import itertools
import math
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from real_diagnosis import EHA, HSM, ROOT, SEALS, options_of
from rich.console import Console
from rich.table import Table

from eha_monitor.errors import InputError
from eha_monitor.mismatch.diagnose import diagnose
from eha_monitor.mismatch.diagnosis import Diagnosis
from eha_monitor.recordings.importing import read_table
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings import Settings, load_settings

RECORDS = {"emps": ("emps/DATA_EMPS.mat",), "hsm150": HSM, "pneumatic_seals": SEALS,
           "ivliev_eha": (*EHA, "ivliev_eha/extra_2024_10_14_5.csv")}


def records_of(rig: str, data: Path, settings: Settings) -> list[Recording]:
    """Return the records of a rig; one alone in halves."""
    found = [read_table(data / file, settings) for file in RECORDS[rig]]
    if len(found) > 1:
        return found
    whole, middle = found[0], len(found[0]) // 2
    return [replace(whole, source=f"{whole.source}, half {i + 1}", channels={
        name: values[part] for name, values in whole.channels.items()})
        for i, part in enumerate((slice(0, middle), slice(middle, None)))]


def sizes_of(found: Diagnosis) -> dict[str, tuple[float, float]]:
    """Return B, beta_e, numbers of the rig and parameters of effects: value and deviation, SI."""
    values = {name: (value.value, value.stddev) for name, value in found.after.items()}
    values |= {f"rig.{one.key}": (one.found.value, one.found.stddev) for one in found.rig_data}
    for effect in found.effects:
        values |= {f"{effect.name}.{symbol}": (value.value, value.stddev)
                   for symbol, value in effect.parameters.items() if value.stddev > 0.0}
    return values


def compared(one: Diagnosis, other: Diagnosis) -> Iterator[tuple[str, float]]:
    """Yield what both name, and by how many of their deviations together they differ."""
    first, second = sizes_of(one), sizes_of(other)
    for name in first:
        if name in second:
            width = math.hypot(first[name][1], second[name][1])
            if width > 0.0:
                yield name, (first[name][0] - second[name][0]) / width


def left(found: Diagnosis) -> str:
    """Return the share of the error in excess of the noise that is left on the unseen record."""
    return ", ".join(f"{name} {fit.after_rms / fit.before_rms:.2f}"
                     for name, fit in found.signals.items() if fit.before_rms > 0.0)


def named(found: Diagnosis) -> str:
    """Return the verdict and the names."""
    names = [effect.name for effect in found.effects] + [
        f"rig.{one.key}" for one in found.rig_data]
    return f"{found.verdict}: {', '.join(names) or '-'}"


def agree(one: Diagnosis, other: Diagnosis) -> bool:
    """Tell whether two answers name the same, or what either says it cannot tell apart."""
    def classes(found: Diagnosis) -> list[set[str]]:
        return [{effect.name, *effect.indistinguishable_from} for effect in found.effects] + [
            {f"rig.{finding.key}", *finding.indistinguishable_from} for finding in found.rig_data]

    mine, theirs = classes(one), classes(other)
    return one.verdict == other.verdict and len(mine) == len(theirs) and any(
        all(first & second for first, second in zip(mine, order, strict=True))
        for order in itertools.permutations(theirs))


def main() -> None:
    """Print the table."""
    options = options_of(__doc__.splitlines()[0])
    if options is None:
        return
    table = Table(title="named on the others, shown on the record that was left out",
                  show_lines=True)
    for head in ("record", "named on the others", "named on it alone", "error left on it",
                 "differ, in deviations"):
        table.add_column(head)
    same = alike = records = within = sizes = 0
    for rig in (rig for rig in RECORDS if options.only in ("", rig)):
        settings = load_settings(ROOT / "config" / f"{rig}.yaml")
        every = records_of(rig, options.data, settings)
        for i, record in enumerate(every):
            print(f"{rig} {i + 1}/{len(every)}", file=sys.stderr, flush=True)
            try:
                others = diagnose([*every[:i], *every[i + 1:]], settings, record)
                alone = diagnose([record], settings)
            except InputError as error:
                table.add_row(Path(record.source).stem, str(error), "", "", "")
                continue
            gaps = list(compared(others, alone))
            alike += agree(others, alone)
            records, same = records + 1, same + (named(others) == named(alone))
            sizes, within = sizes + len(gaps), within + sum(abs(gap) <= 2.0 for _, gap in gaps)
            table.add_row(Path(record.source).stem, named(others), named(alone), left(others),
                          ", ".join(f"{name} {gap:+.1f}" for name, gap in gaps))
    Console(width=190).print(table)
    print(f"names the same: {same} of {records}, with what is not told apart: {alike}; sizes "
          f"within 2 deviations: {within} of {sizes}")


if __name__ == "__main__":
    main()
