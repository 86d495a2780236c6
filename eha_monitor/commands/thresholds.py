"""``thresholds``: limits for the config from recordings of the healthy machine."""

import math
import shlex
from pathlib import Path

import click

from eha_monitor.commands import common
from eha_monitor.errors import InputError
from eha_monitor.output import finite, write_json, write_text

FEW = 5  # recordings; with fewer a spread is hardly known
SCHEMA = "eha_monitor/thresholds/1"


@click.command(cls=common.Several)
@click.option("--from", "bags", required=True, multiple=True, type=common.FILE,
              metavar="HEALTHY ...", help="Recordings of the healthy machine, five or more.")
@common.config_option
@click.option("--rate", type=click.FloatRange(0, 0.5, min_open=True), default=0.01,
              show_default=True, help="Share of healthy recordings that may raise a WARN; an "
              "ERROR a tenth of it.")
@click.option("--least", type=click.FloatRange(0, 0.6), default=0.1, show_default=True,
              help="Smallest distance of a WARN limit from the mean, as a fraction of the mean.")
@common.json_option
@common.write_config_option("Write the config with these thresholds.")
def thresholds(bags: tuple[Path, ...], config: Path | None, rate: float, least: float,
               json_file: Path | None, config_file: Path | None) -> None:
    """Propose alarm limits from healthy recordings, with the false-alarm rate that they imply."""
    common.check_outputs({"--json": json_file, "--write-config": config_file}, bags, config)
    for place, bag in enumerate(bags):
        if bag.resolve() in [other.resolve() for other in bags[:place]]:
            raise InputError(f"--from {bag}: is given twice, expected different recordings")

    from eha_monitor.health.proposal import proposed
    from eha_monitor.settings import load_settings

    settings = load_settings(config)
    healthy, told, unfit, seconds = _healthy(bags, settings)
    diagnosed = bool(settings.rig.identified)
    remedy = [] if diagnosed else _remedy(list(unfit), bags, config)
    draft = ["--config", "DRAFT.yaml" if diagnosed else str(config)] if config else []
    compare = shlex.join(["eha-monitor", "diagnose", "NOW", "--reference", *map(str, bags),
                          *draft])
    if not any(healthy.values()):
        if remedy:
            told.append(f"`{remedy[0]}` finds what the model lacks, and `{remedy[1]}` proposes "
                        "limits with it")
        if unfit:
            told.append(f"what needs no limits: `{compare}` compares the next recording (NOW) "
                        f"with these{', by the config that init drafted' * diagnosed}")
        raise InputError("; ".join([
            f"{bags[0] if len(bags) == 1 else f'{bags[0]} to {bags[-1]}'}: expected at least one "
            "recording in which B or βe converges", *told]))
    proposals = [proposed(symbol, found, rate, least)
                 for symbol, found in healthy.items() if found]
    if unfit:
        of = "" if len(unfit) == len(bags) else f" ({', '.join(map(str, unfit))})"
        told.append(f"the model does not fit {len(unfit)} of {len(bags)} recordings{of}: what is "
                    "in doubt there is by least squares on the balances, as the alarms judge it")
        # What a machine does from day to day no model narrows.
        daily = len(unfit) == len(bags) and all(one.between > one.within for one in proposals)
        if remedy and not daily:
            told += ["the diagnosed model brings narrower limits:",
                     *(f"  {command}" for command in remedy)]
        if diagnosed and any(len(found) < len(bags) for found in healthy.values()):
            told += ["what is left out shows in a comparison of the next recording (NOW) with "
                     "these, by the config that init drafted:", f"  {compare}"]
    notes = _sentences(proposals, told, seconds, len(bags))
    _show(proposals, notes, settings)
    if json_file:
        write_json(json_file, finite({"schema": SCHEMA, "recording_s": seconds, "notes": notes,
                                      "proposals": {one.symbol: one for one in proposals}}))
        click.echo(f"written: {json_file}")
    if config_file:
        write_text(config_file, _config(proposals, settings, config, seconds))
        click.echo(f"written: {config_file}")


def _healthy(bags, settings):
    """Return what each recording says, sentences, where the model does not fit, usual length."""
    import numpy as np

    from eha_monitor.api.estimate import judged_series, refuse_short
    from eha_monitor.api.read import checked
    from eha_monitor.compiled import load_runtime
    from eha_monitor.estimation.inputs import time_of
    from eha_monitor.estimation.pipeline import estimate
    from eha_monitor.health.proposal import healthy_of
    from eha_monitor.quantity import SYMBOLS
    from eha_monitor.recordings.read import read_recording

    load_runtime()
    found, unfit, seconds = {"B": [], "beta_e": []}, [], []
    left_out: dict[tuple[str, str], list[Path]] = {}
    for bag in bags:
        with common.working(f"estimating {bag}"):
            recording = read_recording(bag, settings)
            (recording,), _ = checked([recording], settings)
            refuse_short(recording)
            answer = estimate(recording, settings)
        seconds.append(recording.duration)
        warmth = recording.get("temperature") if recording.has("temperature") else None
        for symbol, series in judged_series(answer).items():
            one = healthy_of(str(bag), symbol, time_of(recording), series, settings, warmth)
            if one is not None:
                found[symbol].append(one)
                continue
            why = series.final.message or series.final.status
            if symbol in answer.model.tainted:
                why = "it is not determined while the model does not fit" + (
                    ", or not long enough" if symbol not in answer.doubted else "")
            left_out.setdefault((symbol, why), []).append(bag)
        if answer.model.status == "mismatch":
            unfit.append(bag)
    told = [f"{f'all {len(bags)}' if len(some) == len(bags) > 1 else ', '.join(map(str, some))}: "
            f"{SYMBOLS.get(symbol, symbol)} is left out: {why}"
            for (symbol, why), some in left_out.items()]
    return found, told, unfit, float(np.median(seconds))


