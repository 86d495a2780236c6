"""Config section of ``import``: which column of a CSV or MAT file is which channel."""

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field

from eha_monitor.settings.measured import Measured, unit_of
from eha_monitor.settings.section import Section
from eha_monitor.units import Si

CHANNEL_NAMES = ("x", "v", "x_d", "omega", "omega_d", "p1", "p2", "force", "temperature")


def _name(value):
    """Take an index as text, so that a column is always named in one way."""
    return str(value) if isinstance(value, int) and not isinstance(value, bool) else value


class Column(Section, Measured):
    """One column of a table: scale * cell + offset is in ``unit``, taken ``delay`` earlier."""

    column: Annotated[str, BeforeValidator(_name)] = Field(
        min_length=1, description="CSV: name or index from 0; MAT: variable, or variable[:,k]")
    unit: str = Field("", description="unit of the cells, such as mm, rpm, bar, bar gauge; "
                      "empty: SI")
    scale: float = Field(1.0, allow_inf_nan=False, description="of unit, per unit of the file")
    offset: float = Field(0.0, allow_inf_nan=False, description="in unit, at zero of the file")
    negative_scale: float | None = Field(
        None, allow_inf_nan=False, description="scale of cells below zero, if different: a pump "
                                               "whose valves switch it from one piston area to "
                                               "the other")
    delay: Si("s", "delay of the row relative to the quantity") = 0.0

    @property
    def negative_gain(self) -> float:
        """SI units per unit of the file, of cells below zero."""
        if self.negative_scale is None:
            return self.gain
        return unit_of(self.unit).factor * self.negative_scale


class Table(Section):
    """A table of a recording, as other makers write it."""

    kind: Literal["auto", "csv", "mat"] = Field(
        "auto", description="auto: from the file extension")
    delimiter: Literal["auto", ",", ";", "tab", "space"] = Field(
        "auto", description="between the cells of a CSV")
    header: Literal["auto", "present", "absent"] = Field(
        "auto", description="whether the first row of a CSV names the columns")
    skip_rows: int = Field(0, ge=0, le=100_000,
                           description="lines of a CSV above the row of names")
    time: Annotated[str, BeforeValidator(_name)] = Field(
        "", description="column of the time; without it, rows are rig.sample_time apart")
    time_scale: Si("s", "seconds per unit of the time column", gt=0) = 1.0
    columns: dict[Literal[CHANNEL_NAMES], Column] = Field(
        {}, description="channel <- column, by channel")
