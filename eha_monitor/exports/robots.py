"""Friction and damping of the actuator's joint for URDF and for MuJoCo (MJCF)."""

from xml.etree import ElementTree

from eha_monitor import __version__
from eha_monitor.exports.friction import (
    Law,
    Motion,
    TwoNumbers,
    law_of,
    motion_of,
    table_velocities,
    two_numbers,
)
from eha_monitor.exports.model import Exported, Model
from eha_monitor.physics.own_term import BALANCES
from eha_monitor.quantity import quantity

STILL = 1e-9  # m/s: a config whose motion stands still says nothing of speeds
WORTH = 0.01  # of the force: a smaller difference needs no line
SPRING = "spring_load"  # the one load by position that MuJoCo's joint has


def urdf_of(model: Model, joint: str) -> Exported:
    """Return a minimal robot whose joint has the identified damping and friction.

    A prismatic joint, or a revolute one of a rig that turns.
    """
    law, two, motion = _numbers(model)
    lost = (*_lost(model, law, two, ()),
            "limits: those of the config's own motion, not identified; set the joint's own")
    root = ElementTree.Element("robot", {"name": _word(model.settings.rig.name)})
    _comments(root, model, lost)
    body, end = f"{joint}_base", f"{joint}_link"
    ElementTree.SubElement(root, "link", {"name": body})
    link = ElementTree.SubElement(root, "link", {"name": end})
    inertial = ElementTree.SubElement(link, "inertial")
    turning = {"mass": 1.0, "inertia": law.mass} if model.rotary else {
        "mass": law.mass, "inertia": 1e-3 * law.mass}
    ElementTree.SubElement(inertial, "mass", {"value": _number(turning["mass"])})
    ElementTree.SubElement(inertial, "inertia", {
        **dict.fromkeys(("ixx", "iyy", "izz"), _number(turning["inertia"])),
        **dict.fromkeys(("ixy", "ixz", "iyz"), "0")})
    one = ElementTree.SubElement(root, "joint", {
        "name": joint, "type": "revolute" if model.rotary else "prismatic"})
    ElementTree.SubElement(one, "parent", {"link": body})
    ElementTree.SubElement(one, "child", {"link": end})
    ElementTree.SubElement(one, "axis", {"xyz": "1 0 0"})
    ElementTree.SubElement(one, "limit", {
        "lower": _number(motion.lowest), "upper": _number(motion.highest),
        "velocity": _number(motion.speed),
        "effort": _number(two.damping * motion.speed + two.friction + abs(law.load))})
    ElementTree.SubElement(one, "dynamics", {
        "damping": _number(two.damping), "friction": _number(two.friction)})
    return Exported(_text(root), lost)


def mujoco_of(model: Model, joint: str) -> Exported:
    """Return a minimal MuJoCo model whose joint has the identified damping and friction.

    A slide joint, or a hinge of a rig that turns; a spring load becomes the joint's stiffness.
    """
    law, two, _ = _numbers(model)
    lost = _lost(model, law, two, (SPRING,))
    root = ElementTree.Element("mujoco", {"model": _word(model.settings.rig.name)})
    _comments(root, model, lost)
    # Implicit in the damping: a seal stiffer than the step allows must not ring.
    ElementTree.SubElement(root, "option", {
        "timestep": _number(model.settings.rig.sample_time), "gravity": "0 0 0",
        "integrator": "implicitfast"})
    if model.rotary:
        ElementTree.SubElement(root, "compiler", {"angle": "radian"})
    world = ElementTree.SubElement(root, "worldbody")
    body = ElementTree.SubElement(world, "body", {"name": f"{joint}_link"})
    attributes = {"name": joint, "type": "hinge" if model.rotary else "slide", "axis": "1 0 0",
                  "damping": _number(two.damping), "frictionloss": _number(two.friction),
                  # MuJoCo's friction is a soft constraint: as hard as the step allows.
                  "solreffriction": f"{_number(2.0 * model.settings.rig.sample_time)} 1"}
    spring = model.effects.get(SPRING)
    if spring is not None:
        attributes |= {"stiffness": _number(spring["k"]), "springref": _number(spring["x_0"])}
    ElementTree.SubElement(body, "joint", attributes)
    mass, inertia = (1.0, law.mass) if model.rotary else (law.mass, 1e-3 * law.mass)
    ElementTree.SubElement(body, "inertial", {
        "pos": "0 0 0", "mass": _number(mass), "diaginertia": " ".join([_number(inertia)] * 3)})
    actuators = ElementTree.SubElement(root, "actuator")
    ElementTree.SubElement(actuators, "motor", {
        "name": f"{joint}_pressure_force", "joint": joint, "gear": "1"})
    return Exported(_text(root), lost)


def _numbers(model: Model) -> tuple[Law, TwoNumbers, Motion]:
    motion = motion_of(model)
    fastest = max(motion.speed, STILL)
    return law_of(model, table_velocities(fastest)), two_numbers(model, fastest), motion


def _lost(model: Model, law: Law, two: TwoNumbers, held: tuple[str, ...]) -> tuple[str, ...]:
    """Return what damping and friction of a joint do not say; ``held`` are effects they do."""
    lost, force = [], "N·m" if model.rotary else "N"
    speed = "rad/s" if model.rotary else "m/s"
    largest = max(abs(law.force - law.load))
    if two.error > WORTH * largest:
        lost.append(f"{', '.join(law.by_velocity)}: the joint's damping and friction are their "
                    f"straight line, off by up to {quantity(two.error, force, 2)} at "
                    f"{quantity(two.at, speed, 2)}")
    at_rest = law.load
    if SPRING in held and SPRING in model.effects:
        spring = model.effects[SPRING]
        at_rest += spring["k"] * spring["x_0"]
    if abs(at_rest) > 1e-9:
        lost.append(f"a load of {quantity(at_rest, force, 3)} against positive motion: apply it "
                    "as a force")
    lost += [f"{name}: the force depends on the position; taken at x = 0"
             for name in law.by_position if name not in held]
    # A force that reads a pressure: the joint has none.
    for name in law.names:
        if "pressure" in name:
            lost.append(f"{name}: taken at the charge pressure, "
                        f"{quantity(model.settings.rig.charge_pressure, 'Pa', 3)}")
    others = [name for name in model.effects if name not in law.names]
    others += [name for name, values in model.own_terms.items()
               if BALANCES[values["adds"]] != BALANCES["force"]]
    lost.append(", ".join(["hydraulics and drive (beta_e, leakage, pump, loop)", *others])
                + ": a joint has none; it takes the pressure force A1 p1 - A2 p2")
    return tuple(lost)


def _comments(root: ElementTree.Element, model: Model, lost: tuple[str, ...]) -> None:
    unit = "N·m·s/rad and N·m" if model.rotary else "N·s/m and N"
    for line in (f"eha_monitor {__version__}, from {model.source}",
                 f"damping and friction in {unit}; {model.provenance}",
                 *(f"not in this file: {one}" for one in lost)):
        root.append(ElementTree.Comment(f" {line.replace('--', '- -')} "))


def _text(root: ElementTree.Element) -> str:
    ElementTree.indent(root)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{ElementTree.tostring(root, "unicode")}\n'


def _number(value: float) -> str:
    return f"{value:.6g}"


def _word(name: str) -> str:
    return "".join(one if one.isalnum() or one in "_-" else "_" for one in name) or "eha"
