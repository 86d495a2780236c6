"""Terms that no entry of the catalogue has: a table of knots or an expression, from the config.

A rig has room for ``SLOTS`` of them.  What such a term is stands in theta beside the parameters of
the catalogue's effects, so the compiled equations run any of them without being compiled again:

    ADDS, KIND                                        to which balance; table or expression
    SIGNAL, FACTOR, SCALE, COUNT, FIRST, LAST, VALUES  of a table
    LENGTH, CODES, CONSTANTS                          of an expression, in postfix order

A table is a cubic through its knots (Catmull and Rom 1974), linear at both ends, and keeps its
last value beyond them: where a recording has said nothing, nothing is extrapolated.  Over the
shaft's angle it is periodic, from ``first`` to ``last``.

The angle is what the shaft has turned since the recording began, in the term's own memory: no
channel has it.  So its zero is another one in each recording, and a recording's own is ``PHASE``.

Expressions are parsed to a small grammar, and nothing of the text is ever executed:

    38 * exp(-((x - x_0) / w)**2) * tanh(v / v_e)

Numbers, signals (x, v, dp, p, omega, p1, p2), named parameters, + - * / ** and the functions
below.  Anything else is refused with its place in the text.
"""

import ast
import math
import sys
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from eha_monitor.compiled import njit
from eha_monitor.physics import signals as of

SLOTS, WIDTH = 2, 64
OWN_NAMES = tuple(f"own_{i + 1}" for i in range(SLOTS))
MOST_KNOTS, MOST_CODES, MOST_CONSTANTS, DEEPEST = 49, 36, 24, 6

# Head of a slot.
ADDS, KIND = 0, 1
NOTHING, TABLE, EXPRESSION = range(3)
# A table.
SIGNAL, FACTOR, SCALE, COUNT, FIRST, LAST, VALUES = range(2, 9)
# An expression.
LENGTH, CODES = 2, 3
CONSTANTS = CODES + MOST_CODES
PHASE = WIDTH - 1  # of both: the angle at which a recording begins, rad

# To what a term adds -> the contributions that read it, and its unit.
BALANCES = {"force": (of.FORCE,), "flow": (of.FLOW_1, of.FLOW_2), "flow_1": (of.FLOW_1,),
            "flow_2": (of.FLOW_2,), "speed": (of.SPEED,)}
ADDED_UNITS = {"force": "N", "flow": "m³/s", "flow_1": "m³/s", "flow_2": "m³/s", "speed": "rad/s"}
ADDED = tuple(BALANCES)
TO_FORCE, TO_FLOW, TO_FLOW_1, TO_FLOW_2, _TO_SPEED = range(len(ADDED))
OF = ("x", "v", "dp", "p", "omega", "p1", "p2", "angle")  # that a term may be a function of
OF_UNITS = {"x": "m", "v": "m/s", "dp": "Pa", "p": "Pa", "omega": "rad/s", "p1": "Pa",
            "p2": "Pa", "angle": "rad"}
BY_ANGLE = OF.index("angle")
PRESSURES = ("dp", "p", "p1", "p2")
FACTORS = ("none", "direction", "v", "dp", "omega")  # what a table may be multiplied by
_BY_NONE, BY_DIRECTION, BY_V, BY_DP, BY_OMEGA = range(len(FACTORS))
TURNED, SINCE = 0, 1  # memory: the shaft's angle, rad, and when it was that, s

# Codes of an expression: functions of one number, of two, then signals and constants.
ONE = ("neg", "abs", "sign", "sqrt", "exp", "tanh", "sin", "cos")
TWO = ("add", "subtract", "multiply", "divide", "power", "max", "min")
FIRST_TWO, FIRST_SIGNAL, FIRST_CONSTANT = 100, 200, 300


@njit(forceinline=True)
def signal_of(s, which):
    """Return a signal by its place in ``OF``, SI."""
    if which == 0:
        return s[of.X]
    if which == 1:
        return s[of.V]
    if which == 2:
        return s[of.P1] - s[of.P2]
    if which == 3:
        return 0.5 * (s[of.P1] + s[of.P2])
    if which == 4:
        return s[of.OMEGA]
    if which == 5:
        return s[of.P1]
    return s[of.P2] if which == 6 else s[of.ANGLE]


@njit(forceinline=True)
def knot(values, count, i):
    """Return the value at knot i; one before the first and one after the last are on a line."""
    if i < 0:
        return 2.0 * values[0] - values[1]
    if i >= count:
        return 2.0 * values[count - 1] - values[count - 2]
    return values[i]


