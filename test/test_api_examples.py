"""The examples of the Python interface's docstrings run, in the order of the reference."""

import dataclasses
import doctest
import inspect
import json
import multiprocessing
import os
import pickle
import re
from pathlib import Path

import numpy as np
import pytest

import eha_monitor as em

ROOT = Path(__file__).parents[1]
OPTIONS = doctest.NORMALIZE_WHITESPACE | doctest.IGNORE_EXCEPTION_DETAIL


def documented(name: str) -> list[tuple[str, str]]:
    """Return a public name and, of a record, its own methods, each with its docstring."""
    found = getattr(em, name)
    shown = [(name, inspect.getdoc(found) or "")]
    if inspect.isclass(found):
        shown += [(f"{name}.{part}", inspect.getdoc(getattr(found, part)) or "")
                  for part in vars(found) if not part.startswith("_")
                  and part not in getattr(found, "__dataclass_fields__", ())]
    return shown


@pytest.fixture(scope="module")
def examples():
    """What the examples leave behind (``r``, ``e``, ``d``, ``a``), and what failed in them."""
    before = os.getcwd()
    os.chdir(ROOT)
    try:
        return run_all()
    finally:
        os.chdir(before)


def run_all() -> tuple[dict, dict[str, tuple[int, int, str]]]:
    scope, outcome, parser = {"em": em}, {}, doctest.DocTestParser()
    for name in em.__all__:
        for place, text in documented(name):
            one = parser.get_doctest(text, {}, place, None, 0)
            if not one.examples:
                continue
            one.globs = scope  # not a copy: an example goes on from the one before
            said: list[str] = []
            result = doctest.DocTestRunner(optionflags=OPTIONS).run(
                one, out=said.append, clear_globs=False)
            outcome[place] = (result.failed, result.attempted, "".join(said))
    return scope, outcome


def test_the_examples_of_the_docstrings_run(examples):
    _, outcome = examples
    assert not {place: said for place, (failed, _, said) in outcome.items() if failed}
    functions = {name for name in em.__all__ if inspect.isfunction(getattr(em, name))}
    assert functions | {"Config", "Recording"} <= set(outcome)
    assert sum(attempted for _, attempted, _ in outcome.values()) > 25


def test_every_public_name_says_what_it_takes_gives_and_raises():
    for name in em.__all__:
        for place, text in documented(name):
            assert text, place
            part = getattr(em, place.partition(".")[0])
            for step in place.split(".")[1:]:
                part = inspect.getattr_static(part, step)
            part = part.__func__ if isinstance(part, classmethod) else part
            if not inspect.isfunction(part):
                continue
            signature = inspect.signature(part)
            takes = [one for one in signature.parameters if one not in ("self", "cls")]
            if place.endswith((".of", ".instead", ".with_traceback", ".add_note")):
                continue  # for the rooms of this package
            assert bool(takes) == ("Parameters\n---" in text), place
            assert ("Returns\n---" in text) == (signature.return_annotation is not None), place
            for one in takes:
                assert one in text[text.index("Parameters\n---"):], f"{place}: {one}"


def diagnosed(seed: int) -> str:
    """Return the verdict on a short simulation, of a catalogue of two."""
    from eha_monitor.physics.effects import CATALOGUE

    sine = {"kind": "sine", "amplitude": "20 mm", "frequency": "1 Hz", "duration": "1 s"}
    recording = em.simulate(em.Config(simulation={"excitation": {"sine": sine}}), seed=seed)
    return em.diagnose(recording, without=[
        name for name in CATALOGUE if name not in ("coulomb_friction", "added_mass")]).verdict


def test_a_forked_process_diagnoses_after_its_parent_has(examples):
    """The parent's threads are not there after a fork; a diagnosis that waits for one hangs."""
    with multiprocessing.get_context("fork").Pool(1) as pool:
        assert pool.apply_async(diagnosed, (1,)).get(timeout=80) == "consistent"


