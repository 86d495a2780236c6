"""How large a number can be and still be a measurement, channel by channel.

Far beyond any sensor, and beyond any mistake of unit that is worth naming (micrometres for metres,
bar for pascals a second time, rpm for rad/s), so that such recordings are read and the mistake is
told.  What lies further out is no measurement: a damaged message, or a simulation that ran away.
A few such values are left out and told; a channel that goes there and stays is refused, because
what it showed on the way there is no measurement either.
"""

import numpy as np

from eha_monitor.errors import InputError

# Channel -> largest absolute value and its unit.
LIMITS = {"x": (1e9, "m"), "v": (1e9, "m/s"), "x_d": (1e9, "m"), "omega": (1e9, "rad/s"),
          "omega_d": (1e9, "rad/s"), "p1": (1e13, "Pa"), "p2": (1e13, "Pa"),
          "force": (1e12, "N"), "temperature": (1e6, "°C")}
LARGEST = {name: largest for name, (largest, _) in LIMITS.items()}
FEW = 3  # samples in a row, or in all, that a channel may spend out there at its end
SHARE = 0.01  # of a channel's numbers


def within_limits(name: str, values: np.ndarray, time: np.ndarray, source: str
                  ) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return a channel with NaN for what is no measurement, and sentences about it.

    Parameters
    ----------
    name : channel; one that has no limit is only freed of infinities.
    values : (n,) SI, NaN where nothing was measured.
    time : (n,) s, for the sentences.
    source : file (and topic), for errors.

    Raises
    ------
    InputError
        If the channel ran away: it went beyond the limit and did not come back, or is there for
        more than 1 % of its numbers.
    """
    limit, unit = LIMITS.get(name, (np.inf, ""))
    finite = min(limit, np.finfo(float).max)
    if np.fmax.reduce(values, initial=0.0) <= finite and (
            np.fmin.reduce(values, initial=0.0) >= -finite):
        return values, ()
    infinite = np.isinf(values)
    beyond = (np.abs(values) > limit) & ~infinite
    said = []
    if infinite.any():
        said.append(f"{name}: {int(infinite.sum())} of {len(values)} values are infinite, "
                    "left out")
    if beyond.any():
        first = int(np.argmax(beyond))
        where = (f"{values[first]:.3g} {unit} at t = {time[first]:.3f} s, beyond ±{limit:.0e} "
                 f"{unit}")
        numbers = np.flatnonzero(np.isfinite(values))
        good = numbers[~beyond[numbers]]
        after = int(np.sum(numbers > good[-1])) if len(good) else len(numbers)
        if after > FEW or beyond.sum() > max(FEW, SHARE * len(numbers)):
            raise InputError(
                f"{source}: {name} is out of range: {where}, as {int(beyond.sum())} of its "
                f"{len(numbers)} numbers are; expected a measurement in SI")
        said.append(f"{name}: {int(beyond.sum())} of {len(values)} values are not valid "
                    f"measurements ({where}), left out")
    return np.where(infinite | beyond, np.nan, values), tuple(said)
