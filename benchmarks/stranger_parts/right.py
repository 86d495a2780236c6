"""Two hundred recordings with nothing wrong in their configs; each with what it came from.

Own rigs with other motions, seeds, B and beta_e; the project's simulator and its concealed
draws, left-out physics among them; rig numbers a few percent off, make-up conductance off by two,
charge pressure 20 for 3 bar; and the real recordings.
"""

import copy
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from itertools import chain, zip_longest
from pathlib import Path

import numpy as np
from strangers.plant import recording
from strangers.record import config_of, varied, write_config, write_csv
from strangers.rigs import RIGS

from stranger_parts.bases import config_tree
from stranger_parts.commands import Ran

Run = Callable[..., Ran]
# How many of each kind, 200 in all.
COUNTS = {"own": 60, "simulated": 20, "concealed": 60, "percent": 12, "makeup": 9, "charge": 9,
          "real": 30}
REAL = (
    *(("hsm150", f"hsm150/idf_{name}.mat") for name in (
        "pos_0.06_1", "pos_0.065_2", "neg_0.04_1", "neg_0.045_3")),
    *(("ivliev_eha", f"ivliev_eha/{name}.csv") for name in (
        "exp_data_1_2", "exp_data_1_4", "exp_data_2_3", "exp_data_3_4", "exp_data_4_2",
        "exp_data_5_4", "extra_2024_10_14_5")),
    ("emps", "emps/DATA_EMPS.mat"),
    *(("pneumatic_seals", f"pneumatic_seals/{name}.csv") for name in (
        "1_O-ring257_1bar", "1_O-ring257_3bar", "1_O-ring257_5bar", "1_O-ring257_7bar",
        "Circle_1bar", "Circle_3bar")),
    *(("fluid_power_sim", f"fluid_power_sim/h{name}.csv.gz") for name in (
        "03_rich", "07_tri", "12_rich", "14_tri", "19_rich", "21_tri", "24_rich", "30_tri",
        "32_rich", "36_tri", "40_rich", "46_tri")),
)
# Physics of moderate size that the simulator has and the estimating config does not.
LEFT_OUT = (
    {}, {}, {"coulomb_friction": {"F_c": 10.0}}, {"drive_lag": {"tau": 0.003}},
    {"pump_dead_zone": {"omega_0": 2.0}}, {"cross_port_leakage": {"L": 5e-13}},
    {"constant_load": {"F_0": 60.0}}, {"entrained_air": {"alpha": 0.005}},
    {"position_delay": {"T": 0.001}}, {"pump_flow_gain": {"k": -0.05}},
)
PERCENT = ("A", "V", "M", "D_p", "K_pos")


@dataclass(frozen=True)
class Right:
    """A bag and the right config for it.

    Attributes
    ----------
    problem : why it could not be made, if it could not.
    truth : true B and beta_e, where the config's rig numbers are right.
    """

    name: str
    kind: str
    bag: Path
    config: Path
    problem: str = ""
    truth: dict = field(default_factory=dict)


def right_ones(count: int, folder: Path, data: Path | None, seed: int, run: Run
               ) -> Iterator[Right]:
    """Yield ``count`` right recordings, the kinds in turn, each made when it is asked for."""
    makers = {"own": _own, "simulated": _simulated, "concealed": _concealed,
              "percent": _percent, "makeup": _makeup, "charge": _charge, "real": _real}
    share = {kind: max(round(n * count / 200), 1) for kind, n in COUNTS.items()}
    series = [[(kind, k) for k in range(n)] for kind, n in share.items()]
    order = [one for one in chain.from_iterable(zip_longest(*series)) if one is not None]
    for kind, k in order[:count]:
        made = makers[kind](k, folder, data, seed, run)
        if made is not None:
            yield made


def _imported(name, kind, file, config, folder, run) -> Right:
    bag = folder / name
    done = run("import", str(file), "--map", str(config), "--out", str(bag))
    return Right(name, kind, bag, config, done.err.strip() if done.status else "")