def test_a_diagnosis_is_frozen_pickled_shown_and_drawn(examples, tmp_path):
    d = examples[0]["d"]
    twin = pickle.loads(pickle.dumps(d))
    assert twin.to_dict() == d.to_dict()
    json.dumps(d.to_dict(), allow_nan=False)
    for one in (d, twin):
        with pytest.raises(dataclasses.FrozenInstanceError):
            one.effects[0].size = "none"
        with pytest.raises(TypeError, match="cannot be changed"):
            one.after["B"] = None
        with pytest.raises(ValueError, match="read-only"):
            one.curves[0].measured[0] = 0.0
    assert "Coulomb friction" in d._repr_html_() and "±" in d._repr_html_()
    for what in ("missing", "fit", "B", "beta_e"):
        assert d.plot(what)._repr_png_()[0].startswith(b"\x89PNG")
    line = d.plot().axes[0].get_lines()[-1]  # of the model: ± 40 N
    assert abs(np.nanmax(np.abs(line.get_ydata())) - 40.0) < 1.0
    with pytest.raises(em.InputError, match="what: expected one of missing, fit, B, beta_e"):
        d.plot("everything")
    for table in ("effects", "values", "rig_data", "changes", "parameters", "fit", "considered",
                  "curves"):
        assert len(d.to_frame(table).columns) > 1, table
    assert set(d.to_frame("fit")["unit"]) == {"m", "Pa", "rad/s", "N"}
    assert d.report(tmp_path / "why.html").stat().st_size > 10_000
    rig = d.completed()
    assert rig.rig.viscous_damping == pytest.approx(600.0, abs=5.0)
    assert rig.effects["coulomb_friction"]["F_c"] == pytest.approx(40.0, abs=0.5)


def test_a_rig_that_turns_is_answered_in_radians_and_newton_metres():
    from eha_monitor.physics.effects import CATALOGUE

    sine = {"kind": "sine", "amplitude": 0.02, "frequency": 1.0, "duration": 2.0}
    turning = em.Config(rig={"motion": "rotary"})
    d = em.diagnose(em.simulate(turning.changed(
        effects={"coulomb_friction": {"F_c": 40.0}}, simulation={"excitation": {"sine": sine}}),
        seed=1), turning, without=[name for name in CATALOGUE if name != "coulomb_friction"])
    assert "40.1 N·m" in d.effects[0].statement and d.effects[0].size == "40.1 N·m"
    friction = d.effects[0].parameters["F_c"]
    assert friction.unit == "N·m" and abs(friction.value - 40.0) < 3.0 * friction.stddev
    assert d.after["B"].unit == "N·m·s/rad"
    assert set(d.to_frame("fit")["unit"]) == {"rad", "Pa", "rad/s", "N·m"}
    linear = re.compile(r"[0-9] [kMmµ]?(N|kg|m|N·s/m|N/m|m/s)(?![\w·/²])")
    assert not linear.search(json.dumps(d.to_dict(), ensure_ascii=False))


def test_advice_is_frozen_shown_and_drawn(examples):
    a = examples[0]["a"]
    assert pickle.loads(pickle.dumps(a)).to_dict() == a.to_dict()
    assert a.sentences and all(sentence in a._repr_html_() for sentence in a.sentences
                               if "<" not in sentence and "'" not in sentence)
    time, x_d = a.plot().axes[0].get_lines()[0].get_data()
    motion = a.motion.segments["sine"]
    assert abs(x_d).max() == pytest.approx(1e3 * (motion.amplitude + abs(motion.offset)), rel=0.02)
    assert time.max() == pytest.approx(a.motion.duration, rel=0.01)
    excited = em.simulate(a.excitation(), duration=0.5)
    assert abs(excited.channels["x_d"]).max() == pytest.approx(abs(x_d).max() * 1e-3, rel=0.02)
    for table in ("visible_from", "parameters", "doubts", "considered"):
        assert len(a.to_frame(table)), table
    assert "correlation" in a.to_frame("confusions").columns  # also where there is none
