"""What a recording's channels show about how they were configured."""

from dataclasses import dataclass, field
from typing import Any, Literal

Kind = Literal["swapped", "sign", "unit", "offset", "hold"]


@dataclass(frozen=True)
class ChannelFinding:
    """One thing that the channels of a recording say about their configuration.

    Attributes
    ----------
    finding : a sentence with its evidence in numbers.
    kind : ``swapped``, ``sign``, ``unit``, ``offset`` or ``hold``.
    channels : the channels, or keys of the rig, that it concerns.
    correction : fragment of a config that mends it, by section; empty where no key does.
    """

    finding: str
    kind: Kind
    channels: tuple[str, ...]
    correction: dict[str, Any] = field(default_factory=dict)
