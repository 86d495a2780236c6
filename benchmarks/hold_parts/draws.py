"""Recordings for the trial: rigs, motions, rates, holds and what else a rig may have."""

from dataclasses import dataclass, replace

import numpy as np

from hold_parts.plant import Motion, Noise, Rig, recorded

RATES = (250.0, 500.0, 1000.0, 2000.0)  # Hz
MOTIONS = ("triangle", "sine", "multisine", "mixed", "slow")
LAYOUTS = {("x", "x_d", "omega", "p1", "p2"): 0.6, ("x", "x_d", "p1", "p2"): 0.2,
           ("x", "omega", "p1", "p2"): 0.1, ("x", "x_d"): 0.1}
# Beyond the linear model -> its size at full strength.
EXTRAS = {"coulomb": 80.0, "quadratic": 4000.0, "load": 300.0, "leak": 2e-12, "dead_zone": 12.0,
          "play": 1e-4, "drive_lag": 4e-3, "command_delay": 3e-3, "feedback_delay": 2e-3,
          "position_delay": 2e-3, "swept": 1.0}


@dataclass(frozen=True)
class Draw:
    """One recording to be made; ``every`` 0: an analogue controller, 1 and more: a digital one."""

    name: str
    rig: Rig
    motion: Motion
    kind: str
    rate: float
    every: int
    extras: tuple[str, ...]
    channels: tuple[str, ...]
    noise: Noise
    seed: int

    @property
    def digital(self) -> bool:
        """Whether the controller holds its command."""
        return self.every > 0

    def recording(self):
        """Return the recording."""
        return recorded(self.rig, self.motion, 1.0 / self.rate, self.digital,
                        every=max(self.every, 1), seed=self.seed, noise=self.noise,
                        channels=self.channels)


def draw_rig(rng: np.random.Generator) -> Rig:
    """Return a rig whose position loop is stable with a margin, a held one too."""
    area = float(np.exp(rng.uniform(np.log(3e-4), np.log(2e-3))))
    volume = area * rng.uniform(0.1, 0.2)
    mass = rng.uniform(10.0, 60.0)
    damping = mass * rng.uniform(20.0, 60.0)
    displacement = area * rng.uniform(2e-4, 5e-4)
    loop = rng.uniform(4.0, min(9.0, 0.2 * damping / mass))
    return Rig(area_1=area, area_2=area, volume_1=volume, volume_2=volume, mass=mass,
               damping=damping, bulk_modulus=rng.uniform(4e8, 1.1e9),
               leakage=volume * rng.uniform(4e-9, 1e-8), displacement=displacement,
               gain=loop * area / displacement)


def motion_of(kind: str, rng: np.random.Generator) -> Motion:
    """Return a motion of 6 to 12 s."""
    seed = int(rng.integers(2**31))
    fast, slow = rng.uniform(2.0, 5.0), rng.uniform(0.25, 0.6)
    stroke = rng.uniform(0.01, 0.04)
    parts = {"triangle": (("triangle", 8.0, stroke, slow),),
             "slow": (("triangle", 8.0, 0.1 * stroke, 0.5 * slow),),
             "sine": (("sine", 6.0, 0.3 * stroke, fast),),
             "multisine": (("multisine", 8.0, stroke, fast),),
             "mixed": (("triangle", 4.0, stroke, slow), ("multisine", 4.0, stroke, fast),
                       ("sine", 4.0, 0.3 * stroke, fast))}
    return Motion(parts[kind], seed)


def drawn(count: int, seed: int) -> list[Draw]:
    """Return ``count`` draws; half of them digital; a third without anything beyond the model."""
    return [_draw(i, np.random.default_rng([seed, i])) for i in range(count)]


def _draw(number: int, rng: np.random.Generator) -> Draw:
    every = number % 2
    kind = MOTIONS[int(rng.integers(len(MOTIONS)))]
    count = int(rng.choice([0, 1, 2], p=[0.3, 0.5, 0.2]))
    extras = tuple(str(name) for name in rng.choice(list(EXTRAS), count, replace=False))
    rig, strengths = draw_rig(rng), np.exp(rng.uniform(np.log(0.1), 0.0, count))
    # Forces scale with the piston, flows and delays do not.
    scale = {"coulomb": rig.area_1 / 5e-4, "quadratic": rig.area_1 / 5e-4,
             "load": rig.area_1 / 5e-4, "leak": rig.volume_1 / 7e-5}
    rig = replace(rig, **{name: EXTRAS[name] * scale.get(name, 1.0) * (
        1.0 if name == "swept" else strength)
        for name, strength in zip(extras, strengths, strict=True)})
    layouts = list(LAYOUTS)
    channels = layouts[rng.choice(len(layouts), p=list(LAYOUTS.values()))]
    factor = float(rng.choice([0.5, 1.0, 3.0]))
    return Draw(f"h{number:03d}", rig, motion_of(kind, rng), kind, float(rng.choice(RATES)), every,
                extras, channels, Noise(2e-6 * factor, 2e3 * factor, 0.2 * factor),
                int(rng.integers(2**31)))
