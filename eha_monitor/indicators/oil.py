"""The viscosity of mineral oil against its temperature."""

import math

KELVIN = 273.15
EXPANSION = 7e-4  # 1/K, of mineral oil; MIL-H-5606 has 8.3e-4 (docs/health.md)


def walther(at_40: float, at_100: float, temperature: float) -> float:
    """Return the kinematic viscosity in mm²/s at ``temperature`` in °C.

    log log (nu + 0.7) = A - B log T, T in K (Walther 1931; ASTM D341, there for 2 mm²/s and
    more), through the two points that every data sheet prints.

    Parameters
    ----------
    at_40, at_100 : kinematic viscosity at 40 and at 100 °C, mm²/s; the first is the larger.
    temperature : °C.
    """
    def height(viscosity: float) -> float:
        return math.log(math.log(viscosity + 0.7))

    def place(celsius: float) -> float:
        return math.log(KELVIN + celsius)

    slope = (height(at_40) - height(at_100)) / (place(100.0) - place(40.0))
    inner = height(at_40) - slope * (place(temperature) - place(40.0))
    return math.exp(math.exp(inner)) - 0.7


def viscosity_ratio(temperature: float, reference: float, coefficient: float,
                    at_40: float | None = None, at_100: float | None = None) -> float:
    """Return the dynamic viscosity at ``reference`` over that at ``temperature``, both in °C.

    With the two kinematic viscosities of the data sheet by Walther's law, times the density,
    which falls by ``EXPANSION``; without them by the Reynolds law exp(-k T), k = ``coefficient``
    in 1/K.  The result is finite for any sensor reading.
    """
    warmer = temperature - reference
    if at_40 is None or at_100 is None:
        return math.exp(min(max(coefficient * warmer, -50.0), 50.0))
    cold, hot = -40.0, 200.0  # where oil is a liquid; ends of ASTM's charts
    there, here = (min(max(one, cold), hot) for one in (reference, temperature))
    density = (1.0 - EXPANSION * (there - 40.0)) / (1.0 - EXPANSION * (here - 40.0))
    return density * walther(at_40, at_100, there) / walther(at_40, at_100, here)
