"""The FMU, run by fmpy, against the simulator, a closed form, and its own promises."""

import shutil
import subprocess
import sys
import zipfile

import numpy as np
import pytest
from export_tools import CASES, SECONDS, demand, model_of, own_run
from fmpy import extract, read_model_description, simulate_fmu
from fmpy.fmi2 import FMU2Slave
from fmpy.validation import validate_fmu
from rig_tools import T_S, linear_response

from eha_monitor.errors import InputError
from eha_monitor.exports import fmu
from eha_monitor.exports.fmu import fmu_of

OUTPUTS = ("x", "v", "p1", "p2", "omega", "x_measured", "p1_measured", "p2_measured")
SAMPLES = round(SECONDS / T_S)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Return a function that exports effects as an FMU, once."""
    folder, kept = tmp_path_factory.mktemp("fmu"), {}

    def make(model, name):
        if name not in kept:
            kept[name] = folder / f"{len(kept)}.fmu"
            kept[name].write_bytes(fmu_of(model, {}, ("linux64",)).content)
        return kept[name]

    return make


class Slave:
    """An FMU in fmpy, with its variables by name."""

    def __init__(self, path):
        self.folder = extract(str(path))
        self.description = read_model_description(self.folder)
        self.vr = {one.name: one.valueReference for one in self.description.modelVariables}
        self.fmu = FMU2Slave(
            guid=self.description.guid, unzipDirectory=self.folder,
            modelIdentifier=self.description.coSimulation.modelIdentifier, instanceName="one")
        self.fmu.instantiate()

    def start(self, **values):
        self.fmu.setupExperiment(startTime=0.0)
        self.set(**values)
        self.fmu.enterInitializationMode()
        self.fmu.exitInitializationMode()

    def set(self, **values):
        for name, value in values.items():
            self.fmu.setReal([self.vr[name.replace("__", ".")]], [value])

    def get(self, *names):
        return np.array(self.fmu.getReal([self.vr[name] for name in names]))

    def run(self, name, u, step, names=OUTPUTS):
        """Return outputs at each communication point under an input that is a line in between."""
        rows = []
        for k in range(len(u) - 1):
            self.set(**{name: u[k]})
            rows.append(self.get(*names))
            self.fmu.setRealInputDerivatives([self.vr[name]], [1], [(u[k + 1] - u[k]) / step])
            self.fmu.doStep(k * step, step)
        return np.array(rows)

    def __enter__(self):
        return self

    def __exit__(self, *problem):
        self.fmu.terminate()
        self.fmu.freeInstance()
        shutil.rmtree(self.folder, ignore_errors=True)


def apart(found, wanted):
    """Return the largest difference over the range of what is wanted."""
    return float(np.abs(found - wanted).max() / np.ptp(wanted))


@pytest.mark.parametrize("name", CASES)
def test_the_fmu_runs_as_the_simulator_does(made, name):
    model = model_of(CASES[name])
    path = made(model, name)
    assert validate_fmu(str(path)) == []
    wanted = own_run(model, SAMPLES)
    with Slave(path) as slave:
        slave.start(x_d=float(demand(model, np.zeros(1))[0]))
        found = slave.run("x_d", demand(model, np.arange(SAMPLES + 1) * T_S), T_S)
    errors = {output: apart(found[:, j], wanted[output]) for j, output in enumerate(OUTPUTS)}
    assert max(errors.values()) < 1e-3, errors


def test_a_single_rod_cylinder_too(made):
    model = model_of({"coulomb_friction": {"F_c": 20.0}}, area_2=3.5e-4, volume_2=5e-5,
                     sample_time=5e-4)
    wanted = own_run(model, 2000)
    with Slave(made(model, "unequal")) as slave:
        slave.start()
        assert slave.get("p2")[0] == pytest.approx(2e6 * 5.05 / 3.5)
        found = slave.run("x_d", demand(model, np.arange(2001) * 5e-4), 5e-4)
    assert max(apart(found[:, j], wanted[name]) for j, name in enumerate(OUTPUTS)) < 1e-3


def test_the_fmu_obeys_the_paper_s_equations(made):
    """Against the exponential of the matrix, which knows nothing of this program's code."""
    model = model_of({}, area_1=5.05e-4)
    x_d = demand(model, np.arange(SAMPLES + 1) * T_S)
    with Slave(made(model, "default")) as slave:
        slave.start()
        found = slave.run("x_d", x_d, T_S, ("x", "v", "p1", "p2"))
    wanted = linear_response(x_d, T_S)[:-1]
    assert apart(found[:, 0], wanted[:, 0]) < 1e-3
    assert apart(found[:, 2] - found[:, 3], wanted[:, 2]) < 1e-3


