"""What an error of a configured rig number does to B and beta_e.

    python benchmarks/rig_numbers.py [--record]

One clean recording of the default rig (8 s of a multisine, then 8 s of the triangle, with its
sensors' noise) is estimated with each rig number 1 % too large.  The table is the change of each
estimate in per cent: 1.00 means that the error is handed on as it is.
"""


import record

from eha_monitor.estimation.pipeline import estimate
from eha_monitor.physics.simulator import Simulator
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings import Settings, settings_from_tree

MOTION = {"rich": {"kind": "multisine", "duration": 8.0, "amplitude": 0.01, "frequency": 0.5,
                   "frequency_end": 15.0, "components": 16, "seed": 1},
          "slow": {"kind": "triangle", "duration": 8.0, "amplitude": 0.04, "frequency": 0.25}}
# What stands together on a drawing is off together.
NUMBERS = {"areas": ("area_1", "area_2"), "volumes": ("volume_1", "volume_2"),
           "mass": ("mass",), "pump displacement": ("pump_displacement",),
           "position gain": ("position_gain",), "leakage": ("leakage", "makeup_conductance")}
ERROR = 0.01
LOST = 100.0  # %


def main() -> None:
    """Print the table."""
    given = record.options(__doc__).parse_args()
    figures = {}
    settings = settings_from_tree({"simulation": {"excitation": MOTION}}, "rig_numbers")
    plant = Simulator(settings, seed=1)
    recording = Recording(plant.dt, plant.advance(16_000))
    right = values(recording, settings)
    names = list(right)
    print(f"{'1 % too large':18}" + "".join(f"{name:>16}" for name in names) + "  model")
    for words, keys in NUMBERS.items():
        rig = {key: (1 + ERROR) * getattr(Settings().rig, key) for key in keys}
        found = estimate(recording, settings_from_tree({"rig": rig}, "rig_numbers"))
        wrong = values_of(found)
        changes = [100 * (wrong[name] / right[name] - 1) for name in names]
        print(f"{words:18}" + "".join(f"{told(change):>16}" for change in changes)
              + f"  {found.model.status}")
        key = words.replace(" ", "_")
        figures |= {f"{key}_{name.replace(', ', '_')}": record.spread(change, "%")
                    for name, change in zip(names, changes, strict=True)}
        figures[f"{key}_model"] = {"value": found.model.status}
    if given.record:
        record.write("rig_numbers", figures, ("eha_monitor/estimation", "eha_monitor/physics"))


def told(change: float) -> str:
    """Return a change in per cent; one that is no longer a number of this rig is ``lost``."""
    return f"{round(change, 2) + 0.0:.2f} %" if abs(change) < LOST else "lost"


def values(recording: Recording, settings: Settings) -> dict[str, float]:
    """Return B and beta_e of the stages and of the joint estimator."""
    return values_of(estimate(recording, settings))


def values_of(found) -> dict[str, float]:
    """Return B and beta_e of the stages and of the joint estimator, SI."""
    known = {name: one.value for name, one in found.parameters.items()}
    return known | {f"{name}, joint": found.joint.parameters[name].value for name in known}


if __name__ == "__main__":
    main()
