"""By how much every term would move in one recording, and how that scatters over healthy ones.

With the machine's parameters held and the settings' fitted, what is left of a recording's balance
is r; a term with column q would move by d = q'r / q'q if it alone did, both without what the
settings explain.  Over the machine's own recordings d has a mean and a spread, whatever makes it
vary (wear from day to day, temperature, the form of other terms).  That spread, not the sensors'
noise, is what a change is measured against: Student's t with n - 1 degrees of freedom, so that one
healthy recording in a hundred is called changed in any of the terms.

The machine's parameters w are off by some e, whose covariance C = FF' their fit gives, and with
them every d by -R e, R = q'X / q'q of the parameters' columns X, in all recordings of one duty
alike: no scatter shows it.  Another duty has another R, and what it moves by more than the mean of
the machine's own recordings does is in doubt by (R - mean R) F.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import stdtrit

from eha_monitor.balances.least_squares import weights_of
from eha_monitor.balances.policy import Policy
from eha_monitor.balances.table import Table
from eha_monitor.balances.together import without

NOTHING: Mapping = {}
ANSWERS = 0.01  # of the usual power: a recording that answers less says nothing of a term


@dataclass(frozen=True)
class Amplitudes:
    """By how much each term of a recording would move if it alone did.

    Attributes
    ----------
    names : (k,) terms; ``value`` (k,) SI, ``stddev`` (k,) of the recording's own noise.
    power : (k,) squares of the columns, less what the settings explain.
    response : (k, k) by how much the value of each falls where another moves by one.
    left : squares of the residual.
    common : (k, e) by how much each falls with each independent error of the machine's parameters.
    """

    names: tuple[str, ...]
    value: np.ndarray
    stddev: np.ndarray
    power: np.ndarray
    response: np.ndarray
    left: float
    common: np.ndarray

    def gone_with(self, oil: Mapping[str, float], most: float, i: int | None = None,
                  mean: float = 0.0) -> tuple[float, float]:
        """Return by how much a term has moved beside the oil, and the squares gone with both.

        Parameters
        ----------
        oil : parameters that move by ``most`` of their spreads.
        i : place of the term; without it the oil moves alone.
        mean : amplitude of healthy recordings.
        """
        more = [self.names.index(name) for name in oil
                if name in self.names and (i is None or name != self.names[i])]
        own = more if i is None else [i, *more]
        if not own:
            return 0.0, 0.0
        inner, side = self.response[np.ix_(own, own)] * self.power[own, None], (
            self.value * self.power)[own]
        if i is not None and not (np.isfinite(inner).all() and inner[0, 0] > 0.0):
            return float(self.value[i] - mean), -np.inf
        w = weights_of(inner, side)
        limit = most * np.array([oil[self.names[j]] for j in more])
        w[len(own) - len(more) :] = np.clip(w[len(own) - len(more) :], -limit, limit)
        if i is not None:
            w[0] = (side[0] - inner[0, 1:] @ w[1:]) / inner[0, 0] - mean
        return float(w[0]), float(2.0 * w @ side - w @ inner @ w)

    def moved(self, place: int, amount: float) -> "Amplitudes":
        """Return what is left once a term has moved."""
        left = self.left - (2.0 * self.value[place] - amount) * amount * self.power[place]
        return replace(self, value=self.value - self.response[:, place] * amount,
                       left=max(left, 0.0))


def amplitudes_of(table: Table, weights: dict[str, float], settings: Sequence[str],
                  terms: Sequence[str], oil: Mapping[str, float] = NOTHING,
                  errors: Mapping[str, np.ndarray] = NOTHING) -> Amplitudes:
    """Return the amplitudes of ``terms`` beside a machine's parameters (name -> value).

    Parameters
    ----------
    oil : parameter -> its spread from one recording to the next, SI, within which it is free:
        else a term that resembles damping moves whenever the oil is warmer.
    errors : parameter -> (e,) how far it goes with each independent error of the machine's fit.
    """
    out = [table.places[name] for name in (*settings, *oil)]
    kept = [table.places[name] for name in terms]
    count = 1 + len(kept)
    ways = len(next(iter(errors.values()), ()))
    rows = np.zeros((count + ways, len(table.gram)))
    rows[0, 0] = 1.0
    for name, value in weights.items():
        rows[0, table.places[name]] = -value
    rows[np.arange(1, count), kept] = 1.0
    for name, off in errors.items():
        if name in table.places:
            rows[count:, table.places[name]] = off
    known = len(rows)
    for_settings = np.zeros((len(out), len(table.gram)))
    for_settings[np.arange(len(out)), out] = 1.0
    rows = np.vstack([rows, for_settings])
    ridge = np.zeros(len(rows))
    ridge[len(rows) - len(oil) :] = ridge_of(table, oil)
    products = without(rows @ table.gram @ rows.T, list(range(known)),
                       list(range(known, len(rows))), ridge)
    own = np.maximum(np.diag(products)[1:count], 1e-300)
    dead = own < 1e-12 * np.maximum(np.diag(table.gram)[kept], 1e-300)
    power = np.where(dead, np.nan, own)
    rms, correlated = table.full  # what no term explains
    return Amplitudes(tuple(terms), products[1:count, 0] / power,
                      rms * np.sqrt(correlated / power), power,
                      products[1:count, 1:count] / power[:, None],
                      max(float(products[0, 0]), 0.0), products[1:count, count:] / power[:, None])


def ridge_of(table: Table, oil: Mapping[str, float]) -> np.ndarray:
    """Return what holds each parameter to its spread, in squares of the residual per SI^2."""
    rms, correlated = table.full
    return rms**2 * correlated / np.square(np.fromiter(oil.values(), float, len(oil)))


@dataclass(frozen=True)
class Scatter:
    """How the amplitudes of terms vary over the recordings of a machine.

    Attributes
    ----------
    names : (k,) terms that every recording answers to, or of the machine's own some.
    mean, spread, power, noise : (k,) over the recordings; of their power and deviation the
        median.
    common : (k, e) mean of :attr:`Amplitudes.common`; empty in older files.
    limit : (k,) of Student's t: beyond it a recording is changed.
    runs : recordings.
    """

    names: tuple[str, ...]
    mean: tuple[float, ...]
    spread: tuple[float, ...]
    power: tuple[float, ...]
    noise: tuple[float, ...]
    limit: tuple[float, ...]
    runs: int
    common: tuple[tuple[float, ...], ...] = ()

    def only(self, names: Sequence[str]) -> "Scatter":
        """Return it for some of its terms, in their order."""
        places = [self.names.index(name) for name in names]
        return Scatter(tuple(names), *(tuple(row[i] for i in places) for row in (
            self.mean, self.spread, self.power, self.noise, self.limit)), self.runs,
            tuple(self.common[i] for i in places) if self.common else ())

    @property
    def shows(self) -> dict[str, float]:
        """By how much each term has to move to be beyond its limit, SI."""
        spread = np.array(self.spread) * np.sqrt(1.0 + 1.0 / self.runs)
        return dict(zip(self.names, np.array(self.limit) * spread, strict=True))

    def owed(self, found: Amplitudes) -> np.ndarray:
        """Return how far a recording's amplitudes go with the machine's errors, (k,) SI.

        Beyond what those of its own recordings do.
        """
        if not (self.common and found.common.size):
            return np.zeros(len(self.names))
        places = [found.names.index(name) for name in self.names]
        return np.linalg.norm(found.common[places] - np.array(self.common), axis=1)

    def t_of(self, found: Amplitudes) -> np.ndarray:
        """Return Student's t of a recording's amplitudes, (k,); NaN where it says nothing."""
        places = [found.names.index(name) for name in self.names]
        value, power, own = found.value[places], found.power[places], found.stddev[places]
        more = np.maximum(own**2 - np.square(self.noise), 0.0)
        weight = np.sqrt(np.minimum(power, self.power) / np.array(self.power))
        return weight * (value - self.mean) / np.sqrt(
            np.square(self.spread) * (1.0 + 1.0 / self.runs) + more + self.owed(found) ** 2)


def scatter_of(tables: Sequence[Table], weights: dict[str, float], settings: Sequence[str],
               allowed: Sequence[str], policy: Policy, oil: Mapping[str, float] = NOTHING,
               typical: bool = False, errors: Mapping[str, np.ndarray] = NOTHING) -> Scatter:
    """Return how the amplitudes of terms vary over recordings.

    Parameters
    ----------
    oil, errors : as :func:`amplitudes_of` takes them.
    typical : the recordings are parts of too few: a typical spread between recordings is added.
    """
    of = {one.name: one for one in tables[0].candidates}
    terms = [name for name in allowed if name not in settings
             and not (of[name].always and of[name].setting)]
    each = [amplitudes_of(table, weights, settings, terms, oil, errors) for table in tables]
    values, powers, noise = (np.array([getattr(one, name) for one in each])
                             for name in ("value", "power", "stddev"))
    usual = np.median(np.nan_to_num(powers), axis=0)
    answers = np.isfinite(values) & (powers > ANSWERS * usual)
    # What the machine has it keeps, where some recordings do not come so far as a tool.
    enough = answers.all(axis=0) | ([name in weights for name in terms] & (
        answers.sum(axis=0) >= policy.fewest))
    kept = np.flatnonzero(enough & (np.ptp(values, axis=0) > 0.0))
    answers, usual, noise = answers[:, kept], usual[kept], noise[:, kept]
    values, powers = (np.where(answers, rows[:, kept], 0.0) for rows in (values, powers))
    weight = np.minimum(powers, usual) / usual
    common = np.einsum("rk,rke->ke", weight / weight.sum(axis=0), np.nan_to_num(
        [one.common[kept] for one in each]))
    names = tuple(terms[i] for i in kept)
    between = np.array([policy.between if of[name].between is None else of[name].between
                        for name in names])
    size = np.array([abs(weights.get(name, 0.0)) for name in names])
    extra = typical * between * np.maximum(size, np.abs(values.mean(axis=0)) if len(
        values) else 0.0)

    def made(rows: np.ndarray, power: np.ndarray, limit: np.ndarray) -> Scatter:
        weight = np.minimum(power, usual) / usual
        mean = (weight * rows).sum(axis=0) / weight.sum(axis=0)
        spread = np.sqrt((weight * (rows - mean) ** 2).sum(axis=0) / (
            (power > 0.0).sum(axis=0) - 1) + extra**2)
        return Scatter(names, *(tuple(part.tolist()) for part in (
            mean, np.maximum(spread, 1e-150), usual, np.nanmedian(noise, axis=0), limit)),
            len(rows), tuple(map(tuple, common.tolist())))

    products = sum(one.response * one.power[:, None] for one in each)[np.ix_(kept, kept)]
    limit = np.array([limit_of(runs, _different(products), policy.false)
                      for runs in answers.sum(axis=0).tolist()])
    if len(tables) > 3:  # what a healthy recording did once, one may do again
        own = [np.abs(made(np.delete(values, i, axis=0), np.delete(powers, i, axis=0), limit)
                      .t_of(Amplitudes(names, values[i], noise[i], powers[i], np.zeros((0, 0)),
                                       0.0, common))) for i in range(len(tables))]
        limit = np.maximum(limit, np.nanmax(own, axis=0))
    return made(values, powers, limit)


def t_of_next(off: float, spread: float, runs: float, share: float,
              noise: tuple[float, float] = (0.0, 0.0), more: float = 0.0) -> tuple[float, float]:
    """Return Student's t of one further number beside those of the references, and its limit.

    Parameters
    ----------
    off : from their mean; ``spread`` between them, of ``runs``.
    share : of healthy recordings that may be beyond the limit.
    noise : by chance, of this recording and of a usual reference, whose is in the spread.
    more : standard deviation of what their mean stands for.
    """
    own, usual = noise
    t = off / np.sqrt(spread**2 * (1.0 + 1.0 / runs) + max(own**2 - usual**2, 0.0) + more**2)
    return float(t), limit_of(runs, 1.0, share)


def _different(products: np.ndarray) -> float:
    """Return how many of the columns are different ones: (sum l)^2 / sum l^2, l eigenvalues."""
    scale = np.sqrt(np.maximum(np.diag(products), 1e-300))
    eigen = np.linalg.eigvalsh(products / np.outer(scale, scale))
    return float(eigen.sum() ** 2 / max((eigen**2).sum(), 1e-300)) if len(eigen) else 1.0


def limit_of(runs: float, count: float, share: float) -> float:
    """Return the |t| beyond which one of ``count`` terms goes in a share of healthy runs."""
    return float(-stdtrit(runs - 1, 0.5 * share / count))
