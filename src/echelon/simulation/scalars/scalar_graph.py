"""Scalar operations as a graph: constants folded, equal operations shared, no dead code.

A node is a number that differs from agent to agent, or one that is the same for all of them, such
as the time. It is the result of an operation of `OPERATIONS` on other nodes, and the same operation
on the same operands is the same node. All vector code is generated from such a graph.
"""

import contextlib
import math
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from typing import Any, TypeAlias, final

import numpy as np

Entry: TypeAlias = "Node | float | bool"


def _divide(a: float, b: float) -> float:
    return float(np.divide(a, b))


# The result of each operation for plain numbers; each is an instruction of `codegen.vector_ir` too.
OPERATIONS: dict[str, Callable[..., Any]] = {
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    # A difference that is not fused with a product, so that it is the same wherever it is computed.
    "unfused_sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b,
    "div": _divide,
    # A quotient that is truncated: no product with an inverse replaces it, so that 49 / 49 is 1.
    "exact_div": _divide,
    # Sums with a product in one operation: a b + c, a b - c and c - a b.
    "fma": lambda a, b, c: a * b + c,
    "fms": lambda a, b, c: a * b - c,
    "fnma": lambda a, b, c: c - a * b,
    "neg": lambda a: -a,
    "abs": abs,
    "sqrt": lambda a: float(np.sqrt(a)),
    "floor": lambda a: float(np.floor(a)),
    "ceil": lambda a: float(np.ceil(a)),
    "rint": lambda a: float(np.rint(a)),
    "min": lambda a, b: float(np.minimum(a, b)),
    "max": lambda a, b: float(np.maximum(a, b)),
    "copysign": math.copysign,
    "lt": lambda a, b: a < b,
    "le": lambda a, b: a <= b,
    "eq": lambda a, b: a == b,
    "ne": lambda a, b: a != b,
    "and": lambda a, b: a and b,
    "or": lambda a, b: a or b,
    "xor": lambda a, b: a != b,
    "not": lambda a: not a,
    "select": lambda which, a, b: a if which else b,
    # 2^k, and the parts of |x| = m 2^e with m in [sqrt(1/2), sqrt(2)): by the bits of a number.
    "pow2": lambda k: float(np.ldexp(1.0, int(k))),
    # The last two bits of a number to which 1.5 2^52 was added (2^23 in single precision).
    "bit0": lambda x: int(x) % 2 == 1,
    "bit1": lambda x: int(x) // 2 % 2 == 1,
    "exponent": lambda x: float(np.round(np.log2(x))),
    "mantissa": lambda x: x / 2.0 ** float(np.round(np.log2(x))),
    # An estimate of 1 / sqrt(a), from which Newton's method starts.
    "root_guess": lambda a: float(1.0 / np.sqrt(a)),
    # To single precision, and back.
    "single": lambda a: float(np.float32(a)),
    # A truth that may also be assumed to hold always (`codegen.fast_path`).
    "unlikely": lambda a: a,
    # One that may not, since what it does not select has other last bits.
    "rare": lambda a: a,
}
TRUTHS = {"lt", "le", "eq", "ne", "and", "or", "xor", "not", "bit0", "bit1", "unlikely", "rare"}
_COMMUTE = {"add", "mul", "min", "max", "and", "or", "xor", "eq", "ne"}
LOGICAL = {"and", "or", "xor", "not", "unlikely", "rare"}
_NEVER_FOLDED = {"exponent", "mantissa", "bit0", "bit1", "root_guess"}


