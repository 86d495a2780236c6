"""What is chosen does not hang on the last bits of sums, on threads or on the hash seed."""

import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import eha_monitor as em
from eha_monitor import ties
from eha_monitor.mismatch.likelihood import fit as likelihood
from eha_monitor.mismatch.likelihood.gains import Unknowns
from eha_monitor.mismatch.name import proposals
from eha_monitor.mismatch.name.columns import ALWAYS, Column
from eha_monitor.mismatch.name.gram import Gram
from eha_monitor.mismatch.name.rank import best_over, ranked_at
from eha_monitor.mismatch.name.starts import Start
from eha_monitor.mismatch.policy import POLICY
from eha_monitor.physics.effects import CATALOGUE

ROOT = Path(__file__).parents[1]
ULPS = 1e-15  # relative: a few units in the last place
SUSPECTS = ("coulomb_friction", "pressure_friction", "added_mass", "constant_load")


# ---- the rule ----


def test_of_equals_the_plainest_is_chosen_and_else_the_best():
    scores = {"long name": 7.0, "b": 7.0 - 1e-12, "a": 7.0 + 1e-12, "c": 6.9}
    assert ties.best(scores, scores.get, len) == "b"  # two are as short: the first
    assert ties.best(scores, scores.get, str) == "a"
    assert ties.ordered(scores, scores.get, str) == ["a", "b", "long name", "c"]
    assert ties.ordered(scores, scores.get, str, within=0.5) == ["a", "b", "c", "long name"]
    assert ties.best(["x", "y"], {"x": 1.0, "y": 1.1}.get) == "y"


def test_nan_is_the_lowest_and_nothing_is_an_error():
    scores = {"a": np.nan, "b": -np.inf, "c": -1e300}
    assert ties.ordered(scores, scores.get) == ["c", "a", "b"]
    assert ties.largest([np.nan, 2.0, 2.0]) == 1 and ties.largest([-np.inf, -np.inf]) == 0
    with pytest.raises(IndexError):
        ties.best([], float)


@given(st.lists(st.integers(-5, 5), min_size=1, max_size=12), st.randoms(use_true_random=False))
def test_order_stands_under_the_last_bits_and_another_sequence(levels, random):
    """Equal scores that a sum's last bits part, in any sequence: the order is that of the key."""
    exact = {f"n{i}": 1e3 + level for i, level in enumerate(levels)}
    wanted = sorted(exact, key=lambda name: (-exact[name], name))
    names = list(exact)
    random.shuffle(names)
    moved = {name: exact[name] * (1.0 + ULPS * random.uniform(-1.0, 1.0)) for name in names}
    assert ties.ordered(moved, moved.get, str) == wanted
    assert ties.best(moved, moved.get, str) == wanted[0]
    sizes = [exact[f"n{i}"] * (1.0 + ULPS * random.uniform(-1, 1)) for i in range(len(levels))]
    assert ties.largest(sizes) == levels.index(max(levels))


# ---- the ranking ----


def ranking(order, moved=0.0, seed=0):
    """Return the names of the sets that are ranked, with their evidence; two columns are equal.

    ``order`` of the samples in the sums, ``moved`` relative change of every product.
    """
    rng = np.random.default_rng(1)
    d, r = rng.standard_normal((60, 4)), rng.standard_normal(60)
    d[:, 3] = d[:, 2]  # in one direction of motion dry friction is a constant load
    r = r - 3.0 * d[:, 2] + 2.0 * d[:, 1]
    what = (Column(ALWAYS, -1, "B"), *(
        Column(name, 0, f"{name}.F", size=True, start=Start(name, ()))
        for name in ("spring_load", "coulomb_friction", "constant_load")))
    whole = np.column_stack([r, d])[order]
    products = whole.T @ whole
    noise = 1.0 + moved * np.random.default_rng(seed).uniform(-1.0, 1.0, products.shape)
    grams = [Gram(Unknowns(1.0, 1.0, 1.0), products * np.sqrt(noise * noise.T) * factor,
                  np.array([60.0]), 0.0) for factor in (1.0, 1.0)]  # levels that are equal, too
    found = best_over(ranked_at(what, (), grams, POLICY))
    return [[sorted(one.names), f"{one.evidence:.6g}"] for one in found]


def test_ranking_with_exact_ties_is_one_under_any_order_of_the_sums():
    plain = ranking(np.arange(60))
    assert plain[0][0] == ["constant_load", "spring_load"]  # by name: as likely, as common
    assert plain[1][0] == ["coulomb_friction", "spring_load"] and plain[1][1] == plain[0][1]
    for seed in range(20):
        order = np.random.default_rng(seed).permutation(60)
        assert ranking(order, ULPS, seed) == plain


# ---- the answer ----


def recording():
    """Return a second of motion with dry friction, read by the healthy config."""
    sine = {"kind": "sine", "amplitude": "20 mm", "frequency": "1 Hz", "duration": "1 s"}
    return em.simulate(em.Config(effects={"coulomb_friction": {"F_c": "40 N"}},
                                 simulation={"excitation": {"sine": sine}}), seed=1)


def told(given) -> dict:
    """Return names, order and printed figures of a diagnosis among a few suspects."""
    d = em.diagnose(given, em.Config(),
                    without=[name for name in CATALOGUE if name not in SUSPECTS])
    return json.loads(json.dumps({
        "verdict": d.verdict, "effects": [effect.statement for effect in d.effects],
        "rivals": [effect.indistinguishable_from for effect in d.effects],
        "considered": d.to_frame("considered").index.tolist(),
        "after": [f"{d.after[name].value:.3g}" for name in ("B", "beta_e")]}, default=list))


@pytest.fixture(scope="module")
def plain():
    return told(recording())


def test_answer_stands_under_the_last_bits_of_the_inputs(plain):
    assert plain["verdict"] == "mismatch"
    given, rng = recording(), np.random.default_rng(3)
    moved = {name: values * (1.0 + ULPS * rng.uniform(-1.0, 1.0, len(values)))
             for name, values in given.channels.items()}
    assert any((moved[name] != given.channels[name]).any() for name in moved)
    assert told(replace(given, channels=moved)) == plain


def test_answer_stands_under_more_threads_and_other_sums(plain, monkeypatch):
    rng = np.random.default_rng(4)
    grams_of, products = proposals.grams_of, []

    def otherwise(*arguments):
        found = []
        for gram in grams_of(*arguments):
            noise = 1.0 + ULPS * rng.uniform(-1.0, 1.0, gram.products.shape)
            found.append(replace(gram, products=gram.products * np.sqrt(noise * noise.T)))
        products.extend(found)
        return found

    with ThreadPoolExecutor(5, "mismatch") as pool:
        monkeypatch.setattr(likelihood, "workers", lambda: pool)
        monkeypatch.setattr(proposals, "grams_of", otherwise)
        assert told(recording()) == plain
    assert products


def test_answer_is_that_of_another_process(plain):
    """Sets are walked by the hash of their members, and BLAS adds as the processor does."""
    run = subprocess.run(
        [sys.executable, "-c", "import json, test_ties as t; print(json.dumps(t.told("
         "t.recording())))"], cwd=ROOT, capture_output=True, text=True, timeout=100,
        env={**os.environ, "PYTHONHASHSEED": "1", "OPENBLAS_CORETYPE": "Prescott",
             "PYTHONPATH": f"{ROOT / 'test'}{os.pathsep}{ROOT}"})
    assert run.returncode == 0, run.stderr
    assert json.loads(run.stdout.splitlines()[-1]) == plain
