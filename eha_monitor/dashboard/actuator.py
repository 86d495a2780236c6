"""The actuator as a drawing: a cylinder whose piston stands where it is.

The drawing itself is sent once.  The piston follows two CSS variables, so that the browser moves
it smoothly between two positions.
"""

import math
from html import escape

from eha_monitor.quantity import readable

# Drawing units: the barrel, and how far the piston goes to either side of its middle.
WIDTH, HEIGHT = 640, 150
_LEFT, _RIGHT, _TOP, _BOTTOM = 130, 510, 30, 100
_MIDDLE, _REACH = 0.5 * (_LEFT + _RIGHT), 150.0
_PISTON, _ROD = 24, 14
_LEAST = 1e-3


def half_range(positions: list[float]) -> float:
    """Return the position at the end of the scale: the next 1, 2 or 5 above what is shown, SI.

    >>> half_range([0.0312, -0.0399]), half_range([])
    (0.05, 0.001)
    """
    largest = max((abs(x) for x in positions if math.isfinite(x)), default=0.0)
    largest = max(largest, _LEAST)
    power = 10.0 ** math.floor(math.log10(largest * (1 - 1e-9)))
    return next(float(f"{step * power:.3g}") for step in (1, 2, 5, 10)
                if step * power >= largest * (1 - 1e-9))


def place(position: float, half: float) -> float:
    """Return how far the piston stands from the middle, in drawing units, inside the barrel."""
    if not math.isfinite(position):
        return 0.0
    return round(_REACH * max(-1.1, min(1.1, position / half)), 1)


def drawing(half: float, unit: str) -> str:
    """Return the SVG for a scale of ±``half`` (SI)."""
    scale = readable(half, unit)
    end = f"{half * scale.factor:g} {scale.unit}"
    tall = _BOTTOM - _TOP
    marks = "".join(
        f'<line x1="{x}" x2="{x}" y1="{_BOTTOM + 5}" y2="{_BOTTOM + 13}"/>'
        f'<text x="{x}" y="{_BOTTOM + 34}">{escape(text)}</text>'
        for x, text in ((_MIDDLE - _REACH, f"−{end}"), (_MIDDLE, "0"), (_MIDDLE + _REACH, end)))
    rod = f'x="-400" width="800" y="{_TOP + tall / 2 - _ROD / 2}" height="{_ROD}"'
    body = f'x="{_MIDDLE - _PISTON / 2}" width="{_PISTON}" y="{_TOP}" height="{tall}"'
    return f"""
<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img"
     aria-label="The actuator: the piston where it is measured, dashed where it is estimated">
  <defs><clipPath id="barrel">
    <rect x="{_LEFT}" y="{_TOP}" width="{_RIGHT - _LEFT}" height="{tall}"/></clipPath></defs>
  <rect class="chamber-2" x="{_LEFT}" y="{_TOP}" width="{_RIGHT - _LEFT}" height="{tall}"/>
  <g clip-path="url(#barrel)"><rect class="chamber-1 moves" x="{_MIDDLE - 1000}" y="{_TOP}"
     width="1000" height="{tall}"/></g>
  <g class="moves"><rect class="rod" transform="translate({_MIDDLE} 0)" {rod}/>
     <rect class="piston" {body}/></g>
  <rect class="barrel" x="{_LEFT}" y="{_TOP}" width="{_RIGHT - _LEFT}" height="{tall}"/>
  <rect class="estimated moves-estimated" x="{_MIDDLE - _PISTON / 2}" width="{_PISTON}"
        y="{_TOP - 9}" height="{tall + 18}"/>
  <g class="scale">{marks}</g>
</svg>"""