def _own(k, folder, data, seed, run):
    rig = list(RIGS.values())[k % len(RIGS)]
    rig = varied(rig, 1000 * seed + k) if k >= len(RIGS) else rig
    name = f"own_{k:02d}_{rig.name}"
    file = write_csv(rig, recording(rig, seed + k), folder / f"{name}.csv")
    # Half of the owners know their leakage, the others leave what the README leaves out.
    tree = config_of(rig, well_known=bool((k // len(RIGS)) % 2))
    made = _imported(name, "own", file, write_config(tree, folder / f"{name}.yaml"), folder, run)
    return replace(made, truth={"B": rig.plant.damping, "beta_e": rig.plant.bulk_modulus})


def _simulated(k, folder, data, seed, run):
    rng = np.random.default_rng([seed, 31, k])
    motion = str(rng.choice(["triangle", "sine", "multisine", "chirp", "steps"]))
    amplitude = {"triangle": 0.03, "sine": 0.01, "multisine": 0.01, "chirp": 0.004,
                 "steps": 0.01}[motion]
    tree = {
        "rig": {"name": f"sim_{k}", "mass": float(rng.uniform(15, 40)),
                "viscous_damping": float(rng.uniform(500, 1500)),
                "bulk_modulus": float(rng.uniform(4e8, 1e9)), "position_gain": 15000.0},
        "simulation": {"excitation": {"one": {
            "kind": motion, "duration": 8.0, "amplitude": amplitude * float(rng.uniform(0.5, 1)),
            "frequency": 0.5 if motion != "sine" else 2.0, "seed": k}}},
    }
    hidden = LEFT_OUT[k % len(LEFT_OUT)]
    config = write_config(tree, folder / f"sim_{k:02d}.yaml")
    truth = write_config({**copy.deepcopy(tree), **({"effects": hidden} if hidden else {})},
                         folder / f"sim_{k:02d}_truth.yaml")
    bag = folder / f"sim_{k:02d}"
    done = run("simulate", "--config", str(truth), "--out", str(bag), "--seed", str(seed + k))
    return Right(f"sim_{k:02d}_{'_'.join(hidden) or 'clean'}", "simulated", bag, config,
                 done.err.strip() if done.status else "",
                 {"B": tree["rig"]["viscous_damping"], "beta_e": tree["rig"]["bulk_modulus"]})


def _case(name, kind, case, folder):
    from eha_monitor.concealed.cases import truth_of
    from eha_monitor.concealed.generate import write_case

    bag, config = write_case(replace(case, name=name), folder)
    hidden = "_".join(effect for effect, _ in case.effects) or "clean"
    true = truth_of(case) if kind == "concealed" else {}
    return Right(f"{name}_{hidden}", kind, bag, config,
                 truth={key: true[key] for key in ("B", "beta_e") if key in true})


def _draw(k, seed, offset):
    from eha_monitor.concealed.draws import draw_cases

    case = draw_cases(k + 1, 100 * seed + offset, rig="exact")[k]
    # The long motions take three times as long and say the same.
    return replace(case, motion="short" if case.motion == "rich" and k % 3 else case.motion)


def _concealed(k, folder, data, seed, run):
    return _case(f"con_{k:02d}", "concealed", _draw(k, seed, 7), folder)


def _percent(k, folder, data, seed, run):
    from eha_monitor.concealed.cases import RIG, rig_of

    case, rng = replace(_draw(k, seed, 11), effects=()), np.random.default_rng([seed, 41, k])
    true = rig_of(case)
    nominal = {key: true[RIG[key][0]] * float(1 + rng.uniform(-0.05, 0.05)) for key in PERCENT}
    return _case(f"pct_{k:02d}", "percent", replace(case, nominal=nominal), folder)


def _makeup(k, folder, data, seed, run):
    case = replace(_draw(k, seed, 13), effects=())
    return _case(f"mku_{k:02d}", "makeup",
                 replace(case, nominal={"G": (5e-14, 2e-13)[k % 2]}), folder)


def _charge(k, folder, data, seed, run):
    case = replace(_draw(k, seed, 17), effects=())
    true, told = ((3e5, 2e6), (2e6, 3e5))[k % 2]
    case = replace(case, rig={**case.rig, "p_charge": true}, nominal={"p_charge": told})
    return _case(f"chg_{k:02d}", "charge", case, folder)


def _real(k, folder, data, seed, run):
    config, path = REAL[k % len(REAL)]
    if data is None or not (data / path).is_file():
        return None
    tree = config_tree(config)
    if "Circle" in path:  # as the config's own comment says
        tree["rig"]["area_1"] = tree["rig"]["area_2"] = 5.02e-4
        tree["table"]["columns"]["p1"]["scale"] = 1992.0
    name = f"real_{k:02d}_{Path(path).name.split('.')[0]}".replace(".", "_")
    return _imported(name, "real", data / path, write_config(tree, folder / f"{name}.yaml"),
                     folder, run)