@njit(forceinline=True)
def tabled(values, count, first, last, at, periodic):
    """Return a table's value at ``at``: the cubic through four knots, constant beyond the ends.

    A periodic one has its first knot again, at ``last``, in the place of one more.
    """
    along = (at - first) / (last - first)
    if periodic:
        along = (along - math.floor(along)) * count
        i = int(along)
        a, b = values[(i - 1) % count], values[i % count]
        c, d = values[(i + 1) % count], values[(i + 2) % count]
    else:
        along = min(max(along * (count - 1), 0.0), float(count - 1))
        i = min(int(along), count - 2)
        a, b = knot(values, count, i - 1), knot(values, count, i)
        c, d = knot(values, count, i + 1), knot(values, count, i + 2)
    f = along - i
    return b + 0.5 * f * (c - a + f * (2.0 * a - 5.0 * b + 4.0 * c - d
                                       + f * (3.0 * (b - c) + d - a)))


@njit(forceinline=True)
def one_of(code, a):
    """Return a function of one number; what is not real is NaN."""
    if code == 0:
        return -a
    if code == 1:
        return abs(a)
    if code == 2:
        return 1.0 if a > 0.0 else (-1.0 if a < 0.0 else a)
    if code == 3:
        return math.sqrt(a) if a >= 0.0 else math.nan
    if code == 4:
        return math.exp(700.0 if a > 700.0 else a)
    if code == 5:
        return math.tanh(a)
    return math.sin(a) if code == 6 else math.cos(a)


@njit(forceinline=True)
def two_of(code, a, b):
    """Return a function of two numbers; what is not real is NaN."""
    if code == 0:
        return a + b
    if code == 1:
        return a - b
    if code == 2:
        return a * b
    if code == 3:
        return a / b if b != 0.0 else math.nan
    if code == 4:
        if a == 0.0 and b < 0.0:
            return math.nan
        if a < 0.0 and b != math.floor(b):
            return math.nan
        return a**b
    if a != a or b != b:  # else the order of the two would decide whether NaN is noticed
        return math.nan
    return max(a, b) if code == 5 else min(a, b)


@njit(forceinline=True)
def expressed(q, s):
    """Return an expression's value; its stack is six numbers deep and takes no memory."""
    a = b = c = d = e = f = 0.0
    for i in range(int(q[LENGTH])):
        code = int(q[CODES + i])
        if code >= FIRST_SIGNAL:
            value = (q[CONSTANTS + code - FIRST_CONSTANT] if code >= FIRST_CONSTANT
                     else signal_of(s, code - FIRST_SIGNAL))
            f, e, d, c, b, a = e, d, c, b, a, value
        elif code >= FIRST_TWO:
            a = two_of(code - FIRST_TWO, b, a)
            b, c, d, e = c, d, e, f
        else:
            a = one_of(code, a)
    return a


@njit(nogil=True)
def expressed_along(q, rows, out):
    """Write an expression's value at each row of signals, (n,); ``rows`` (n, N_SIGNALS)."""
    for i in range(len(out)):
        out[i] = expressed(q, rows[i])


@njit
def own_term(s, q, m, c):
    """Add a slot's term to the contributions, as an effect's ``term`` does.

    Parameters
    ----------
    s : (N_SIGNALS,) signals, the angle written;  q : (WIDTH,) the slot;  m : its memory.
    c : (N_CONTRIBUTIONS,) added to.
    """
    s[of.ANGLE] = q[PHASE] + m[TURNED] + s[of.OMEGA] * (s[of.T] - m[SINCE])
    if q[KIND] == TABLE:
        which = int(q[SIGNAL])
        value = tabled(q[VALUES:], int(q[COUNT]), q[FIRST], q[LAST], signal_of(s, which),
                       which == BY_ANGLE)
        factor = int(q[FACTOR])
        if factor == BY_DIRECTION:
            value *= math.tanh(s[of.V] / q[SCALE])
        elif factor == BY_V:
            value *= s[of.V] / q[SCALE]
        elif factor == BY_DP:
            value *= (s[of.P1] - s[of.P2]) / q[SCALE]
        elif factor == BY_OMEGA:
            value *= s[of.OMEGA] / q[SCALE]
    elif q[KIND] == EXPRESSION:
        value = expressed(q, s)
    else:
        return
    adds = int(q[ADDS])
    if adds == TO_FORCE:
        c[of.FORCE] += value
    elif adds == TO_FLOW:
        c[of.FLOW_1] += value
        c[of.FLOW_2] -= value
    elif adds == TO_FLOW_1:
        c[of.FLOW_1] += value
    elif adds == TO_FLOW_2:
        c[of.FLOW_2] += value
    else:
        c[of.SPEED] += value


