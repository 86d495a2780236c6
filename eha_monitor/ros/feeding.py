"""Which channels a parameter needs, and why it lacks them now."""

import time
from collections.abc import Mapping, Sequence

from eha_monitor.ros.subscriptions import TopicInput
from eha_monitor.settings import Settings

# Channels that a parameter needs, besides the position: one of these sets.
NEEDS = {"B": (("force",), ("p1", "p2")), "beta_e": (("x_d",),)}


def unfed(symbol: str, seen: Mapping[str, int], row_ns: int, inputs: Sequence[TopicInput],
          settings: Settings) -> str | None:
    """Return why a parameter has no data now, or None if its channels come.

    A channel that comes, or waits to be taken, and is in no row is told from one that does not.

    Parameters
    ----------
    seen : by channel, stamp of the last row that held it, ns.
    row_ns : stamp of the last row, ns.
    """
    limit = settings.monitor.stale_after * 1e9
    topic_of = {channel: each.topic.full_name for each in inputs for entry in each.topic.entries
                for channel, _ in entry.channels}
    lacking = [[name for name in ("x", *choice) if row_ns - seen.get(name, -limit * 2) > limit]
               for choice in NEEDS.get(symbol, ())]
    if not lacking or not all(lacking):
        return None
    if coming := sorted(_coming(inputs, settings).intersection(lacking[-1])):
        return (f"{' and '.join(coming)} {'come' if len(coming) > 1 else 'comes'}, but too late "
                "for the samples of x, which wait no longer than "
                f"{settings.monitor.latency:g} s (monitor.latency)")
    named = [" and ".join(f"{name} (topic {topic_of.get(name, 'not configured')})"
                          for name in missing) for missing in lacking]
    return f"no data for {', or '.join(named)}"


def _coming(inputs: Sequence[TopicInput], settings: Settings) -> set[str]:
    """Return the channels beside those of the position's stream that came of late, or wait."""
    now = time.monotonic()
    return {channel for each in inputs for entry in each.topic.entries
            for channel in entry.source.channels if "x" not in entry.source.channels
            if each.waits or now - entry.source.heard_s <= settings.monitor.stale_after}
