"""What disturbs a recording for a while is found, told and left out; what a law makes is not."""

import json
from dataclasses import replace

import numpy as np
import pytest
from rig_tools import settings, simulated

from eha_monitor import cli
from eha_monitor.balances import event
from eha_monitor.balances.event import events_in, without_events
from eha_monitor.mismatch.diagnosis import INTERMITTENT
from eha_monitor.recordings.write import write_recording

SINE = {"kind": "sine", "amplitude": 0.02, "frequency": 0.7}
CHIRP = {"kind": "chirp", "amplitude": 0.02, "frequency": 0.2, "frequency_end": 1.5}
STEPS = {"kind": "steps", "amplitude": 0.03, "frequency": 0.5}


def recorded(load=0.0, effects=None, shape=SINE, seed=0):
    """Return 20 s of the simulator; from 8 to 11 s the pressures carry a load of so many N."""
    recording = simulated(shape, 20.0, effects=effects or {}).recording(seed)
    ramp = np.interp(recording.time, [8.0, 8.2, 10.8, 11.0], [0.0, 1.0, 1.0, 0.0])
    half = 0.5 * load * ramp / settings().rig.area_1
    return replace(recording, channels=recording.channels | {
        "p1": recording.channels["p1"] + half, "p2": recording.channels["p2"] - half})


@pytest.mark.parametrize("load", [150.0, -60.0])
@pytest.mark.parametrize("shape", [SINE, CHIRP])
def test_a_push_is_dated_measured_and_left_out(load, shape):
    recording = recorded(load, shape=shape)
    (kept,), (event,) = without_events([recording], settings())
    assert 7.0 < event.start_s <= 8.0 and 11.0 <= event.stop_s < 12.0
    assert event.is_load and event.mean == pytest.approx(load, rel=0.15)
    gone = (recording.time >= event.start_s) & (recording.time <= event.stop_s)
    assert np.isnan(kept.channels["x"][gone]).all()
    assert np.array_equal(kept.channels["x"][~gone], recording.channels["x"][~gone])
    assert events_in(kept, settings()) == []


def test_two_pushes_are_two_events():
    first, second = recorded(150.0), recorded(-100.0)
    shift = round(-4.5 / first.sample_time)  # at 3.5 to 6.5 s
    p1, p2 = (first.channels[name] + np.roll(
        second.channels[name] - recorded().channels[name], shift) for name in ("p1", "p2"))
    _, events = without_events([replace(first, channels=first.channels | {
        "p1": p1, "p2": p2})], settings())
    assert [np.sign(one.mean) for one in events] == [-1.0, 1.0]
    assert [one.start_s for one in events] == pytest.approx([3.5, 8.0], abs=0.8)


def test_a_pressure_sensor_that_was_off_for_a_while_is_no_load():
    recording = recorded()
    off = (recording.time > 6.0) & (recording.time < 9.0)
    p1 = recording.channels["p1"] + np.where(off, 4e5 * np.sin(7.0 * recording.time), 0.0)
    (event,) = events_in(replace(recording, channels=recording.channels | {"p1": p1}), settings())
    assert not event.is_load and "sensor" in event.statement
    assert event.start_s <= 6.0 and event.stop_s >= 9.0


@pytest.mark.parametrize("effects", [
    {}, {"coulomb_friction": {"F_c": 100.0}}, {"quadratic_friction": {"a_1": 4e4}},
    {"contact_spring": {"k": 2e5, "x_c": 0.012}},
    {"stribeck_friction": {"F_c": 100.0, "F_d": 60.0, "v_s": 0.01}}])
@pytest.mark.parametrize("shape", [SINE, CHIRP, STEPS])
def test_a_law_that_the_config_lacks_is_no_event(effects, shape):
    """Nor where the motion grows faster, or goes there only once."""
    assert events_in(recorded(effects=effects, shape=shape), settings()) == []


def test_a_motion_of_a_single_moment_has_no_exception(monkeypatch):
    """A table of which one short block is compared has no interval beside a rest."""
    tables = event.tables_of

    def first_moment(*arguments):
        return [replace(one, good=one.good & (np.cumsum(one.good) <= 3))
                for one in tables(*arguments)]

    monkeypatch.setattr(event, "tables_of", first_moment)
    assert events_in(recorded(150.0), settings()) == []


def test_a_change_that_stays_is_no_event():
    run = simulated(SINE, 20.0, faults={"a": {
        "parameter": "viscous_damping", "start": 12.0, "value": 900.0}})
    assert events_in(run.recording(0), settings()) == []


def test_the_rest_is_diagnosed_and_the_load_named(tmp_path, capfd):
    bag, out, page = tmp_path / "bag", tmp_path / "d.json", tmp_path / "d.html"
    write_recording(bag, recorded(150.0), settings())
    assert cli.main(["diagnose", str(bag), "--json", str(out), "--report", str(page)]) == 0
    said, found = " ".join(capfd.readouterr().out.split()), json.loads(out.read_text())
    assert "a load of" in said and "in the rest" in said
    (event,) = found["events"]
    (effect,) = found["effects"]
    assert (found["verdict"], effect["name"]) == ("mismatch", INTERMITTENT)
    assert found["location"]["intervals_s"] == [[event["start_s"], event["stop_s"]]]
    assert found["parameters"]["after"]["B"]["value"] == pytest.approx(600.0, rel=0.01)
    assert "effect-intermittent_load" in page.read_text()
    assert "ind out what happened at" in page.read_text()
