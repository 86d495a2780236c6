"""`thresholds`: limits from healthy recordings, and what they imply."""

import json
import re

import numpy as np
import pytest
from command_tools import refused
from hypothesis import given, settings
from hypothesis import strategies as st

from eha_monitor.api.estimate import series_of
from eha_monitor.cli import main
from eha_monitor.estimation.pipeline import estimate
from eha_monitor.estimation.results import ParameterEstimate
from eha_monitor.health.alarms import ParameterSeries, judge_series
from eha_monitor.health.proposal import Healthy, healthy_of, implied, proposed, thresholds_tree
from eha_monitor.recordings.read import read_recording
from eha_monitor.settings import Settings, load_settings, settings_from_tree

RATE = 0.05
TRUTH = (570, 590, 600, 612, 630)


@pytest.fixture(scope="module")
def bags(tmp_path_factory):
    """Return five healthy bags of 3 s and one of a machine with double damping."""
    folder = tmp_path_factory.mktemp("healthy")
    made = []
    for place, damping in enumerate((*TRUTH, 1200)):
        config = folder / f"{place}.yaml"
        config.write_text(f"rig: {{viscous_damping: {damping}}}\n")
        bag = folder / f"bag_{place}"
        assert main(["simulate", "--out", str(bag), "--config", str(config), "--seed", str(place),
                     "--duration", "3"]) == 0
        made.append(str(bag))
    return made


def drawn(values, noise=1e-3):
    return [Healthy(str(k), v, noise * v, v, v) for k, v in enumerate(values)]


def test_five_recordings(bags, tmp_path, capsys):
    config, answer = tmp_path / "judged.yaml", tmp_path / "a.json"
    assert main(["thresholds", "--from", *bags[:5], "--write-config", str(config), "--json",
                 str(answer)]) == 0
    out = capsys.readouterr().out
    limits = load_settings(config).thresholds.viscous_damping
    # By hand: mean and Student's t of the logarithms, 4 degrees of freedom.
    logs = np.log(TRUTH)
    reach = 3.747 * logs.std(ddof=1) * np.sqrt(1.2)  # one-sided 1 %
    assert limits.low_warn == pytest.approx(min(np.exp(logs.mean() - reach), 540), rel=0.01)
    assert limits.high_warn == pytest.approx(np.exp(logs.mean() + reach), rel=0.01)
    assert re.search(r"B: 5 recordings, mean 600(\.\d)? N·s/m", out)
    tree = json.loads(answer.read_text())
    rates = {one["key"]: one["rate"] for one in tree["proposals"]["B"]["limits"]}
    assert rates["low_warn"] == pytest.approx(0.01, rel=0.01)
    assert rates["low_error"] == pytest.approx(0.001, rel=0.01)
    # None of the healthy ones raises an alarm with what they propose; the worn one does.
    assert main(["estimate", bags[0], "--config", str(config), "--exit-code"]) == 0
    assert main(["estimate", bags[5], "--config", str(config), "--exit-code"]) == 1


def test_a_recording_unlike_the_others_is_named(bags, capsys):
    assert main(["thresholds", "--from", *bags]) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert re.search(r"bag_5: B differs from the other recordings", out)
    assert not re.search(r"bag_[0-4]: B differs from", out)


def test_one_recording_says_what_it_cannot_know(bags, tmp_path, capsys):
    config = tmp_path / "one.yaml"
    assert main(["thresholds", "--from", bags[2], "--write-config", str(config)]) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "one recording does not show how much healthy recordings differ" in out
    assert "not known" in out
    limits = load_settings(config).thresholds.viscous_damping
    assert limits.high_warn == pytest.approx(1000, rel=0.01)


def test_what_was_given_is_not_asked_for_again():
    """Five were given, of which B stands in one, in three, in five."""
    from eha_monitor.commands.thresholds import _sentences
    from eha_monitor.health.proposal import Healthy, proposed

    def said(count):
        some = [Healthy(f"{k}", 600.0 + k, 1.0, 601.0 + k, 599.0 + k) for k in range(count)]
        return " ".join(_sentences([proposed("B", some, 0.01, 0.1)], [], 10.0, 5))

    assert "4 of the 5 recordings were left out (above)" in said(1)
    assert "3 recordings are few for reliable limits; 2 of the 5 were left out (above)" in said(3)
    for count in (1, 3, 5):
        assert "ecord four more" not in said(count) and "record 5" not in said(count)


