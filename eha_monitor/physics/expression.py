"""Expressions of a config, parsed to a small grammar; nothing of the text is ever executed.

    38 * exp(-((x - x_0) / w)**2) * tanh(v / v_e)

Numbers, signals (x, v, dp, p, omega, p1, p2), named parameters, + - * / ** and the functions
below.  Anything else is refused with its place in the text.
"""

import ast
import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from eha_monitor.physics import own_term as o

_BINARY = {ast.Add: "add", ast.Sub: "subtract", ast.Mult: "multiply", ast.Div: "divide",
           ast.Pow: "power"}
FUNCTIONS = (*(name for name in o.ONE if name != "neg"), "max", "min")
LONGEST = 400  # characters


@dataclass(frozen=True)
class Expression:
    """A parsed expression.

    Attributes
    ----------
    text : as it was written.
    codes : postfix, for :func:`eha_monitor.physics.own_term.expressed`.
    constants : the numbers of the text; None where a parameter stands, in the order of the codes'
        places.
    parameters : names of the parameters -> their place among the constants.
    """

    text: str
    codes: tuple[int, ...]
    constants: tuple[float | None, ...]
    parameters: dict[str, int]

    def slot(self, adds: str, values: dict[str, float]) -> np.ndarray:
        """Return the slot of theta that holds it, (WIDTH,), with its parameters' values, SI."""
        q = np.zeros(o.WIDTH)
        q[o.ADDS], q[o.KIND], q[o.LENGTH] = o.ADDED.index(adds), o.EXPRESSION, len(self.codes)
        q[o.CODES : o.CODES + len(self.codes)] = self.codes
        for i, constant in enumerate(self.constants):
            q[o.CONSTANTS + i] = 0.0 if constant is None else constant
        for name, place in self.parameters.items():
            q[o.CONSTANTS + place] = values[name]
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
    if len(found.codes) > o.MOST_CODES or len(found.constants) > o.MOST_CONSTANTS:
        raise ValueError(f"too long: {len(found.codes)} operations and {len(found.constants)} "
                         f"numbers, expected at most {o.MOST_CODES} and {o.MOST_CONSTANTS}")
    return Expression(text.strip(), tuple(found.codes), tuple(found.constants), found.parameters)


class _Compiler:
    """Writes a syntax tree as postfix codes."""

    def __init__(self):
        self.codes: list[int] = []
        self.constants: list[float | None] = []
        self.parameters: dict[str, int] = {}

    def visit(self, node: ast.AST, depth: int) -> None:
        """Write one node; ``depth`` numbers are on the stack when it is done."""
        if depth > o.DEEPEST:
            raise ValueError(f"at character {node.col_offset + 1}: nested deeper than "
                             f"{o.DEEPEST} numbers that wait for one another")
        if isinstance(node, ast.Constant):
            self._constant(node)
        elif isinstance(node, ast.Name):
            self._name(node)
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.USub, ast.UAdd)):
            self.visit(node.operand, depth)
            if isinstance(node.op, ast.USub):
                self.codes.append(o.ONE.index("neg"))
        elif isinstance(node, ast.BinOp) and type(node.op) in _BINARY:
            self.visit(node.left, depth)
            self.visit(node.right, depth + 1)
            self.codes.append(o.FIRST_TWO + o.TWO.index(_BINARY[type(node.op)]))
        elif isinstance(node, ast.Call):
            self._call(node, depth)
        else:
            what = ast.unparse(node)
            raise ValueError(f"at character {node.col_offset + 1}: {what[:40]!r} is no part of an "
                             f"expression, expected numbers, signals ({', '.join(o.OF)}), "
                             "parameters, + - * / ** and functions "
                             f"({', '.join(FUNCTIONS)})")

    def _constant(self, node: ast.Constant) -> None:
        value = node.value
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not _finite(value):
            raise ValueError(f"at character {node.col_offset + 1}: expected a finite number, got "
                             f"{str(value)[:40]!r}")
        self.codes.append(o.FIRST_CONSTANT + len(self.constants))
        self.constants.append(float(value))

    def _name(self, node: ast.Name) -> None:
        if node.id in o.OF:
            self.codes.append(o.FIRST_SIGNAL + o.OF.index(node.id))
            return
        if node.id in FUNCTIONS:
            raise ValueError(f"at character {node.col_offset + 1}: {node.id} is a function, "
                             f"expected {node.id}(...)")
        if node.id == "pi":
            self.codes.append(o.FIRST_CONSTANT + len(self.constants))
            self.constants.append(math.pi)
            return
        if node.id not in self.parameters:
            self.parameters[node.id] = len(self.constants)
            self.constants.append(None)
        self.codes.append(o.FIRST_CONSTANT + self.parameters[node.id])

    def _call(self, node: ast.Call, depth: int) -> None:
        name = node.func.id if isinstance(node.func, ast.Name) else ast.unparse(node.func)
        if name not in FUNCTIONS:
            raise ValueError(f"at character {node.col_offset + 1}: unknown function "
                             f"{name[:40]!r}, expected one of {', '.join(FUNCTIONS)}")
        wanted = 2 if name in o.TWO else 1
        if node.keywords or len(node.args) != wanted:
            raise ValueError(f"at character {node.col_offset + 1}: {name} takes {wanted} "
                             f"number{'s' if wanted > 1 else ''}")
        for i, argument in enumerate(node.args):
            self.visit(argument, depth + i)
        self.codes.append(o.FIRST_TWO + o.TWO.index(name) if wanted == 2 else o.ONE.index(name))


def _finite(value: float) -> bool:
    try:
        return math.isfinite(float(value))
    except OverflowError:
        return False
