"""How honest the +- of beta_e is where the measured pump speed is the input and noisy.

Random motions, noises, sample times and rigs of the package's simulator, without the position
loop in the config, so that the measured speed drives stage two and the joint filter.

    python benchmarks/noisy_speed.py --seed 1 --draws 40
"""

import argparse

import numpy as np

import eha_monitor as em

MOTIONS = ("sine", "multisine", "chirp", "triangle")


def drawn(rng: np.random.Generator, seed: int) -> tuple[em.Recording, em.Config, float]:
    """Return a recording, the config it is estimated with, and the true beta_e, Pa."""
    kind, frequency = rng.choice(MOTIONS), float(rng.uniform(0.3, 3.0))
    size = float(rng.uniform(0.03, 0.2)) / (2.0 * np.pi * frequency)  # m, by its speed
    motion = {"kind": str(kind), "duration": 10.0} | {
        "sine": {"amplitude": size, "frequency": frequency},
        "multisine": {"amplitude": 0.5 * size, "frequency": 0.3 * frequency,
                      "frequency_end": 4.0 * frequency},
        "chirp": {"amplitude": size / 3.0, "frequency": 0.2, "frequency_end": 4.0 * frequency},
        "triangle": {"amplitude": size, "frequency": 0.5 * frequency}}[kind]
    step = float(rng.choice([1e-3, 2e-3, 5e-4]))
    modulus = float(rng.uniform(3e8, 1.2e9))
    truth = em.Config(
        rig={"sample_time": step, "viscous_damping": float(rng.uniform(200.0, 1500.0)),
             "bulk_modulus": modulus},
        simulation={"excitation": {"motion": motion}, "noise": {
            "pump_speed": float(10.0 ** rng.uniform(-1.0, 0.5)),
            "pressure": float(10.0 ** rng.uniform(2.5, 4.0)),
            "position": float(10.0 ** rng.uniform(-6.3, -5.0))}})
    given = em.Config(rig={"sample_time": step, "position_gain": None})
    return em.simulate(truth, seed=seed), given, modulus


def main() -> None:
    """Draw, estimate and count."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--draws", type=int, default=40)
    asked = parser.parse_args()
    rng = np.random.default_rng(asked.seed)
    off: dict[str, list[float]] = {"stage two": [], "joint": []}
    for number in range(asked.draws):
        recording, config, modulus = drawn(rng, number)
        found = em.estimate(recording, config)
        answers = {"stage two": found.parameters["beta_e"]}
        if found.joint is not None:
            answers["joint"] = found.joint.parameters["beta_e"]
        for name, one in answers.items():
            if one.status == "converged" and found.model.status != "mismatch":
                off[name].append((one.value - modulus) / one.stddev)
    for name, deviations in off.items():
        far = np.abs(deviations)
        print(f"{name}: {len(far)} of {asked.draws} converged and consistent; inside two "
              f"deviations {100.0 * np.mean(far < 2.0):.0f} %, beyond four {np.sum(far > 4.0)}")


if __name__ == "__main__":
    main()
