"""Config section of ``import``: which column of a CSV or MAT file is which channel."""

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field

from eha_monitor.settings.section import Section
from eha_monitor.units import Si

CHANNEL_NAMES = ("x", "v", "x_d", "omega", "omega_d", "p1", "p2", "force", "temperature")


def _name(value):
    """Take an index as text, so that a column is always named in one way."""
    return str(value) if isinstance(value, int) and not isinstance(value, bool) else value


class Column(Section):
    """One column of a table: SI value = scale * cell + offset, taken ``delay`` earlier."""

    column: Annotated[str, BeforeValidator(_name)] = Field(
        min_length=1, description="CSV: name or index from 0; MAT: variable, or variable[:,k]")
    scale: float = Field(1.0, allow_inf_nan=False, description="SI units per unit of the file")
    offset: float = Field(0.0, allow_inf_nan=False, description="SI value at zero of the file")
    negative_scale: float | None = Field(
        None, allow_inf_nan=False, description="scale of cells below zero, where it is another: "
        "a pump whose valves turn it from one area of the piston to the other")
    delay: Si("s", "how late the row is against the quantity") = 0.0


class Table(Section):
    """A table of a recording, as other makers write it."""

    kind: Literal["auto", "csv", "mat"] = Field(
        "auto", description="auto: by the end of the file's name")
    delimiter: Literal["auto", ",", ";", "tab", "space"] = Field(
        "auto", description="between the cells of a CSV")
    header: Literal["auto", "present", "absent"] = Field(
        "auto", description="whether the first row of a CSV names the columns")
    time: Annotated[str, BeforeValidator(_name)] = Field(
        "", description="column of the time; without it, rows follow at rig.sample_time")
    time_scale: Si("s", "seconds per unit of the time column", gt=0) = 1.0
    columns: dict[Literal[CHANNEL_NAMES], Column] = Field(
        {}, description="channel <- column, by channel")
