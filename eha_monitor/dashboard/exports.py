"""What is shown, as CSV."""

import math

from eha_monitor.dashboard.events import csv_text, utc
from eha_monitor.dashboard.history import Row
from eha_monitor.dashboard.state import ESTIMATES_EVERY, STAGES, State
from eha_monitor.estimation.results import units_of
from eha_monitor.health.alarms import WATCHED


def estimates_csv(state: State, now: float, since: float = -math.inf,
                  until: float = math.inf) -> str:
    """Return the estimates and innovations of a stretch of time, SI, as they were kept.

    Values of the same moment, within half of the spacing at which they are kept, are one row.

    Parameters
    ----------
    now : s, monotonic.
    since, until : time of day, s since the epoch.
    """
    units = units_of(state.settings.rig.motion)
    header = ["time_utc", "time_s"]
    series: list[tuple[int, list[Row]]] = []
    for watched in WATCHED:
        unit = units[watched.symbol]
        series.append((len(header) - 2, state.history(watched.symbol, now, since)))
        header += [f"{watched.section} [{unit}]", f"{watched.section}_stddev [{unit}]"]
    for stage in STAGES:
        series.append((len(header) - 2, state.history(stage, now, since)))
        header += [f"{stage}_innovation_nis", f"{stage}_innovation_variance_ratio"]
    cells = sorted((row[0], column, row[1:]) for column, rows in series for row in rows
                   if row[0] <= until and math.isfinite(row[1]))
    table: list[tuple[float, list]] = []
    for time_s, column, values in cells:
        if not table or time_s - table[-1][0] > 0.5 * ESTIMATES_EVERY or (
                table[-1][1][column] != ""):
            table.append((time_s, [""] * (len(header) - 2)))
        table[-1][1][column:column + len(values)] = [
            f"{value:.9g}" if math.isfinite(value) else "" for value in values]
    return csv_text([tuple(header), *((utc(time_s), f"{time_s:.3f}", *values)
                                      for time_s, values in table)])
