"""Whatever stands in a config: settings, or one line that names the key.  Nothing else."""

import math
import re
from pathlib import Path

import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from pydantic import BaseModel

from eha_monitor.errors import InputError
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.reports.diagnosis_words import tolerance_words
from eha_monitor.settings import Settings, load_settings, settings_from_tree
from eha_monitor.settings.load import ROS_PARAMETERS, annotated
from eha_monitor.settings.monitor import CHANNELS
from eha_monitor.settings.rig import TOLERATED, Tolerance

QUICK = settings(max_examples=250)
SCALARS = st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=12),
                    st.dates(), st.binary(max_size=4), st.sampled_from(
                        ["5 cm^2", "1 m", "-1 m", "nan", "-inf", "1e400", "1 lightyear", "1e6",
                         "0x10", "$HOME", "!!python/object:os.system", "1 kg/", "**", "°C", "1/0",
                         "20 kg", "1 ms", "0.25 Hz", "50 °C", "1e400 kg", "sine", "a\nb", "{",
                         "x" * 500]))


def leaves(model: type[BaseModel], path=()):
    """Yield the path of every key, sections too."""
    for key, field in model.model_fields.items():
        yield (*path, key)
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            yield from leaves(field.annotation, (*path, key))


PATHS = st.sampled_from(sorted(leaves(Settings)))
KEYS = sorted({*Settings.model_fields, *CHANNELS, *CATALOGUE, *(
    path[-1] for path in leaves(Settings)), "F_c", "v_e", "L", "alpha", "triangle", "kind",
    "ros__parameters", "/**", ""})
TREES = st.recursive(SCALARS, lambda inner: st.one_of(
    st.lists(inner, max_size=3), st.dictionaries(st.one_of(
        st.text(max_size=8), st.integers(), st.sampled_from(KEYS)), inner, max_size=4)),
    max_leaves=12)


def tree_of(path, value):
    for key in reversed(path):
        value = {key: value}
    return value


def told(problem: InputError) -> str:
    text = str(problem)
    assert "\n" not in text and 12 < len(text) < 700, text
    return text


@QUICK
@given(path=PATHS, value=TREES)
def test_a_value_is_taken_or_its_key_is_named(path, value):
    assume(ROS_PARAMETERS not in repr(value))  # below it path[0] is the name of a node
    try:
        found = settings_from_tree(tree_of(path, value), "rig.yaml")
    except InputError as problem:
        text = told(problem)
        assert text.startswith("rig.yaml: ")
        # What a section demands of its keys together is told with the section.
        assert path[0] in text, text
    else:
        kept = value_at(found, path)
        assert not isinstance(kept, float) or math.isfinite(kept)


@QUICK
@given(tree=TREES | st.dictionaries(st.sampled_from(sorted(Settings.model_fields)), TREES,
                                    max_size=3))
def test_any_tree(tree):
    try:
        assert isinstance(settings_from_tree(tree, "rig.yaml"), Settings)
    except InputError as problem:
        assert told(problem).startswith("rig.yaml: ")


@QUICK
@given(content=st.one_of(st.binary(max_size=60), st.text(max_size=60).map(
    lambda text: text.encode("utf-8", "surrogatepass")), st.lists(st.sampled_from(
        ["rig:", "\n", "  ", "- ", "{", "}", "[", "&a ", "*a", "? ", "|\n", "mass: ", "2", "'",
         "!", "<<: ", "2026-01-01", "0o9", ".inf", "%YAML 9.9\n", "---\n", "effects: "]),
        max_size=12).map(lambda parts: "".join(parts).encode())))
@example(content=b"rig:\n%YAML 0.0\n")  # KeyError: (0, 0)
@example(content=b"%YAML 1.3\n---\n2")  # AssertionError
def test_any_file(content, tmp_path):
    path = tmp_path / "rig.yaml"
    path.write_bytes(content)
    try:
        assert isinstance(load_settings(path), Settings)
    except InputError as problem:
        assert told(problem).startswith(f"{path}: ")


def value_at(config: Settings, path):
    for key in path:
        config = getattr(config, key)
    return config


NUMBERS = sorted(path for path in leaves(Settings)
                 if isinstance(value_at(Settings(), path), float))


def test_every_tolerance_is_drawn_and_is_of_a_number_of_the_rig():
    drawn = {path[-1] for path in NUMBERS if path[:2] == ("rig", "tolerance")}
    assert drawn == {*TOLERATED, "effects"}
    assert {("rig", key) for key in TOLERATED} <= set(NUMBERS)
    for key in TOLERATED:
        assert 0.0 < Tolerance().log_spread(key) < 2.0


def test_docs_name_every_tolerance_and_its_default():
    text = (Path(__file__).parents[1] / "docs" / "diagnosis.md").read_text(encoding="utf-8")
    for key in TOLERATED:
        shown = tolerance_words(Tolerance(), key).removeprefix("± ")
        assert re.search(rf"^\|[^|]*`{key}`[^|]*\| {shown} \|", text, re.MULTILINE), key


@settings(max_examples=25)
@given(data=st.data())
def test_what_is_valid_survives_being_written(data, tmp_path):
    config = Settings()
    for path in data.draw(st.lists(st.sampled_from(NUMBERS), min_size=1, max_size=5)):
        before = value_at(config, path)
        value = before * data.draw(st.floats(0.5, 2.0))
        whole = config.model_dump()
        place = whole
        for key in path[:-1]:
            place = place[key]
        place[path[-1]] = value
        try:
            config = settings_from_tree(whole, "t")
        except InputError:
            continue
        assert value_at(config, path) == pytest.approx(value, rel=1e-12)
    copy = tmp_path / "copy.yaml"
    copy.write_text(annotated(config), encoding="utf-8")
    assert load_settings(copy) == config
