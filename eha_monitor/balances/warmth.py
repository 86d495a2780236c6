"""Damping and leakage of a machine at the temperature of the next recording's oil.

B goes with the oil's viscosity nu, laminar leakage L with its inverse (Merritt 1967).  Where every
recording measures the temperature,

    ln B_i = a + s ln nu_i + e_i,    s ~ N(1, LAW^2),    and ln L_i with s ~ N(-1, LAW^2),

says what a healthy machine has at another temperature: s by the config's law of viscosity, whose
coefficient nobody has measured for this oil, and more surely from references that were recorded at
several temperatures.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from eha_monitor.balances.course import Course
from eha_monitor.balances.machine import Machine, MachineBalance
from eha_monitor.balances.scatter import t_of_next

# Numbers that go with the viscosity, and with which power of it.
POWERS = {"B": 1.0, "L": -1.0}
LAW = 0.3  # spread of s: coefficients of hydraulic oils between 0.02 and 0.05 per kelvin


@dataclass(frozen=True)
class AtOil:
    """What a healthy machine has at the viscosity of the next recording.

    Attributes
    ----------
    value : of the healthy number, with what the config has of it, SI.
    spread : of its logarithm from one healthy recording to the next, at one temperature.
    law : standard deviation of the logarithm because s is not known.
    noise : usual deviation of a reference's logarithm by chance; it is in the spread.
    freedom : samples less parameters behind the spread.
    more : what the config has of the number, SI.
    """

    value: float
    spread: float
    law: float
    noise: float
    freedom: float
    more: float = 0.0

    @property
    def beyond(self) -> float:
        """The healthy number beyond what the config has of it, SI."""
        return self.value - self.more

    @property
    def stddev(self) -> float:
        """Of a healthy recording's number at this temperature, SI."""
        return self.value * float(np.linalg.norm((self.spread, self.law, self.noise)))

    def t_of(self, value: float, chance: float, share: float) -> tuple[float, float]:
        """Return Student's t of a recording's number beside the healthy one, and its limit.

        Parameters
        ----------
        chance : standard deviation of ``value`` by noise alone.
        share : of healthy recordings that may be beyond the limit.
        """
        return t_of_next(float(np.log(value / self.value)), self.spread, self.freedom + 1.0, share,
                         (chance / value, self.noise), self.law)


def healthy_at(machine: Machine, viscosity: float, name: str = "B") -> AtOil | None:
    """Return a healthy number of ``POWERS`` at a viscosity; None where no recording says it.

    Parameters
    ----------
    viscosity : of the recording's oil, as :attr:`Machine.viscosity`; NaN where not measured.
    """
    rows, law = machine.of_references(name), POWERS[name]
    more = machine.known_leakage if name == "L" else 0.0
    if machine.pieces or not machine.viscosity or not np.isfinite(viscosity) or len(rows) != 1:
        return None
    each, deviation = rows[0][0] + more, rows[0][1]
    if len(each) < 2 or not (each > 0.0).all():
        return None
    u = np.log(machine.viscosity)
    u, mean, y, noise = u - u.mean(), float(u.mean()), np.log(each), float(
        np.median(deviation / each))
    square, cross = float(u @ u), float(u @ (y - y.mean()))
    best = cross / square if square > 0.0 else law
    left = y - y.mean() - best * u
    variance = max(float(left @ left) / max(len(y) - 2, 1), noise**2, 1e-12)
    weight = square / variance / (square / variance + LAW**-2)  # of what the references say of s
    s = law + weight * (best - law)
    left = y - y.mean() - s * u
    freedom = max(len(y) - 1.0 - weight, 1.0)
    step = float(np.log(viscosity)) - mean
    return AtOil(float(np.exp(y.mean() + s * step)), float(np.sqrt(left @ left / freedom)),
                 LAW * float(np.sqrt(1.0 - weight)) * abs(step), noise, freedom, more)


def viscosity_of(courses: Sequence[Course]) -> float:
    """Return the viscosity of the oil of recordings of one state; NaN where not measured."""
    return float(np.mean([course.viscosity for course in courses]))


def at_oil(machine: Machine, viscosity: float) -> tuple[MachineBalance, ...]:
    """Return the machine's balances with the damping and the leakage of a recording's oil."""
    there = {name: at for name in POWERS if (at := healthy_at(machine, viscosity, name))}
    return tuple(replace(one, parameters=tuple(
        replace(p, value=there[p.name].beyond, between=max(p.between, there[p.name].stddev))
        if p.name in there else p for p in one.parameters)) for one in machine.balances)