@njit
def turn(s, q, h, m):
    """Carry the shaft's angle over a step of ``h`` s that has ended at the signals ``s``."""
    m[TURNED] += h * s[of.OMEGA]
    m[SINCE] = s[of.T]


@njit
def turns(q):
    """Tell whether a slot's term reads the shaft's angle."""
    if q[KIND] == TABLE:
        return q[SIGNAL] == BY_ANGLE
    if q[KIND] == EXPRESSION:
        for i in range(int(q[LENGTH])):
            if q[CODES + i] == FIRST_SIGNAL + BY_ANGLE:
                return True
    return False


def cardinal(at: np.ndarray, count: int, first: float, last: float, periodic: bool = False
             ) -> np.ndarray:
    """Return what each knot of a table contributes at ``at``, (n, count)."""
    along = (np.asarray(at) - first) / (last - first)
    if periodic:
        along = (along - np.floor(along)) * count
        i = np.minimum(along.astype(int), count - 1)
    else:
        along = np.clip(along * (count - 1), 0.0, count - 1.0)
        i = np.minimum(along.astype(int), count - 2)
    f = along - i
    weights = (0.5 * f * (-1.0 + f * (2.0 - f)), 1.0 + 0.5 * f * f * (3.0 * f - 5.0),
               0.5 * f * (1.0 + f * (4.0 - 3.0 * f)), 0.5 * f * f * (f - 1.0))
    rows = np.arange(len(along))
    if periodic:  # the four knots go round
        around = np.zeros((len(along), count))
        for offset, weight in enumerate(weights):
            np.add.at(around, (rows, (i + offset - 1) % count), weight)
        return around
    found = np.zeros((len(along), count + 2))
    for offset, weight in enumerate(weights):
        found[rows, i + offset] += weight  # knot i - 1 stands in column i
    inner = found[:, 1:-1]
    inner[:, 0] += 2.0 * found[:, 0]  # the knots beyond the ends are on a line
    inner[:, 1] -= found[:, 0]
    inner[:, -1] += 2.0 * found[:, -1]
    inner[:, -2] -= found[:, -1]
    return inner


def reads(q: np.ndarray) -> set[str]:
    """Return the signals that a slot's term reads, by their names in ``OF``."""
    if q[KIND] == TABLE:
        also = {"direction": {"v"}, "v": {"v"}, "dp": {"dp"}, "omega": {"omega"}}
        return {OF[int(q[SIGNAL])]} | also.get(FACTORS[int(q[FACTOR])], set())
    codes = q[CODES : CODES + int(q[LENGTH])] if q[KIND] == EXPRESSION else ()
    return {OF[int(code) - FIRST_SIGNAL] for code in codes
            if FIRST_SIGNAL <= code < FIRST_CONSTANT}


def added(q: np.ndarray) -> tuple[int, ...]:
    """Return the contributions that a slot's term adds to.

    None for one of the shaft's angle: the stages do not follow the angle, over which it is as
    often positive as negative.
    """
    return () if turns(q) else BALANCES[ADDED[int(q[ADDS])]]


def reads_pressure(q: np.ndarray) -> bool:
    """Tell whether a slot's term is a function of a pressure."""
    return not turns(q) and not reads(q).isdisjoint(PRESSURES)


_BINARY = {ast.Add: "add", ast.Sub: "subtract", ast.Mult: "multiply", ast.Div: "divide",
           ast.Pow: "power"}
FUNCTIONS = (*(name for name in ONE if name != "neg"), "max", "min")
LONGEST = 400  # characters


@dataclass(frozen=True)
class Expression:
    """A parsed expression."""

    text: str  # as it was written
    codes: tuple[int, ...]  # postfix, for :func:`expressed`
    # The numbers of the text; None where a parameter stands, in the order of the codes' places.
    constants: tuple[float | None, ...]
    parameters: dict[str, int]  # names -> their place among the constants

    def slot(self, adds: str, values: dict[str, float]) -> np.ndarray:
        """Return the slot of theta that holds it, (WIDTH,), with its parameters' values, SI."""
        q = np.zeros(WIDTH)
        q[ADDS], q[KIND], q[LENGTH] = ADDED.index(adds), EXPRESSION, len(self.codes)
        q[CODES : CODES + len(self.codes)] = self.codes
        for i, constant in enumerate(self.constants):
            q[CONSTANTS + i] = 0.0 if constant is None else constant
        for name, place in self.parameters.items():
            q[CONSTANTS + place] = values[name]
        return q


