"""``make ring``: a false alarm, the motion that shows what it was, and the way back.

The line of a simulated actuator is throttled: friction grows with the square of the speed.  In
its slow work that reads as viscous damping, and the monitor warns of wear.  Its own diagnosis
stays in doubt; ``identify`` runs the motion that decides, the monitor names the effect, adopts
it, and takes the alarm back.  Then the throttle is gone, and the monitor says so.

All of it is real: monitor, simulator and ``identify`` are processes over DDS on loopback.
"""

import json
import shutil
import sys
import time
from collections.abc import Callable
from pathlib import Path

from demo import Children, DemoFailed, play
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from std_srvs.srv import Trigger

from eha_monitor.health.judge import Finding
from eha_monitor.ros import running
from eha_monitor.ros.messages import findings_of
from eha_monitor.ros.topics import LATCHED

NAMESPACE = "/eha"
PATIENCE = 90.0  # s for each step at most
CALLS = 3  # of `diagnose` after the machine was mended
ALARM, EFFECT = "viscous_damping_high", "effect quadratic_friction"
THROTTLED = {"quadratic_friction": {"a_1": 30_000.0}}  # N·s²/m²
WORK = {"kind": "triangle", "amplitude": 0.01, "frequency": 0.1, "duration": 3600.0}
BRISK_WORK = {"kind": "sine", "amplitude": 0.02, "frequency": 0.5, "duration": 3600.0}
MONITOR = {
    "thresholds": {"viscous_damping": {"high_warn": 650.0, "high_error": 2000.0}},  # B is 600
    "diagnosis": {"start": "service", "niceness": 0},
    "experiment": {"lower": -0.03, "upper": 0.03, "speed": 0.15, "acceleration": 5.0,
                   "pressure": 6e6, "motion_time": 10.0, "total_time": 40.0}}
SHOWN = (ALARM, "model_mismatch", "diagnosis", "model_in_force")


class Onlooker:
    """What the monitor says of its alarms, its model and its diagnosis, printed as it changes.

    Attributes
    ----------
    found : the last finding of each name.
    """

    def __init__(self, node: Node, children: Children):
        self._node, self._children = node, children
        self._began = time.monotonic()
        self._said: dict[str, tuple[str, str]] = {}
        self.found: dict[str, Finding] = {}
        for topic in ("monitor/health", "monitor/diagnosis"):
            node.create_subscription(DiagnosticArray, topic, self._take, LATCHED)

    def _take(self, message: DiagnosticArray) -> None:
        found = {one.name: one for one in findings_of(message)}
        if "diagnosis" in found:  # its effects are those of the last diagnosis
            self.found = {name: one for name, one in self.found.items()
                          if not name.startswith("effect ")}
        self.found |= found
        for name in SHOWN:
            if name in found:
                one = found[name]
                said = one.word, one.message if name in ("diagnosis", "model_in_force") else ""
                if said != self._said.get(name):
                    self._said[name] = said
                    self.say(f"{one.word:10} {name}: {one.message.removeprefix(one.word + ': ')}")

    def say(self, text: str) -> None:
        """Print a line with the seconds since the beginning."""
        print(f"  {time.monotonic() - self._began:5.1f} s  {text}", flush=True)

    def until(self, what: str, condition: Callable[[], bool]) -> None:
        """Look on until a condition holds; DemoFailed where it does not in time."""
        def finished() -> bool:
            self._children.check()
            return condition()

        running.spin(self._node, PATIENCE, finished)
        if not condition():
            raise DemoFailed(f"expected {what} within {PATIENCE:g} s, it did not come")

    def became(self, name: str, *words: str) -> None:
        """Look on until a status has one of these words."""
        self.until(f"{name} {' or '.join(words)}",
                   lambda: name in self.found and self.found[name].word in words)

    def call(self, service: str) -> None:
        """Call a Trigger service of the monitor; DemoFailed where it refuses."""
        client = self._node.create_client(Trigger, f"monitor/{service}")
        self.until(f"the service {service}", client.service_is_ready)
        answer = client.call_async(Trigger.Request())
        self.until(f"an answer of {service}", answer.done)
        if not answer.result().success:
            raise DemoFailed(f"{service}: {answer.result().message}")
        self.say(f"{'called':10} {service}: {answer.result().message}")

    def verdict(self) -> str:
        """Return the verdict of the last diagnosis."""
        return str(self.found["diagnosis"].values.get("verdict", ""))

    def probability(self) -> float:
        """Return the probability of the named effect, 0 where it is not named."""
        effect = self.found.get(EFFECT)
        return float(effect.values["probability"]) if effect else 0.0