@final
class Node:
    """A scalar of a graph; Python's arithmetic on it returns other nodes.

    Attributes:
        graph: that it belongs to.
        number: its place; operands come before results.
        op: a key of `OPERATIONS`, `constant` or `leaf`; of a loop, `carried`, `loop` or `result`.
        args: its operands.
        value: the number of a constant, the name of a leaf; which loop, which of its numbers.
        uniform: whether it is the same for all agents.
        truth: whether it is true or false, and not a number.
        at_least_0: whether it is certainly not below 0; it may be NaN, or -0.
        verbatim: whether it is computed as it is written; otherwise sums may be rearranged.
    """

    __slots__ = (
        "args",
        "at_least_0",
        "graph",
        "number",
        "op",
        "truth",
        "uniform",
        "value",
        "verbatim",
    )
    __array_ufunc__ = None  # so that NumPy's numbers leave arithmetic with a node to the node

    def __init__(
        self, graph: "ScalarGraph", op: str, args: tuple["Node", ...], value: Any, uniform: bool
    ) -> None:
        self.graph, self.number, self.op = graph, len(graph.nodes), op
        self.args, self.value, self.uniform = args, value, uniform
        self.truth = op in TRUTHS or op == "constant" and isinstance(value, bool)
        if op == "select":
            self.truth = args[1].truth
        self.at_least_0 = _is_at_least_0(op, args, value)
        self.verbatim = False
        graph.nodes.append(self)

    def __add__(self, other: Entry) -> "Node":
        return self.graph.make("add", self, other)

    def __radd__(self, other: Entry) -> "Node":
        return self.graph.make("add", other, self)

    def __sub__(self, other: Entry) -> "Node":
        return self.graph.make("sub", self, other)

    def __rsub__(self, other: Entry) -> "Node":
        return self.graph.make("sub", other, self)

    def __mul__(self, other: Entry) -> "Node":
        return self.graph.make("mul", self, other)

    def __rmul__(self, other: Entry) -> "Node":
        return self.graph.make("mul", other, self)

    def __truediv__(self, other: Entry) -> "Node":
        return self.graph.make("div", self, other)

    def __rtruediv__(self, other: Entry) -> "Node":
        return self.graph.make("div", other, self)

    def __neg__(self) -> "Node":
        return self.graph.make("neg", self)


def _is_at_least_0(op: str, args: tuple[Node, ...], value: Any) -> bool:
    if op == "constant":
        return not math.isnan(value) and value >= 0.0
    signs = [a.at_least_0 for a in args]
    if op in ("add", "mul", "div", "min"):
        return all(signs) or op == "mul" and args[0] is args[1]
    return op in ("sqrt", "abs", "pow2") or op == "max" and any(signs)


