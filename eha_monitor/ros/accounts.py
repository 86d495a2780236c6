"""What the diagnostics hold beside the judgement: rates, losses, bags."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from eha_monitor.filters.faults import FaultWatch
from eha_monitor.filters.rows import RowAligner
from eha_monitor.health.judge import Finding
from eha_monitor.health.overload import LatencyMeter, ProcessorMeter
from eha_monitor.ros.subscriptions import TopicInput


def rates(inputs: Sequence[TopicInput], now: float) -> dict[str, float]:
    """Return the messages per second of each topic since the last call.

    Parameters
    ----------
    now : s, monotonic.
    """
    return {f"rate_{each.key}_Hz": each.rate(now) for each in inputs}


def lost(aligner: RowAligner, watch: FaultWatch, missing_samples: int) -> dict[str, int]:
    """Return how much was lost or dropped since the start."""
    sources = aligner.sources
    return {"lost_messages": watch.missing,
            "missing_samples": missing_samples,
            "incomplete_rows": aligner.incomplete,
            "late_or_repeated_stamps": sum(s.late + s.repeated for s in sources),
            "jumped_stamps": sum(s.jumped for s in sources)}


def summary(rows: int, counts: Mapping[str, int], latency: LatencyMeter,
            processor: ProcessorMeter) -> str:
    """Return what was processed, lost and how late, in one line."""
    lost_ = ", ".join(f"{key.replace('_', ' ')} {value}" for key, value in counts.items())
    late = ", ".join(f"{key} {value:.2f} ms" for key, value in latency.percentiles().items())
    return (f"rows {rows}; {lost_}; latency from {latency.counts_from} to "
            f"published {late or 'not measured'}; "
            f"CPU share {100 * processor.total():.1f} %")


def with_bags(findings: Sequence[Finding], bags: Mapping[str, str]) -> list[Finding]:
    """Return findings of which each alarm names the bag of the moment in which it was raised.

    Parameters
    ----------
    bags : alarm -> bag; "" while the bag is due, which is told as such.
    """
    found = []
    for finding in findings:
        bag = bags.get(finding.name)
        if bag is not None:
            finding = replace(finding, values={
                **finding.values, **({"bag": bag} if bag else {"bag_due": 1})})
        found.append(finding)
    return found
