"""Names, lists and probabilities as people say them."""

import math

PARAMETER_WORDS = {"B": "viscous damping", "beta_e": "effective bulk modulus", "L": "leakage"}


def effect_words(name: str) -> str:
    """Return the name of an effect as people say it: ``Coulomb friction``."""
    words = name.replace("_", " ")
    words = words.replace("one sided", "one-sided")
    for person in ("coulomb", "stribeck"):
        words = words.replace(person, person.capitalize())
    return words


def listed(words: list[str] | tuple[str, ...], last: str = "and") -> str:
    """Return ``a, b and c``."""
    if len(words) < 2:
        return "".join(words)
    return f"{', '.join(words[:-1])} {last} {words[-1]}"


def odds(log_evidence: float) -> str:
    """Return a likelihood ratio, given by its natural logarithm (0 or more), as odds.

    >>> odds(0.0), odds(1.9), odds(2310.0)
    ('odds of 1 to 1', 'odds of 7 to 1', 'odds beyond 10 000 to 1')
    """
    if log_evidence > math.log(1e4):
        return "odds beyond 10 000 to 1"
    return f"odds of {float(f'{math.exp(log_evidence):.2g}'):.0f} to 1"


def probability(share_of_one: float) -> str:
    """Return a probability in per cent; nothing is certain, so never 0 or 100.

    >>> probability(0.9999), probability(0.97), probability(0.0)
    ('>99 %', '97 %', '<1 %')
    """
    if not math.isfinite(share_of_one):
        return "—"
    whole = round(100 * min(max(share_of_one, 0.0), 1.0))
    return ">99 %" if whole == 100 else "<1 %" if whole == 0 else f"{whole} %"