@final
class ScalarGraph:
    """Nodes, each once.

    Attributes:
        bits: 64 or 32, the precision of the code that is generated from it.
        loops: how many loops it has, whose ends depend on numbers; None where it may have none.
        exceptions: node -> a truth; where it holds, the node is not what JAX computes.
        ranges: node -> the least and the largest number that it may be.
    """

    def __init__(self, bits: int = 64, loops: bool = False) -> None:
        self.bits, self.nodes, self._verbatim = bits, list[Node](), False
        self.loops = 0 if loops else None
        self.exceptions = dict[Node, Node]()
        self.ranges = dict[Node, tuple[float, float]]()
        self._by_key: dict[Hashable, Node] = {}

    def constant(self, value: float | bool) -> Node:
        """Return a plain number as a node."""
        value = bool(value) if isinstance(value, bool | np.bool_) else float(value)
        if self.bits == 32 and not isinstance(value, bool):
            # As JAX folds constants; a large one becomes infinite.
            with np.errstate(over="ignore"):
                value = float(np.float32(value))
        # By its bits: 0 and -0 are two numbers, and NaN is one.
        key = value if isinstance(value, bool) else np.float64(value).tobytes()
        return self._once(("constant", type(value), key), "constant", (), value)

    def leaf(self, *name: str | int, uniform: bool = False) -> Node:
        """Return a number that is read from memory under a name."""
        return self._once(("leaf", name), "leaf", (), name, uniform)

    def except_where(self, node: Node, truth: Node) -> None:
        """Note that a node is not what JAX computes where a truth holds."""
        if truth.op != "constant" or truth.value:
            self.exceptions[node] = truth

    def exceptions_of(self, results: Iterable[Node]) -> list[Node]:
        """Return the truths of which one holds where results are not what JAX computes."""
        truths, known = [self.exceptions.get(n) for n in needed(results)], dict[Node, None]()
        known.update((truth, None) for truth in truths if truth is not None)
        return list(known)

    def make(self, op: str, *operands: Entry) -> Node:
        """Return the result of an operation, simplified if possible."""
        # Called 30,000 times for a model of 12 states: lists take half as long as generators.
        args = tuple([a if isinstance(a, Node) else self.constant(a) for a in operands])
        numbers = [a.value for a in args if a.op == "constant"]
        if len(numbers) == len(args) and op not in _NEVER_FOLDED:
            with np.errstate(all="ignore"):
                return self.constant(OPERATIONS[op](*numbers))
        simplify = _SIMPLER.get(op)
        simpler = None if simplify is None else simplify(*args)
        if simpler is not None:
            return simpler
        if op in _COMMUTE and args[0].number > args[1].number:
            args = args[::-1]
        return self._once((op, *[a.number for a in args]), op, args)

    def carried(self, loop: int, place: int) -> Node:
        """Return a number that a loop carries from round to round."""
        return self._once(("carried", loop, place), "carried", (), (loop, place), uniform=False)

    def loop(
        self, loop: int, begin: Sequence[Node], test: Node, after: Sequence[Node]
    ) -> list[Node]:
        """Return what the numbers of a loop are at last, which are `begin` at first.

        As long as `test` holds they become `after`. Both are nodes of this graph, which depend on
        what the loop carries.
        """
        args = (*begin, test, *after)
        key = ("loop", loop, *[a.number for a in args])
        node = self._once(key, "loop", args, loop, uniform=False)
        results = range(len(begin))
        return [self._once(("result", node.number, k), "result", (node,), k) for k in results]

    def again(self, node: Node, args: Sequence[Node]) -> Node:
        """Return a node with other operands."""
        if node.op not in ("loop", "result"):
            return self.make(node.op, *args)
        key = (node.op, node.value, *[a.number for a in args])
        return self._once(key, node.op, tuple(args), node.value)

    def _once(
        self,
        key: Hashable,
        op: str,
        args: tuple[Node, ...],
        value: Any = None,
        uniform: bool = True,
    ) -> Node:
        node = self._by_key.get(key)
        if node is None:
            uniform = uniform and all([a.uniform for a in args])
            node = self._by_key[key] = Node(self, op, args, value, uniform)
        if self._verbatim:
            node.verbatim = True
        return node

    @contextlib.contextmanager
    def verbatim(self) -> Iterator[None]:
        """Mark new nodes as `verbatim`: each rounding is where the author intended it."""
        before, self._verbatim = self._verbatim, True
        try:
            yield
        finally:
            self._verbatim = before


def needed(results: Iterable[Node]) -> list[Node]:
    """Return the nodes that results depend on, operands first."""
    # Not a set: nodes of two graphs may have the same number, and their order must not vary.
    reached, todo = dict[Node, None](), list(results)
    while todo:
        node = todo.pop()
        if node not in reached:
            reached[node] = None
            todo += node.args
    return sorted(reached, key=lambda node: node.number)


def within(loop: int, results: Iterable[Node]) -> dict[Node, bool]:
    """Return of each node that results depend on whether it changes from round to round."""
    inside = dict[Node, bool]()
    for node in needed(results):
        carried = node.op == "carried" and node.value[0] == loop
        own = node.op == "loop" and node.value == loop
        inside[node] = carried or not own and any([inside[a] for a in node.args])
    return inside


Instead: TypeAlias = Callable[[Node, Sequence[Node]], Node | float | bool | None]
"""(node, its new operands) -> its replacement; None if the operation stays."""


def rewritten(results: Iterable[Node], instead: Instead) -> dict[Node, Node]:
    """Return each needed node with some nodes replaced, folded again."""
    after = dict[Node, Node]()
    for node in needed(results):
        args = [after[a] for a in node.args]
        other = instead(node, args)
        if other is not None:
            after[node] = other if isinstance(other, Node) else node.graph.constant(other)
        elif not args:
            after[node] = node
        else:
            after[node] = node.graph.again(node, args)
            after[node].verbatim |= node.verbatim
    return after


# ---- simplifications -----------------------------------------------------------------------------
#
# 0 x is 0 for every finite x. If x is NaN, this hides it in one entry of a sum; frames are checked
# for NaN in all entries.


def _is(node: Node, value: float) -> bool:
    return node.op == "constant" and not node.truth and node.value == value


