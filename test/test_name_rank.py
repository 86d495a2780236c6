"""The evidence of sets against the density of a linear model, computed outright."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from eha_monitor.mismatch.likelihood.gains import Unknowns
from eha_monitor.mismatch.name.candidates import candidate
from eha_monitor.mismatch.name.columns import ALWAYS, ASTRAY_OWNER, Column
from eha_monitor.mismatch.name.gram import Gram, extended
from eha_monitor.mismatch.name.rank import Level, Member, Ranking, best_over, ranked_at
from eha_monitor.mismatch.name.starts import Start
from eha_monitor.mismatch.policy import POLICY
from eha_monitor.physics.effects import CATALOGUE

N, LOGDET = 40, 3.7
LOAD, SPRING, SQUARE = (Member(name, 0) for name in (
    "constant_load", "spring_load", "quadratic_friction"))
NAMELESS = Member("force of x", 0)


class Linear:
    """Innovations ``r`` and columns ``d`` (N, m) of a linear model, and what is ranked of them."""

    def __init__(self, what, named=(), seed=0, size=1.0):
        rng = np.random.default_rng(seed)
        self.what = tuple(what)
        self.d = size * rng.standard_normal((N, len(self.what)))
        self.r = rng.standard_normal(N)
        self.named = named
        self.ranking = Ranking(self.what, named, POLICY)

    @property
    def gram(self):
        """In two channels, as the filter's are: only their sum counts."""
        whole = np.column_stack([self.r, self.d])
        parts = [whole[: N // 3], whole[N // 3 :]]
        return Gram(Unknowns(1.0, 1.0, 1.0), sum(part.T @ part for part in parts),
                    np.array([N // 3, N - N // 3], dtype=float), LOGDET)

    @property
    def level(self):
        return Level(self.ranking, self.gram)

    def density(self, members) -> float:
        """Log of the probability of the innovations, amplitudes integrated out; no odds.

        A model that has an effect and a set that has not: the effect's size goes to the mean of
        its prior, which is none of it.
        """
        r = self.r.copy()
        for i, column in enumerate(self.what):
            if column.variant < 0 and column.owner in self.named and column.size and not any(
                    member.owner == column.owner for member in members):
                r = r + self.d[:, i] * column.centre
        here = [i for i, column in enumerate(self.what) if column.owner == ALWAYS or any(
            (column.owner, column.variant) == (m.owner, m.variant) for m in members)]
        d, mean = self.d[:, here], np.array([self.what[i].centre for i in here])
        law = multivariate_normal(-d @ mean, np.eye(N) + d @ d.T)
        return float(law.logpdf(r)) + 0.5 * N * np.log(2.0 * np.pi) - LOGDET


def column(owner, name="", variant=0, **more):
    start = Start(owner, ()) if owner in CATALOGUE else None
    return Column(owner, variant, name or f"{owner}.F", size=True, start=start, **more)


def always(name="B", **more):
    return Column(ALWAYS, -1, name, **more)


def usual(**more) -> Linear:
    """B and beta_e, three effects, one of two sizes, and an unknown function of four hats."""
    return Linear([always(), always("beta_e", centre=0.4), column("constant_load"),
                   column("spring_load", "spring_load.k"), column("spring_load", "spring_load.c"),
                   column("quadratic_friction"), *[column("force of x") for _ in range(4)]],
                  **more)


SETS = [(), (LOAD,), (SPRING,), (LOAD, SPRING), (NAMELESS,), (LOAD, NAMELESS, SQUARE)]


@pytest.mark.parametrize("members", SETS, ids=lambda members: "+".join(m.owner for m in members))
def test_evidence_is_the_density_of_the_innovations_and_the_odds(members):
    model = usual()
    found = model.level.evaluated(members)
    odds = sum(POLICY.unnamed if m.owner not in CATALOGUE else
               POLICY.effect + POLICY.rare * CATALOGUE[m.owner].rarity for m in members)
    assert found.prior == pytest.approx(odds)
    assert found.evidence == pytest.approx(model.density(members) + odds, abs=1e-9)
    assert found.names == {m.owner for m in members}


def test_a_column_that_runs_away_under_a_level_says_nothing_and_stops_nothing():
    model = usual()
    gram = model.gram
    products = gram.products.copy()
    place = 1 + model.ranking.groups[LOAD][0]
    products[place], products[:, place] = np.inf, np.inf
    level = Level(model.ranking, replace(gram, products=products))
    assert level.evaluated((SPRING,)).evidence == pytest.approx(
        model.level.evaluated((SPRING,)).evidence)
    assert level.evaluated((LOAD,)).evidence == pytest.approx(
        level.evaluated(()).evidence + POLICY.effect
        + POLICY.rare * CATALOGUE["constant_load"].rarity)


@pytest.mark.parametrize("astray", [(2,), (2, 3)])
def test_an_effect_of_the_model_whose_column_runs_away_stays_in_every_set(astray):
    """An asymmetric friction stood so near to a negative damping that a step of it ran away."""
    owner = "asymmetric_friction"
    what = [always(), always("beta_e"), column(owner, f"{owner}.F_c", -1),
            column(owner, f"{owner}.dB", -1), column("spring_load", "spring_load.k")]
    what = [replace(c, owner=ASTRAY_OWNER) if i in astray else c for i, c in enumerate(what)]
    model = Linear(what, named=(owner,))
    (found,) = ranked_at(model.what, model.named, [model.gram], POLICY)
    assert len(found) == 2
    assert all(Member(owner, -1) in one.members for one in found)


def test_amplitudes_are_the_most_likely_ones():
    model = usual()
    found = model.level.evaluated((LOAD, SPRING))
    here = sorted(found.amplitudes)
    d, mean = model.d[:, here], np.array([model.what[i].centre for i in here])
    stacked = np.vstack([d, np.eye(len(here))])
    wanted = np.linalg.lstsq(stacked, np.concatenate([-model.r, mean]), rcond=None)[0]
    assert [found.amplitudes[i] for i in here] == pytest.approx(list(wanted))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("named", [(), ("constant_load",)])
def test_what_a_suspect_gains_is_what_evaluating_its_set_outright_gives(seed, named):
    """The Schur complement in place of another solve, for one column and for several."""
    model = with_load(seed) if named else usual(seed=seed, size=0.4)
    base = tuple(Member(name, -1) for name in named)
    for members in (base, (*base, SQUARE)):
        one = model.level.evaluated(members)
        gains = dict(model.level.gains(one))
        assert SPRING in gains and NAMELESS in gains
        for member, gain in gains.items():
            whole = model.level.evaluated((*members, member))
            assert one.evidence + gain == pytest.approx(whole.evidence, abs=1e-8), member


def with_load(seed=0) -> Linear:
    """A model that has a constant load already, three prior deviations of it."""
    return Linear([always(), column("constant_load", variant=-1, centre=-3.0),
                   column("spring_load"), column("quadratic_friction"),
                   *[column("force of x") for _ in range(3)]], ("constant_load",), seed, 0.4)


def test_a_set_without_what_the_model_has_is_ranked_as_if_it_had_never_had_it():
    model = with_load()
    kept, spring = Member("constant_load", -1), Member("spring_load", 0)
    for members in ((), (kept,), (spring,), (kept, spring)):
        found = model.level.evaluated(members)
        assert found.evidence - found.prior == pytest.approx(model.density(members), abs=1e-9)
    assert set(model.ranking.roots()) == {(), (kept,)}


def test_of_several_starts_each_has_its_share_of_the_odds():
    model = Linear([always(), *[column("coulomb_friction", variant=v) for v in range(3)]])
    own = model.ranking.log_prior(Member("coulomb_friction", 2))
    rarity = CATALOGUE["coulomb_friction"].rarity
    assert own == pytest.approx(POLICY.effect + POLICY.rare * rarity - np.log(3.0))
    assert model.ranking.log_prior(Member("rig.mass", 0)) == POLICY.effect


def test_a_size_with_the_wrong_sign_rules_a_set_out():
    model = Linear([always(), column("quadratic_friction", lower=0.0), column("constant_load")])
    model.r = model.r + 20.0 * model.d[:, 1]  # asks for -20 of it
    assert model.level.evaluated((SQUARE,)) is None
    assert model.level.evaluated((LOAD,)) is not None  # a load pushes either way
    model.r = model.r - 40.0 * model.d[:, 1]
    assert model.level.evaluated((SQUARE,)).amplitudes[1] > 15.0


def test_a_number_of_the_rig_stays_at_its_tolerance_unless_it_is_wrong():
    """Held at the bound it counts as a number that was known to be there."""
    within = always("rig.mass", lower=-3.0, upper=3.0)
    model = Linear([always(), within, column("rig.mass", "rig.mass")])
    model.d[:, 2] = 20.0 * model.d[:, 1]
    model.r = model.r - 30.0 * model.d[:, 1]
    held = model.level.evaluated(())
    assert held.amplitudes[1] == 3.0
    moved = model.r + 3.0 * model.d[:, 1]
    b = model.d[:, :1]
    law = multivariate_normal(np.zeros(N), np.eye(N) + b @ b.T)
    wanted = law.logpdf(moved) + 0.5 * N * np.log(2 * np.pi) - LOGDET - 0.5 * 3.0**2
    assert held.evidence == pytest.approx(float(wanted), abs=1e-9)
    wrong = model.level.evaluated((Member("rig.mass", 0),))
    assert wrong.amplitudes[1] + 20.0 * wrong.amplitudes[2] == pytest.approx(30.0, rel=0.05)
    assert wrong.evidence > held.evidence + 100.0


def test_no_set_holds_two_of_a_kind():
    ranking = Linear([always(), column("constant_load"), column("constant_load", variant=1),
                   column("spring_load"), column("coulomb_friction"), column("stribeck_friction"),
                   column("force of x"), column("flow of v"), column("rig.mass", "rig.mass"),
                   column("added_mass")]).ranking

    def fits(members, other):
        return ranking.joining(members)[ranking.order[other]]

    assert fits((LOAD,), SPRING) and not fits((LOAD,), Member("constant_load", 1))
    assert not fits((Member("coulomb_friction", 0),), Member("stribeck_friction", 0))
    assert not fits((NAMELESS,), Member("flow of v", 0))  # one unknown function at a time
    assert fits((NAMELESS,), LOAD) and fits((NAMELESS,), Member("rig.mass", 0))
    assert candidate("added_mass").equals == "rig.mass"
    assert candidate("rig.mass").equals == "added_mass" and not candidate("rig.area_1").equals
    assert not fits((Member("added_mass", 0),), Member("rig.mass", 0))


def test_what_grows_out_of_an_effect_needs_it_and_takes_its_place():
    ranking = Linear([always(), column("coulomb_friction", variant=-1, centre=-2.0),
                      Column("stribeck_friction", 100, "stribeck_friction.F_s", size=True,
                             start=Start("stribeck_friction", (), "coulomb_friction"))],
                     ("coulomb_friction",), size=0.3).ranking
    has = Member("coulomb_friction", -1)
    grown = Member("stribeck_friction", 100, "coulomb_friction")
    place = ranking.order[grown]
    assert ranking.joining((has,))[place] and not ranking.joining(())[place]
    found = ranked_at(ranking.what, ranking.named, [Linear(
        ranking.what, ranking.named, size=0.3).gram], POLICY)[0]
    assert {one.names for one in found} == {
        frozenset(), frozenset({"coulomb_friction"}), frozenset({"stribeck_friction"})}


@given(st.integers(0, 10**6), st.floats(0.05, 3.0))
@hypothesis_settings(max_examples=25)
def test_the_beam_finds_the_best_of_all_sets_where_it_can_hold_them_all(seed, size):
    model = usual(seed=seed, size=size)
    (found,) = ranked_at(model.what, (), [model.gram], POLICY)
    assert [one.evidence for one in found] == sorted(
        (one.evidence for one in found), reverse=True)
    members = (LOAD, SPRING, SQUARE, NAMELESS)
    every = [model.level.evaluated(tuple(sorted(some, key=lambda m: m.owner)))
             for k in range(5) for some in combinations(members, k)]
    assert found[0].evidence == pytest.approx(max(one.evidence for one in every))


def test_over_levels_each_set_stands_at_the_one_that_suits_it():
    quiet, loud = usual(seed=1), usual(seed=2)
    levels = ranked_at(quiet.what, (), [quiet.gram, loud.gram], POLICY)
    best = best_over(levels)
    for one in best:
        assert one.evidence == max(other.evidence for level in levels for other in level
                                   if other.members == one.members)
    assert len({one.members for one in best}) == len(best)


def test_copies_of_columns_are_as_good_as_the_columns_themselves():
    model = usual()
    whole = np.column_stack([model.r, model.d])
    more = np.column_stack([whole, 20.0 * whole[:, 3], -2.0 * whole[:, 1]])
    plain = Gram(Unknowns(1.0, 1.0, 1.0), whole.T @ whole, np.array([1.0 * N]), 0.0)
    assert extended(plain, [(3, 20.0), (1, -2.0)]).products == pytest.approx(more.T @ more)
    assert extended(plain, ()) is plain