def test_simulate_fmu_from_an_empty_folder_in_another_process(made, tmp_path):
    """With an input that is held, and so half a communication step late."""
    model = model_of(CASES["identified"])
    path = made(model, "identified")
    step = 1e-4
    time = np.arange(round(SECONDS / step) + 1) * step
    np.savez(tmp_path / "in.npz", time=time, x_d=demand(model, time))
    script = """
import sys, numpy as np
from fmpy import simulate_fmu
given = np.load("in.npz")
u = np.array(list(zip(given["time"], given["x_d"])), dtype=[("time", float), ("x_d", float)])
r = simulate_fmu(sys.argv[1], stop_time=float(u["time"][-1]), output_interval=1e-4, input=u,
                 output=["x", "p1", "omega"])
assert not [name for name in sys.modules if name.split(".")[0] in ("eha_monitor", "numba")]
np.savez("out.npz", **{name: r[name] for name in r.dtype.names})
"""
    subprocess.run([sys.executable, "-I", "-c", script, str(path)], cwd=tmp_path, check=True,
                   capture_output=True)
    found = np.load(tmp_path / "out.npz")
    wanted = own_run(model, SAMPLES)
    for name in ("x", "p1", "omega"):
        assert apart(found[name][::10][:SAMPLES], wanted[name]) < 5e-3, name


@pytest.mark.skipif(shutil.which("nm") is None, reason="needs binutils")
def test_the_library_needs_nothing_but_the_c_library(made, tmp_path):
    with zipfile.ZipFile(made(model_of({}), "default")) as archive:
        library = archive.extract("binaries/linux64/my_rig.so", tmp_path)
    text = subprocess.run(["nm", "-D", "--undefined-only", library], check=True,
                          capture_output=True, text=True).stdout
    names = {line.split()[-1].split("@")[0] for line in text.splitlines()}
    known = {"calloc", "free", "malloc", "memcpy", "memset", "memmove", "snprintf", "strcmp",
             "strcpy", "strlen", "cos", "exp", "pow", "sin", "tanh", "floor", "ceil", "sqrt"}
    assert {name for name in names if not name.startswith("_")} <= known, names


def test_parameters_are_tuned_while_it_runs_and_fixed_ones_are_not(made):
    with Slave(made(model_of(CASES["identified"]), "identified")) as slave:
        slave.start()
        names = {one.name: one for one in slave.description.modelVariables}
        assert names["viscous_damping"].variability == "tunable"
        assert names["coulomb_friction.F_c"].variability == "tunable"
        assert names["area_1"].variability == "fixed"
        assert float(names["bulk_modulus"].start) == 6e8
        for k in range(600):  # at a steady speed: p1 - p2 is the friction over the area
            slave.set(x_d=0.04 * k * T_S)
            slave.fmu.doStep(k * T_S, T_S)
        before = slave.get("force", "v")
        slave.set(viscous_damping=1600.0, coulomb_friction__F_c=50.04)
        for k in range(600, 1500):
            slave.set(x_d=0.04 * k * T_S)
            slave.fmu.doStep(k * T_S, T_S)
        after = slave.get("force", "v")
        assert before[0] == pytest.approx(40.04 + 600.0 * before[1], rel=0.01)
        assert after[0] == pytest.approx(50.04 + 1600.0 * after[1], rel=0.01)
        with pytest.raises(Exception, match=r"status"):
            slave.set(area_1=1e-3)


