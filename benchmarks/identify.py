"""Seconds of motion until the right set of effects stands: planned, a rich motion, a random one.

Rigs are drawn by ``eha_monitor.concealed``, whose plant is not the one that the diagnosis fits:
rig numbers, B, beta_e and effects, and a config that is off by its tolerances.  A set is right
where its effects are; what it says of the rig's numbers is not scored.  All three ways keep to
the same limits by the same planner's check; the true course, not what sensors show, is held
against them.

    python benchmarks/identify.py --rigs 3 --seed 7 --record
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import record

from eha_monitor.concealed.cases import Case, fine_run, hidden_of, outside_names
from eha_monitor.concealed.draws import draw_names, draw_rig, misconfigured
from eha_monitor.concealed.generate import nominal_config, recording_of
from eha_monitor.concealed.hidden import THRESHOLDED
from eha_monitor.concealed.plant import P1, P2, V, X
from eha_monitor.identify.experiment import DECIDED, Ran, Watch, bounds_of, identify
from eha_monitor.identify.plan import Planned, Planner, most_decisive
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings import Settings, settings_from_tree
from eha_monitor.settings.monitor import Experiment

LIMITS = {"lower": -0.03, "upper": 0.03, "speed": 0.15, "acceleration": 5.0, "pressure": 6e6,
          "motion_time": 10.0, "total_time": 25.0}
RICH = "triangle_and_multisine"
COUNTS = (1, 2, 1, 0)  # effects of a rig, in turn
STRENGTHS = (0.15, 1.0)
# Those that come in where the motion reaches something: the plant draws them anew for each motion.
UNFIT = {*THRESHOLDED, *outside_names(), "anti_cavitation"}


def cases(count: int, seed: int) -> list[Case]:
    """Return the rigs, each with its effects and a config that is off by its tolerances."""
    found = []
    for i in range(count):
        rng = np.random.default_rng([seed, i])
        names: list[str] = []
        while len(names) != COUNTS[i % len(COUNTS)]:
            names = [name for name in draw_names(COUNTS[i % len(COUNTS)], rng)
                     if name not in UNFIT]
        strength = np.exp(rng.uniform(*np.log(STRENGTHS), len(names)))
        found.append(Case(f"rig_{i + 1}", tuple(zip(names, strength.round(3).tolist(),
                                                    strict=True)),
                          rig=draw_rig(rng), seed=int(rng.integers(2**31))))
    return misconfigured(found, seed, "within")


class ConcealedRig:
    """A concealed rig; each motion starts at rest where the last one ended."""

    def __init__(self, case: Case, bounds: Experiment, noise: float):
        self._case, self._bounds, self._noise = case, bounds, noise
        self._held, self._count = 0.5 * (bounds.lower + bounds.upper), 0
        self.used = dict.fromkeys(("travel", "speed", "acceleration", "pressure"), 0.0)

    def position(self) -> float:
        """Return where the piston is held, m."""
        return self._held

    def run(self, x_d: np.ndarray, name: str) -> Ran:
        """Run a demand, and note how much of each limit the true course takes."""
        self._count += 1
        case = replace(self._case, demand=x_d, seed=self._case.seed + self._count)
        channels, _ = recording_of(case)
        fine, fine_time, _ = fine_run(case, hidden_of(case))
        self._note(fine[fine_time >= 0.0], float(fine_time[1] - fine_time[0]))
        dt, b = 1e-3, self._bounds
        watch, aborted, turn = Watch(b, dt, self._noise), "", 20
        rows = 0
        while rows < len(x_d) and not aborted:
            aborted = watch.exceeded({k: v[rows:rows + turn] for k, v in channels.items()})
            rows += turn
        self._held = float(x_d[min(rows, len(x_d)) - 1])
        return Ran(Recording(dt, {k: v[:rows] for k, v in channels.items()}, source=name),
                   aborted)

    def _note(self, fine: np.ndarray, h: float) -> None:
        b = self._bounds
        middle, reach = 0.5 * (b.lower + b.upper), 0.5 * (b.upper - b.lower)
        taken = {"travel": np.abs(fine[:, X] - middle).max() / reach,
                 "speed": np.abs(fine[:, V]).max() / b.speed,
                 "acceleration": np.abs(np.gradient(fine[:, V], h)).max() / b.acceleration,
                 "pressure": fine[:, [P1, P2]].max() / b.pressure}
        self.used = {key: max(self.used[key], float(value)) for key, value in taken.items()}


def persistent(choose: Callable[[Sequence[Planned]], Planned]
               ) -> Callable[[Sequence[Planned]], Planned]:
    """Return a choice that is never given up before the time is up."""
    return lambda found: replace(choose(found), at_last=np.inf)


def ways(seed: int) -> dict[str, Callable[[Sequence[Planned]], Planned]]:
    """Return how the next motion is chosen."""
    rng = np.random.default_rng([seed, 99])
    return {"planned": most_decisive,
            "rich": persistent(lambda found: next(
                (one for one in found if one.motion.name == RICH), found[-1])),
            "random": persistent(lambda found: found[rng.integers(len(found))])}


def effects_of(names: frozenset[str], truth: frozenset[str]) -> set[str]:
    """Return the effects of a set; a number of the rig is the true effect that does the same."""
    same = {f"rig.{CATALOGUE[name].rig_twin}": name for name in truth
            if CATALOGUE[name].rig_twin}
    return {same.get(name, name) for name in names if name in CATALOGUE or name in same}


def settings_of(case: Case) -> Settings:
    """Return the config that goes with a rig, with the limits."""
    tree = nominal_config(case)
    tree["/**"]["ros__parameters"]["experiment"] = dict(LIMITS)
    return settings_from_tree(tree, case.name)


def main() -> None:
    """Run, print, and write the figures on request."""
    options = record.options(__doc__)
    options.add_argument("--rigs", type=int, default=3)
    options.add_argument("--seed", type=int, default=7)
    options.add_argument("--probability", type=float, default=0.95)
    given = options.parse_args()
    rows: dict[str, list[tuple[float, bool, bool]]] = {}
    exceeded, worst = 0, {}
    for case in cases(given.rigs, given.seed):
        truth = frozenset(name for name, _ in case.effects)
        print(f"{case.name}: {', '.join(f'{n} {s:g}' for n, s in case.effects) or 'nothing'}",
              flush=True)
        settings = settings_of(case)
        bounds = bounds_of(settings, case.name)
        for way, choose in ways(given.seed).items():
            started = time.process_time()
            rig = ConcealedRig(case, bounds, settings.simulation.noise.position)
            planner = Planner(settings, bounds, case.name, given.probability, choose)
            *_, last = identify(rig, planner)
            decided = last.end == DECIDED
            right = decided and effects_of(last.names, truth) == truth
            rows.setdefault(way, []).append((last.seconds, decided, right))
            over = [key for key, value in rig.used.items() if value > 1.0]
            exceeded += len(over)
            worst = {key: max(value, worst.get(key, 0.0)) for key, value in rig.used.items()}
            if last.rivals:
                print("    else: " + ", ".join(
                    f"{'+'.join(sorted(names)) or 'nothing'} {value:.2f}"
                    for names, value in list(last.rivals.items())[:4]))
            print(f"  {way:8} {last.seconds:5.1f} s {last.end:11} "
                  f"{', '.join(sorted(last.names)) or 'nothing':40} {last.probability:.3f} "
                  f"{'right' if right else 'WRONG' if decided else 'open'}; limits "
                  f"{', '.join(f'{k} {v:.0%}' for k, v in rig.used.items())}; "
                  f"{last.ran.aborted or 'not aborted'}; "
                  f"{time.process_time() - started:.0f} s of processor", flush=True)
    print(f"limits exceeded: {exceeded}; the most that was taken: "
          + ", ".join(f"{key} {value:.0%}" for key, value in worst.items()))
    figures = {"limits_exceeded": record.spread([exceeded])} | {
        key: record.spread([100.0 * value], "%") for key, value in worst.items()}
    for way, found in rows.items():
        # What is not decided rightly has cost all the time there is.
        seconds = [s if right else LIMITS["total_time"] for s, _, right in found]
        share = sum(right for *_, right in found) / len(found)
        wrong = sum(decided and not right for _, decided, right in found)
        figures[f"{way}_s"] = record.spread(seconds, "s")
        figures[f"{way}_right"] = record.spread([sum(right for *_, right in found)])
        figures[f"{way}_wrong"] = record.spread([wrong])
        print(f"{way}: median {np.median(seconds):.1f} s, mean {np.mean(seconds):.1f} s until "
              f"right (undecided counts {LIMITS['total_time']:g} s), decided rightly "
              f"{share:.0%}, wrongly {wrong} of {len(found)}")
    if given.record:
        record.write("identify", figures, ("eha_monitor/identify", "eha_monitor/mismatch"),
                     held_by="commit")


if __name__ == "__main__":
    main()