@lru_cache(maxsize=64)
def parsed(text: str) -> Expression:
    """Parse an expression.

    Raises
    ------
    ValueError
        Naming the place in the text and what was expected there.
    """
    if len(text) > LONGEST:
        raise ValueError(f"an expression of {len(text)} characters, expected at most {LONGEST}")
    if not text.isascii() or not text.isprintable():
        raise ValueError("expected an expression of printable ASCII characters")
    try:
        tree = ast.parse(text.strip(), mode="eval")
    except (SyntaxError, RecursionError, MemoryError) as problem:
        place = getattr(problem, "offset", None) or 1
        raise ValueError(f"at character {place}: not an expression, expected numbers, signals, "
                         "parameters, + - * / ** and functions") from None
    found = _Compiler()
    found.visit(tree.body, 1)
    if len(found.codes) > MOST_CODES or len(found.constants) > MOST_CONSTANTS:
        raise ValueError(f"too long: {len(found.codes)} operations and {len(found.constants)} "
                         f"numbers, expected at most {MOST_CODES} and {MOST_CONSTANTS}")
    return Expression(text.strip(), tuple(found.codes), tuple(found.constants), found.parameters)


class _Compiler:
    """Writes a syntax tree as postfix codes."""

    def __init__(self):
        self.codes: list[int] = []
        self.constants: list[float | None] = []
        self.parameters: dict[str, int] = {}

    def visit(self, node: ast.AST, depth: int) -> None:
        """Write one node; ``depth`` numbers are on the stack when it is done."""
        if depth > DEEPEST:
            raise ValueError(f"at character {node.col_offset + 1}: nested deeper than "
                             f"{DEEPEST} numbers that wait for one another")
        if isinstance(node, ast.Constant):
            self._constant(node)
        elif isinstance(node, ast.Name):
            self._name(node)
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.USub, ast.UAdd)):
            self.visit(node.operand, depth)
            if isinstance(node.op, ast.USub):
                self.codes.append(ONE.index("neg"))
        elif isinstance(node, ast.BinOp) and type(node.op) in _BINARY:
            self.visit(node.left, depth)
            self.visit(node.right, depth + 1)
            self.codes.append(FIRST_TWO + TWO.index(_BINARY[type(node.op)]))
        elif isinstance(node, ast.Call):
            self._call(node, depth)
        else:
            what = ast.unparse(node)
            raise ValueError(f"at character {node.col_offset + 1}: {what[:40]!r} is no part of an "
                             f"expression, expected numbers, signals ({', '.join(OF)}), "
                             f"parameters, + - * / ** and functions ({', '.join(FUNCTIONS)})")

    def _constant(self, node: ast.Constant) -> None:
        value = node.value
        if isinstance(value, bool) or not isinstance(value, (int, float)) or (
                not abs(value) <= sys.float_info.max):  # a whole number may be larger
            raise ValueError(f"at character {node.col_offset + 1}: expected a finite number, got "
                             f"{str(value)[:40]!r}")
        self.codes.append(FIRST_CONSTANT + len(self.constants))
        self.constants.append(float(value))

    def _name(self, node: ast.Name) -> None:
        if node.id in OF:
            self.codes.append(FIRST_SIGNAL + OF.index(node.id))
            return
        if node.id in FUNCTIONS:
            raise ValueError(f"at character {node.col_offset + 1}: {node.id} is a function, "
                             f"expected {node.id}(...)")
        if node.id == "pi":
            self.codes.append(FIRST_CONSTANT + len(self.constants))
            self.constants.append(math.pi)
            return
        if node.id not in self.parameters:
            self.parameters[node.id] = len(self.constants)
            self.constants.append(None)
        self.codes.append(FIRST_CONSTANT + self.parameters[node.id])

    def _call(self, node: ast.Call, depth: int) -> None:
        name = node.func.id if isinstance(node.func, ast.Name) else ast.unparse(node.func)
        if name not in FUNCTIONS:
            raise ValueError(f"at character {node.col_offset + 1}: unknown function "
                             f"{name[:40]!r}, expected one of {', '.join(FUNCTIONS)}")
        wanted = 2 if name in TWO else 1
        if node.keywords or len(node.args) != wanted:
            raise ValueError(f"at character {node.col_offset + 1}: {name} takes {wanted} "
                             f"number{'s' if wanted > 1 else ''}")
        for i, argument in enumerate(node.args):
            self.visit(argument, depth + i)
        self.codes.append(FIRST_TWO + TWO.index(name) if wanted == 2 else ONE.index(name))