def test_pump_speed_and_load_force_are_inputs(made):
    """A still pump and a load: the force balance at rest."""
    with Slave(made(model_of({}), "default")) as slave:
        slave.fmu.setBoolean([slave.vr["closed_loop"]], [False])
        slave.start()
        slave.set(load_force=100.0, pump_speed=0.0)
        for k in range(1000):
            slave.fmu.doStep(k * T_S, T_S)
        assert slave.get("force")[0] == pytest.approx(100.0, rel=1e-3)
        assert slave.get("x")[0] < 0.0
        slave.set(pump_speed=100.0, load_force=0.0)
        for k in range(1000, 2000):
            slave.fmu.doStep(k * T_S, T_S)
        assert slave.get("v")[0] == pytest.approx(100.0 * 1.6925e-7 / 5.05e-4, rel=1e-2)


def test_a_state_is_put_back(made):
    with Slave(made(model_of(CASES["friction, delay, air"]), "friction, delay, air")) as slave:
        slave.start()
        u = demand(model_of({}), np.arange(401) * T_S)
        slave.run("x_d", u[:201], T_S)
        kept = slave.fmu.getFMUState()
        raw = slave.fmu.serializeFMUState(kept)

        def onwards():
            rows = []
            for k in range(200, 400):
                slave.set(x_d=u[k])
                slave.fmu.doStep(k * T_S, T_S)
                rows.append(slave.get("x", "p1"))
            return np.array(rows)

        first = onwards()
        slave.fmu.setFMUState(kept)
        np.testing.assert_array_equal(onwards(), first)
        slave.fmu.setFMUState(slave.fmu.deSerializeFMUstate(raw))
        np.testing.assert_array_equal(onwards(), first)


def test_a_crooked_communication_step_is_refused(made):
    with Slave(made(model_of({}), "default")) as slave:
        slave.start()
        with pytest.raises(Exception, match=r"status"):
            slave.fmu.doStep(0.0, 1.5e-4)


def test_the_description_tells_what_is_lost_and_hides_nothing(made):
    model = model_of({"position_quantisation": {"q": 1e-5}})
    exported = fmu_of(model, {}, ("linux64",))
    assert any("position_quantisation" in line for line in exported.lost)
    path = made(model, "quantised")
    with zipfile.ZipFile(path) as archive:
        assert b"not in this FMU: position_quantisation" in archive.read("modelDescription.xml")


def test_a_rig_without_a_number_is_refused_in_one_line():
    with pytest.raises(InputError, match=r"my_rig.yaml: rig.area_1: an FMU needs a value"):
        fmu_of(model_of({}, area_1=None), {})


def test_without_a_compiler_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setattr(fmu.importlib.util, "find_spec", lambda name: None)
    monkeypatch.setattr(fmu, "_compiler", lambda: None)
    with pytest.raises(InputError, match="make setup WITH=export"):
        fmu_of(model_of({}), {})


def test_a_rig_without_a_position_gain_is_turned_by_its_pump(made):
    model = model_of({}, position_gain=None)
    path = made(model, "open")
    assert validate_fmu(str(path)) == []
    time = np.arange(1001) * T_S
    u = np.array(list(zip(time, np.full(1001, 50.0), strict=True)),
                 dtype=[("time", float), ("pump_speed", float)])
    found = simulate_fmu(str(path), stop_time=1.0, output_interval=T_S, input=u, output=["v"])
    assert found["v"][-1] == pytest.approx(50.0 * 1.6925e-7 / 5.05e-4, rel=1e-2)


def test_it_holds_a_load_from_the_start(made):
    """The pressures at rest balance the config's load and what the master applies."""
    model = model_of({"constant_load": {"F_0": 500.0}})
    with Slave(made(model, "load")) as slave:
        slave.start(load_force=300.0, x_d=model.start)
        p1, p2, velocity = slave.get("p1", "p2", "v")
        rig = model.settings.rig
        assert rig.area_1 * p1 - rig.area_2 * p2 == pytest.approx(800.0)
        slave.fmu.doStep(0.0, T_S)
        assert velocity == 0.0 and abs(slave.get("v")[0]) < 1e-4
