"""Which further recording would narrow the answer, and roughly by how much: from Gram matrices.

A term's column is odd or even in the direction of motion and grows with a power of the speed, so
that the products of a recording in the other direction, or at another speed, follow from those at
hand: G' = T G T with T = diag(+-1) or diag(s^power).  Beside G they narrow a parameter by
sqrt((G^-1)_ii / ((G + G')^-1)_ii); the same motion once more narrows it by the root of 2.
"""

from collections.abc import Sequence

import numpy as np

from eha_monitor.balances.candidates import BASE, WATCHED
from eha_monitor.balances.least_squares import inverse_of
from eha_monitor.balances.machine import Machine
from eha_monitor.balances.model import Model, Term
from eha_monitor.balances.table import pooled_table
from eha_monitor.quantity import number, quantity, share
from eha_monitor.words import effect_words, listed

WORTH = 2.0  # times narrower: a recording that is worth the trouble
FASTER = 2.0  # times the speed
FAR = 100.0  # times narrower: what is not determined at all
AGAIN = ("record the same machine again, with another load, another speed and on another day, and "
         "diagnose all together: what one recording supports is not always there on another day")
STIFF = ("βe is not stated: in this motion the oil takes up too little of the flow, beside "
         "leakage and channels that may be late; quicker reversals, or a pressure that changes "
         "more, show it")


def advice_of(models: Sequence[Model], machine: Machine | None) -> tuple[str, ...]:
    """Return what to record next, the most useful first, and what to do about rivals."""
    gains: dict[str, list[tuple[float, str]]] = {}
    for model in models:
        for words, by in narrowed(model).items():
            if by:
                gains.setdefault(words, []).extend((f, t.candidate.words) for t, f in by[:2])
    said = []
    for words, terms in sorted(gains.items(), key=lambda one: -max(one[1])[0]):
        best = sorted(terms, reverse=True)[:3]
        said.append(f"a recording {words} would " + listed([
            f"determine the {what}" if factor > FAR else
            f"narrow the {what} about {number(factor, 2)} times" for factor, what in best]))
    said = said[:2]
    named = {t.candidate.effect: t for model in models for t in model.named}
    for name, term in named.items():
        if term.rivals:
            others = listed([effect_words(r) for r in term.rivals], "or")
            said.append(f"{effect_words(name)} is indistinguishable from {others} in these "
                        "recordings")
    varied = machine.load_varied if machine is not None else False
    if not varied and any(t.candidate.family == "dry" for t in named.values()):
        said.append("vary the load between recordings: without it, friction that grows with "
                    "pressure cannot be separated from dry friction")
    if machine is not None and (shows := least_change(machine)):
        said.append(f"{shows}; more healthy recordings narrow it")
    return (*((AGAIN,) if machine is None else ()), *said)


def least_change(machine: Machine) -> str:
    """Return from which size on a change of the machine's own numbers shows, as a sentence."""
    found, none = [], []
    for one in machine.balances:
        for p in one.parameters:
            by = [scatter.shows[p.name] for scatter in (one.scatter, one.beside)
                  if p.name in scatter.shows]
            if p.name in WATCHED and by and machine.policy.sure(p.value, p.stddev):
                least = min(by)
                if least > abs(p.value) and p.name in BASE:  # they differ by more than it is
                    none.append(effect_words(p.effect))
                    continue
                found.append(f"{effect_words(p.effect)} " + (
                    share(least / abs(p.value), 2) if p.name == "C_h" else
                    quantity(least, p.unit, 2)))
    return "; ".join([
        *([f"beside {machine.runs} a change shows from: {', '.join(found)}"] if found else []),
        *([f"{machine.runs} differ too much to show any change of {listed(none)}"]
          if none else [])])


def narrowed(model: Model) -> dict[str, list[tuple[Term, float]]]:
    """Return for each further recording the terms that it would narrow, the most first."""
    terms = [t for t in model.terms if not t.each]
    whole = pooled_table(model.tables)
    names = [t.candidate.name if t.candidate.name in whole.places else "F_0 1" for t in terms]
    # What the data do not separate has no place among the terms, but is what a motion would.
    rivals = [one for one in whole.candidates if one.effect in {
        r for t in model.named for r in t.rivals}]
    rivals = list({one.effect: one for one in reversed(rivals)}.values())
    kinds = [t.candidate for t in terms] + rivals
    places = [whole.places[name] for name in (*names, *(one.name for one in rivals))]
    gram = whole.gram[np.ix_(places, places)]
    size = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    gram = gram / np.outer(size, size)
    now = np.diag(inverse_of(gram))
    direction = np.array([1.0 if one.odd else -1.0 for one in kinds])
    speed = FASTER ** np.array([one.power for one in kinds])
    found = {}
    for words, by in (("in the other direction", direction),
                      (f"at {FASTER:g} times the speed", speed)):
        then = np.diag(inverse_of(gram + gram * np.outer(by, by)))
        with np.errstate(invalid="ignore"):
            factor = np.where(np.isinf(now) & np.isfinite(then), np.inf, np.sqrt(now / then))
        rows = [(term, float(one)) for term, one in zip(terms, factor, strict=False)
                if one > WORTH and (term.named or term.candidate.always)]
        found[words] = sorted(rows, key=lambda row: -row[1])
    return found