def test_recordings_of_which_none_says_anything_are_one_short_line(bags, tmp_path, capsys):
    config = tmp_path / "bare.yaml"
    config.write_text("rig: {area_1: null, area_2: null}\n")
    assert main(["thresholds", "--from", *bags[:4], "--config", str(config)]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and len(err) < 500
    assert err.count("B is left out") == 1 and "all 4: B is left out" in err


def test_two_recordings_are_wide_and_say_so(bags, tmp_path, capsys):
    written = tmp_path / "judged.yaml"
    assert main(["thresholds", "--from", *bags[:2], "--rate", "0.01", "--write-config",
                 str(written)]) == 0
    out = capsys.readouterr().out
    plain = " ".join(out.split())
    said = re.search(r"B: no ([\w, ]+), which would be more than a factor of 3", plain)
    assert re.findall(r"\w+_(?:warn|error)", said[1]) == re.findall(r"^B (\w+) +none", out, re.M)
    limits = load_settings(written).thresholds.viscous_damping
    for key, value, factor in re.findall(r"^B (\w+) +(none|[\d.]+) .*?([\d.]+) +[\d.]+ ?%", out,
                                         re.M):
        assert (getattr(limits, key) is None) == (value == "none")
        assert (value == "none") != (1 / 3 < float(factor) < 3)
    assert limits.high_error is None  # t is 318 at 0.1 % with one degree of freedom


def test_dry_friction_needs_the_diagnosed_model(bags, tmp_path, capsys):
    config = tmp_path / "dry.yaml"
    config.write_text("effects: {coulomb_friction: {F_c: 40}}\n")
    bag = tmp_path / "dry"
    assert main(["simulate", "--out", str(bag), "--config", str(config), "--duration", "4"]) == 0
    capsys.readouterr()
    assert main(["thresholds", "--from", *bags[:3], str(bag)]) == 0
    out = capsys.readouterr().out
    assert "model does not fit 1 of 4 recordings" in out
    assert "no --config: the rig's values are those of the paper" in out
    assert f"  eha-monitor diagnose {bag} --write-config diagnosed.yaml\n" in out
    again = re.search(r"^  eha-monitor (thresholds .* --config diagnosed.yaml .*)$", out, re.M)
    assert again, out
    assert main(["thresholds", "--from", str(bag)]) == 2  # and nothing else to go by
    err = capsys.readouterr().err
    assert f"`eha-monitor diagnose {bag} --write-config diagnosed.yaml` finds" in err
    assert f"`eha-monitor thresholds --from {bag} --config diagnosed.yaml" in err
    assert f"what needs no limits: `eha-monitor diagnose NOW --reference {bag}`" in err
    # What diagnose would write: the second command then has nothing to say against the model.
    words = again[1].replace("diagnosed.yaml", str(config)).replace("judged.yaml", str(
        tmp_path / "judged.yaml")).split()
    assert main([*words[:2], str(bag), *words[words.index("--config"):]]) == 0
    out = capsys.readouterr().out
    assert "does not fit" not in out
    assert "no --config" not in out
    # Diagnosed already, and it still does not fit: not the same advice in a circle.
    config.write_text("rig: {identified: viscous_damping}\n")
    assert main(["thresholds", "--from", *bags[:3], str(bag), "--config", str(config)]) == 0
    out = capsys.readouterr().out
    assert f"{bag}: B is left out" in out
    assert "--write-config diagnosed.yaml" not in out
    assert f" {bag} --config DRAFT.yaml\n" in out
    limits = load_settings(tmp_path / "judged.yaml").thresholds.viscous_damping
    assert limits.high_warn == pytest.approx(1000, rel=0.02)  # the paper's, scaled to B = 600


@pytest.mark.parametrize(("words", "said"), [
    (["--from", "nowhere"], "no such bag"),
    (["--from", "BAG", "BAG"], "is given twice"),
    (["--from", "BAG", "--rate", "0.9"], "--rate"),
    ([], "--from"),
])
def test_bad_usage_is_one_line(bags, capsys, words, said):
    assert said in refused(capsys, "thresholds",
                           *(bags[0] if word == "BAG" else word for word in words))


def test_a_null_limit_stays_null_in_a_written_config(tmp_path):
    from eha_monitor.settings.load import annotated

    nothing = {"low_error": None, "low_warn": None}
    given = settings_from_tree({"thresholds": {"bulk_modulus": nothing}}, "a")
    file = tmp_path / "a.yaml"
    file.write_text(annotated(given), encoding="utf-8")
    assert load_settings(file).thresholds == given.thresholds


@pytest.mark.parametrize("count", [2, 3, 10])
@pytest.mark.parametrize("log", [False, True])
def test_the_stated_rate_holds(count, log):
    """4000 draws: a share of 5 % is known to 0.35 % (one standard deviation)."""
    rng = np.random.default_rng([count, log])
    raised = 0
    for _ in range(2000):
        draw = rng.normal(0, 0.05, count + 1)
        values = np.exp(draw) if log else 1 + draw
        found = proposed("B", drawn(values[:-1]), RATE, 0.0)
        limits = {one.key: one.value for one in found.limits}
        raised += (values[-1] < limits["low_warn"]) + (values[-1] > limits["high_warn"])
    assert raised / 4000 == pytest.approx(RATE, abs=0.014)


@given(values=st.lists(st.floats(1, 1e4), min_size=1, max_size=8), noise=st.floats(1e-5, 0.2),
       rate=st.floats(1e-4, 0.4), least=st.floats(0, 0.5))
@settings(max_examples=150)
def test_limits_are_in_order_and_their_rates_as_asked(values, noise, rate, least):
    found = proposed("B", drawn(values, noise), rate, least)
    section = thresholds_tree([found])["viscous_damping"]
    order = [one.value for one in found.limits]
    assert order == sorted(order)
    assert 0 < order[1] <= found.mean * (1 - least) * 1.001 if len(values) > 1 else order[1] > 0
    for one in found.limits:
        assert (section[one.key] is None) == one.wide
        if len(values) > 1:
            wanted = rate * (0.1 if "error" in one.key else 1)
            # Unless it would lie a thousand times off: the rate is then what it is.
            assert one.rate <= wanted * 1.001 or not 0.002 < one.factor < 500
            assert one.rate == implied(one.key.split("_")[0], drawn(values, noise), one.value)
        else:
            assert np.isnan(one.rate)


@given(seed=st.integers(0, 10_000), hold=st.sampled_from([0.0, 0.3, 1.0]))
@settings(max_examples=40)
def test_the_extreme_is_where_the_alarm_begins(seed, hold):
    """An oracle apart: the alarms' own judge raises just beyond the extreme and not before."""
    rng = np.random.default_rng(seed)
    time = np.arange(300) * 0.1
    value = 600 * np.exp(np.cumsum(rng.normal(0, 3e-4, 300)))
    series = ParameterSeries(ParameterEstimate("B", value[-1], 1.0, "N·s/m", "converged"), value,
                             np.full(300, 1.0), np.ones(300, bool))
    tree = {"viscous_damping": {"hold_time": hold, "low_error": None, "high_warn": None,
                                "high_error": None}}
    config = settings_from_tree({"thresholds": tree}, "a")
    extreme = healthy_of("a", "B", time, series, config).low
    for factor, expected in ((0.9999, False), (1.0001, True)):
        tree["viscous_damping"]["low_warn"] = extreme * factor
        _, history = judge_series(settings_from_tree({"thresholds": tree}, "a"), time,
                                  {"B": series})
        raised = any(one.raised for one in history if one.name == "viscous_damping_low")
        # A value that has just moved is on trial for some seconds: fewer alarms, never more.
        assert raised <= expected


def test_extremes_of_a_bag_lie_about_its_value(bags):
    found = estimate(read_recording(bags[2], Settings()), Settings())
    one = healthy_of("a", "B", found.recording.time, series_of(found)["B"], Settings())
    assert 0.9 * one.value < one.low < one.value + 3 * one.stddev
    assert one.value - 3 * one.stddev < one.high < 1.1 * one.value