def _sum(a: Node, b: Node) -> Node | None:
    if _is(a, 0.0) or _is(b, 0.0):
        return b if _is(a, 0.0) else a
    if b.op == "neg":
        return a - b.args[0]
    return b - a.args[0] if a.op == "neg" else None


def _difference(a: Node, b: Node) -> Node | None:
    if _is(b, 0.0):
        return a
    if _is(a, 0.0):
        return -b
    return a + b.args[0] if b.op == "neg" else None


def _product(a: Node, b: Node) -> Node | None:
    for one, other in ((a, b), (b, a)):
        if _is(one, 0.0):
            return one
        if _is(one, 1.0):
            return other
        if _is(one, -1.0):
            return -other
    if a.op == "neg" and b.op == "neg":
        return a.args[0] * b.args[0]
    return None


def _fused(op: str) -> Callable[[Node, Node, Node], Node | None]:
    def simpler(a: Node, b: Node, c: Node) -> Node | None:
        product = a * b if a.op == b.op == "constant" else _product(a, b)
        if product is None and _is(c, 0.0):
            product = a * b
        return None if product is None else OPERATIONS[op](product, 1.0, c)

    return simpler


def _quotient(a: Node, b: Node) -> Node | None:
    if _is(a, 0.0) or _is(b, 1.0):
        return a
    # A power of two has an exact inverse; of other constants the product may differ by an ulp.
    if b.op == "constant" and b.value and math.isfinite(1.0 / b.value):
        return a * (1.0 / b.value)
    return None


def _negation(a: Node) -> Node | None:
    if a.op == "neg":
        return a.args[0]
    return a.args[1] - a.args[0] if a.op == "sub" else None


def _choice(which: Node, a: Node, b: Node) -> Node | None:
    if which.op == "constant":
        return a if which.value else b
    if a is b:
        return a
    if which.op == "not":
        return which.graph.make("select", which.args[0], b, a)
    return None


def _both(a: Node, b: Node) -> Node | None:
    for one, other in ((a, b), (b, a)):
        if one.op == "constant":
            return other if one.value else one
        if one.op == "not" and one.args[0] is other:
            return one.graph.constant(False)
    return a if a is b else None


def _either(a: Node, b: Node) -> Node | None:
    for one, other in ((a, b), (b, a)):
        if one.op == "constant":
            return one if one.value else other
    return a if a is b else None


def _at_most(a: Node, b: Node) -> Node | None:
    """Return sqrt(x) <= b as x <= the largest number whose root is at most b; or of two truths."""
    if a.truth:
        return a.graph.make("or", a.graph.make("not", a), b)
    if a.op != "sqrt" or b.op != "constant" or not b.value > 0.0 or not a.args[0].at_least_0:
        return None
    kind = np.float64 if a.graph.bits == 64 else np.float32
    bound = kind(b.value)
    most = bound * bound
    # Rounded roots do not decrease, so a few steps find the last one.
    for _ in range(8):
        most = np.nextafter(most, kind(np.inf))
    while np.sqrt(most) > bound:
        most = np.nextafter(most, kind(0.0))
    return a.graph.make("le", a.args[0], float(most))


_SIMPLER: dict[str, Callable[..., Node | None]] = {
    "add": _sum,
    "sub": _difference,
    "mul": _product,
    "div": _quotient,
    **{op: _fused(op) for op in ("fma", "fms", "fnma")},
    "neg": _negation,
    "abs": lambda a: a if a.op == "abs" else None,
    "eq": lambda a, b: a.graph.make("not", a.graph.make("xor", a, b)) if a.truth else None,
    "ne": lambda a, b: a.graph.make("xor", a, b) if a.truth else None,
    # Of truths, of which true is the larger one.
    "max": lambda a, b: a.graph.make("or", a, b) if a.truth else None,
    "min": lambda a, b: a.graph.make("and", a, b) if a.truth else None,
    "lt": lambda a, b: a.graph.make("and", a.graph.make("not", a), b) if a.truth else None,
    "le": _at_most,
    "not": lambda a: a.args[0] if a.op == "not" else None,
    "select": _choice,
    "and": _both,
    "or": _either,
}