def written(folder: Path) -> dict[str, str]:
    """Write the four configs, as JSON, which is YAML; returns their paths by name."""
    saved = {"monitor": {"save_folder": str(folder.resolve() / "saved")}}
    motion = {name: {"simulation": {"excitation": {"motion": work}}}
              for name, work in (("slow", WORK), ("brisk", BRISK_WORK))}
    trees = {"monitor": MONITOR | saved, "throttled": {"effects": THROTTLED} | motion["slow"],
             "commanded": {"effects": THROTTLED, "simulation": {"demand": "topic"}},
             "mended": motion["brisk"]}
    for name, tree in trees.items():
        (folder / f"{name}.yaml").write_text(json.dumps({"/**": {"ros__parameters": tree}}))
    return {name: str(folder / f"{name}.yaml") for name in trees}


def ring(folder: Path) -> str:
    """Go round once; no last words."""
    # What an earlier round saved and adopted is another machine's past.
    shutil.rmtree(folder / "saved", ignore_errors=True)
    configs = written(folder)
    with (running.ros_session([]), running.node("ring", NAMESPACE) as node,
          Children(folder) as children):
        seen = Onlooker(node, children)
        children.start("monitor", "--config", configs["monitor"])
        print("1. Slow work; the line is throttled, and nobody knows.")
        with Children(folder) as plant:
            plant.start("simulator", "--config", configs["throttled"], "--seed", "1")
            seen.became(ALARM, "WARN", "ERROR")
            seen.call("diagnose")
            first = seen.probability()
        print("2. An experiment that decides: the actuator follows commands.")
        with Children(folder) as plant:
            plant.start("simulator", "--config", configs["commanded"], "--seed", "2")
            with Children(folder) as experiment:
                experiment.start("identify", "--config", configs["monitor"], "--out",
                                 str(folder / "identify"), "--overwrite",
                                 "--json", str(folder / "identify.json"))
                seen.until("the end of the experiment", lambda: experiment.ended("identify"))
                experiment.check()
            answer = json.loads((folder / "identify.json").read_text())
            seen.say(f"{'identify':10} {answer['end']} after {answer['motion_s']:.1f} s of "
                     f"motion: {', '.join(answer['names'])}, {answer['probability']:.0%}")
            if answer["end"] != "decided":
                raise DemoFailed(f"identify ended with {answer['end']}, expected decided")
            seen.call("diagnose")
            if seen.probability() < 0.95:
                raise DemoFailed(f"expected {EFFECT} with 95 %, got {seen.probability():.0%} "
                                 f"(before the experiment {first:.0%})")
            seen.call("adopt")
        print("3. Slow work again, with the model that was adopted.")
        with Children(folder) as plant:
            plant.start("simulator", "--config", configs["throttled"], "--seed", "3")
            seen.became("model_mismatch", "OK")
            seen.became(ALARM, "OK")
        print("4. The throttle is gone.")
        with Children(folder) as plant:
            plant.start("simulator", "--config", configs["mended"], "--seed", "4")
            seen.became("model_mismatch", "WARN", "ERROR")
            for _ in range(CALLS):  # its first seconds may still hold the other work
                seen.call("diagnose")
                if seen.verdict() == "consistent":
                    break
            else:
                raise DemoFailed(f"expected consistent in {CALLS} diagnoses, got "
                                 f"{seen.verdict()}")
            seen.call("revert")
            seen.became("model_mismatch", "OK")
            seen.became(ALARM, "OK")
    return ""


def main() -> int:
    """Go round once; returns the exit status."""
    folder = Path("out/ring")
    return play("ring", folder, lambda: ring(folder))


if __name__ == "__main__":
    sys.exit(main())