def _remedy(unfit, bags, config) -> list[str]:
    """Return the commands that bring limits with a diagnosed model; none where it fits.

    Of one recording: a filter then finds the laws in the form that the estimate needs, where
    several together say what they have in common.
    """
    if not unfit:
        return []
    given = ["--config", str(config)] if config else []
    return [f"eha-monitor {shlex.join(words)}" for words in (
        ["diagnose", str(unfit[0]), *given, "--write-config", "diagnosed.yaml"],
        ["thresholds", "--from", *map(str, bags), "--config", "diagnosed.yaml", "--write-config",
         "judged.yaml"])]


def _show(proposals, notes, settings) -> None:
    from eha_monitor.commands.table import console, show_paper, table
    from eha_monitor.estimation.results import units_of
    from eha_monitor.quantity import SYMBOLS, quantity, share

    to = console()
    units = units_of(settings.rig.motion)
    rows = []
    for one in proposals:
        for limit in one.limits:
            value = quantity(limit.value, units[one.symbol], 4)
            rows.append((f"{SYMBOLS.get(one.symbol, one.symbol)} {limit.key}",
                         f"none (would be {value})" if limit.wide else value,
                         f"{limit.factor:.3g}", _rate(limit.rate)))
        between = ("not known from one recording" if math.isnan(one.between) else
                   share(one.between, 2) if one.between else "no more than that explains")
        to.print(f"{SYMBOLS.get(one.symbol, one.symbol)}: {len(one.healthy)} recording"
                      f"{'s' * (len(one.healthy) > 1)}, mean "
                      f"{quantity(one.mean, units[one.symbol], 4)}, spread within a recording "
                      f"{share(one.within, 2)}, between recordings {between}", markup=False)
    to.print(table("limit", "value", "of the mean", "false alarms", rows=rows))
    show_paper(to)
    for sentence in notes:
        to.print(sentence, markup=False, soft_wrap=sentence.startswith("  "))  # may be copied


def _rate(rate: float) -> str:
    return "not known" if math.isnan(rate) else (
        f"{100 * rate:.2f} % of recordings" if rate >= 1e-4 else "less than 0.01 % of recordings")


def _sentences(proposals, told, seconds, given) -> list[str]:
    """Return what a person must know before the limits are used, of so many given recordings."""
    from eha_monitor.health.proposal import WIDE
    from eha_monitor.quantity import SYMBOLS
    from eha_monitor.words import listed

    said = [*told]
    for one in proposals:
        name, n = SYMBOLS.get(one.symbol, one.symbol), len(one.healthy)
        said += [f"{source}: {name} differs from the other recordings (probability "
                 f"{chance:.1g}): was the machine healthy? If not, leave it out"
                 for source, chance in one.unlike]
        if n == 1:
            said.append(f"{name}: one recording does not show how much healthy recordings differ "
                        "(temperature, load, motion), so no false-alarm rate can be given: the "
                        "limits are the paper's, scaled to this value. "
                        + (f"{given - 1} of the {given} recordings were left out (above)"
                           if given > 1 else "Record four more, on other days"))
        elif one.more:
            wide = listed([limit.key for limit in one.limits if limit.wide])
            said.append(f"{name}: no {wide}, which would be more than a factor of {WIDE:g} from "
                        f"the mean and watch nothing: {n} of {given} recordings determine it, "
                        f"{one.more} that do, with this spread, would be enough for every limit")
        elif n < FEW:
            few = f"{n} recordings are few for reliable limits"
            said.append(f"{name}: {few}; {given - n} of the {given} were left out (above)"
                        if given >= FEW else
                        f"{name}: {few}; record {FEW} or more, on other days and at other oil "
                        "temperatures")
    said.append(f"Rates are per further healthy recording of about {seconds:.0f} s, made like "
                "these; conditions that none of these covers (another oil, another load) are not "
                "included.")
    return said


def _config(proposals, settings, config, seconds: float) -> str:
    from eha_monitor import __version__
    from eha_monitor.health.proposal import thresholds_tree
    from eha_monitor.settings.load import annotated, settings_from_tree

    tree = settings.model_dump(exclude_unset=True)
    given = settings.thresholds.model_dump()
    for section, limits in thresholds_tree(proposals).items():
        given[section] = given[section] | limits
    changed = settings_from_tree(tree | {"thresholds": given}, "the proposal")
    lines = [f"Written by eha_monitor {__version__}: thresholds from healthy recordings for "
             f"{config.name if config else 'the paper EHA'}."]
    for one in proposals:
        rates = ", ".join(f"{limit.key} {_rate(limit.rate)}" for limit in one.limits
                          if not limit.wide) or "no limit, all are too wide"
        lines.append(f"  {one.symbol}: {len(one.healthy)} recordings of about {seconds:.0f} s; "
                     f"false alarms: {rates}")
    return annotated(changed, "\n".join(lines))
