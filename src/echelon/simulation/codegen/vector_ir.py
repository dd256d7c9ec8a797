"""A graph of scalars as LLVM's instructions on vectors, whose lanes are agents.

Text and not an object per instruction: a model's step is a thousand of them. The same for all
agents is computed once, as a scalar. What only one side of a choice needs, and is much, stands
behind a branch that is taken where any lane takes that side.
"""

import math
import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import final

from echelon.simulation.codegen.branches import Branch, arms
from echelon.simulation.codegen.scheduling import lateness, one_by_one
from echelon.simulation.scalars.scalar_graph import Node, needed

_INSTRUCTIONS = {
    **{name: f"f{name} {{T}} {{0}}, {{1}}" for name in ("add", "sub", "mul", "div")},
    "fma": "call {T} @llvm.fmuladd.{S}({T} {0}, {T} {1}, {T} {2})",
    "apart": "fsub {T} {0}, {1}",
    "over": "fdiv {T} {0}, {1}",
    "neg": "fneg {T} {0}",
    **{
        name: f"call {{T}} @llvm.{full}.{{S}}({{T}} {{0}})"
        for name, full in {
            "abs": "fabs",
            "sqrt": "sqrt",
            "floor": "floor",
            "ceil": "ceil",
            "rint": "rint",
        }.items()
    },
    **{
        # Not `minnum`: a lost agent's NaN must not become a number again.
        name: f"call {{T}} @llvm.{full}.{{S}}({{T}} {{0}}, {{T}} {{1}})"
        for name, full in {"min": "minimum", "max": "maximum", "copysign": "copysign"}.items()
    },
    "lt": "fcmp olt {A} {0}, {1}",
    "le": "fcmp ole {A} {0}, {1}",
    "eq": "fcmp oeq {A} {0}, {1}",
    "ne": "fcmp une {A} {0}, {1}",
    "and": "and {T} {0}, {1}",
    "or": "or {T} {0}, {1}",
    "xor": "xor {T} {0}, {1}",
}

_TAKEN_OFF = {"fms": 2, "fnma": 0}
"""What of a product and a sum is turned about; a processor does that by the way."""


def number(value: float, bits: int) -> str:
    """Return a number as LLVM writes it, to the bit."""
    if bits == 32:
        value = struct.unpack("f", struct.pack("f", _as_single(value)))[0]
    return f"0x{struct.unpack('Q', struct.pack('d', value))[0]:016X}"


def _as_single(value: float) -> float:
    """Return a number that single precision can hold: what is too large is infinite."""
    if math.isfinite(value) and abs(value) > 3.4028235677973366e38:
        return math.copysign(math.inf, value)
    return value


@final
class Writer:
    """Writes the instructions of a function.

    Args:
        bits: 64 or 32, of a number.
        lanes: of a vector; 1 writes scalars throughout.
    """

    def __init__(self, bits: int, lanes: int) -> None:
        self.bits, self.lanes, self.lines = bits, lanes, list[str]()
        self.scalar = "double" if bits == 64 else "float"
        self.vector = f"<{lanes} x {self.scalar}>"
        self.declared = set[str]()
        self._count = 0

    # ---- types and names ----

    def kind(self, truth: bool, uniform: bool) -> str:
        """Return the type of a value."""
        one = "i1" if truth else self.scalar
        return one if uniform else f"<{self.lanes} x {one}>"

    def suffix(self, uniform: bool) -> str:
        """Return how LLVM's own functions name a type."""
        one = f"f{self.bits}"
        return one if uniform else f"v{self.lanes}{one}"

    def fresh(self, stem: str = "v") -> str:
        """Return a name that is not taken."""
        self._count += 1
        return f"{stem}{self._count}"

    def put(self, instruction: str) -> str:
        """Write an instruction and return the name of its result."""
        name = "%" + self.fresh()
        self.lines.append(f"  {name} = {instruction}")
        return name

    def do(self, instruction: str) -> None:
        """Write an instruction without a result."""
        self.lines.append(f"  {instruction}")

    def label(self, name: str) -> None:
        """Begin a block."""
        self.lines.append(f"{name}:")

    def declare(self, result: str, name: str, *arguments: str) -> None:
        """Declare one of LLVM's own functions."""
        self.declared.add(f"declare {result} @{name}({', '.join(arguments)})")

    def splat(self, value: str, truth: bool = False) -> str:
        """Return a vector with the same scalar in all lanes."""
        one, many = self.kind(truth, True), self.kind(truth, False)
        first = self.put(f"insertelement {many} poison, {one} {value}, i32 0")
        zeros = f"<{self.lanes} x i32> zeroinitializer"
        return self.put(f"shufflevector {many} {first}, {many} poison, {zeros}")

    # ---- nodes ----

    def constant(self, node: Node, uniform: bool) -> str:
        """Return a constant as an operand."""
        if node.truth:
            one = "true" if node.value else "false"
            return one if uniform else f"splat (i1 {one})"
        one = number(node.value, self.bits)
        return one if uniform else f"splat ({self.scalar} {one})"

    def operation(self, op: str, args: Sequence[str], truth: bool, uniform: bool) -> str:
        """Write an operation and return its result; `truth` is that of its operands."""
        real, own = self.kind(False, uniform), self.kind(truth, uniform)
        suffix = self.suffix(uniform)
        if op in _BITS:
            return _BITS[op](self, args[0], uniform)
        if op == "not":
            return self.put(f"xor {own} {args[0]}, {'true' if uniform else 'splat (i1 true)'}")
        if op in _TAKEN_OFF:
            place = _TAKEN_OFF[op]
            turned = self.put(f"fneg {own} {args[place]}")
            args, op = [*args[:place], turned, *args[place + 1 :]], "fma"
        pattern = _INSTRUCTIONS[op]
        if "@" in pattern:
            name = pattern[pattern.index("@") + 1 : pattern.index("(")].format(S=suffix)
            self.declare(real, name, *[real] * len(args))
        return self.put(pattern.format(*args, T=own, A=real, S=suffix))

    def _integers(self, uniform: bool) -> str:
        return f"i{self.bits}" if uniform else f"<{self.lanes} x i{self.bits}>"

    def integer(self, value: int, uniform: bool) -> str:
        """Return a whole number as an operand."""
        return str(value) if uniform else f"splat (i{self.bits} {value})"


def _pow2(w: Writer, k: str, uniform: bool) -> str:
    """Write 2^k for whole k: its bits are k plus the bias, shifted."""
    bits, real, whole = w.bits, w.kind(False, uniform), w._integers(uniform)
    mantissa, bias = (52, 1023) if bits == 64 else (23, 127)
    # Adding 1.5 2^mantissa leaves a whole number in the last bits.
    magic = number(1.5 * 2.0**mantissa + bias, bits)
    shift = magic if uniform else f"splat ({w.scalar} {magic})"
    moved = w.put(f"fadd {real} {k}, {shift}")
    as_bits = w.put(f"bitcast {real} {moved} to {whole}")
    shifted = w.put(f"shl {whole} {as_bits}, {w.integer(mantissa, uniform)}")
    return w.put(f"bitcast {whole} {shifted} to {real}")


def _split(w: Writer, x: str, uniform: bool) -> tuple[str, str]:
    """Write e and m of |x| = m 2^e with m in [sqrt(1/2), sqrt(2)), as whole numbers of bits."""
    bits, real, whole = w.bits, w.kind(False, uniform), w._integers(uniform)
    mantissa = 52 if bits == 64 else 23
    form, other = ("d", "q") if bits == 64 else ("f", "i")
    root = struct.unpack(other, struct.pack(form, math.sqrt(0.5)))[0]
    as_bits = w.put(f"bitcast {real} {x} to {whole}")
    away = w.put(f"sub {whole} {as_bits}, {w.integer(root, uniform)}")
    e = w.put(f"ashr {whole} {away}, {w.integer(mantissa, uniform)}")
    back = w.put(f"shl {whole} {e}, {w.integer(mantissa, uniform)}")
    return e, w.put(f"sub {whole} {as_bits}, {back}")


def _exponent(w: Writer, x: str, uniform: bool) -> str:
    e, _ = _split(w, x, uniform)
    return w.put(f"sitofp {w._integers(uniform)} {e} to {w.kind(False, uniform)}")


def _mantissa(w: Writer, x: str, uniform: bool) -> str:
    _, m = _split(w, x, uniform)
    return w.put(f"bitcast {w._integers(uniform)} {m} to {w.kind(False, uniform)}")


def _root_guess(w: Writer, x: str, uniform: bool) -> str:
    """Write 1 / sqrt(x) to a thirtieth: its bits less half of those of x (Lomont, 2003)."""
    real, whole = w.kind(False, uniform), w._integers(uniform)
    start = 0x5FE6EB50C7B537A9 if w.bits == 64 else 0x5F375A86
    as_bits = w.put(f"bitcast {real} {x} to {whole}")
    half = w.put(f"lshr {whole} {as_bits}, {w.integer(1, uniform)}")
    near = w.put(f"sub {whole} {w.integer(start, uniform)}, {half}")
    return w.put(f"bitcast {whole} {near} to {real}")


def _bit(place: int) -> Callable[[Writer, str, bool], str]:
    """Return what writes whether a bit of a number is set."""

    def write(w: Writer, x: str, uniform: bool) -> str:
        real, whole = w.kind(False, uniform), w._integers(uniform)
        as_bits = w.put(f"bitcast {real} {x} to {whole}")
        kept = w.put(f"and {whole} {as_bits}, {w.integer(1 << place, uniform)}")
        return w.put(f"icmp ne {whole} {kept}, {w.integer(0, uniform)}")

    return write


_BITS: dict[str, Callable[[Writer, str, bool], str]] = {
    "pow2": _pow2,
    "exponent": _exponent,
    "mantissa": _mantissa,
    "root_guess": _root_guess,
    "bit0": _bit(0),
    "bit1": _bit(1),
}


@final
class Emitter:
    """Writes nodes, each once, where a leaf's value is asked from a function.

    Args:
        writer: to write to.
        load: leaf -> its value, written when it is first needed.
    """

    def __init__(self, writer: Writer, load: Callable[[Node], str]) -> None:
        self.writer, self.load = writer, load
        self.values: dict[Node, str] = {}
        self._wide: dict[Node, str] = {}

    def emit(self, results: Sequence[Node]) -> None:
        """Write all that results rest on."""
        nodes = needed(results)
        # The same for all agents first: it stands before every branch, and outside of all.
        self._write([n for n in nodes if n.uniform])
        self._write_with_branches([n for n in nodes if not n.uniform], results)

    def emit_usual(
        self, results: Sequence[Node], levels: Sequence[Sequence[Node]], otherwise: str
    ) -> None:
        """Write all that results rest on, and go to a label where a truth of a level holds."""
        nodes = needed([*results, *(node for level in levels for node in level)])
        self._write([n for n in nodes if n.uniform])
        rest, late = [n for n in nodes if not n.uniform], lateness(nodes)
        for level in levels:
            wanted = [n for n in one_by_one(level, late) if not n.uniform]
            rest = self._early(wanted, rest, results)
            self._leave(level, otherwise)
        self._write(n for n in one_by_one(results, late) if not n.uniform)

    def _early(
        self, wanted: Sequence[Node], rest: Sequence[Node], results: Sequence[Node]
    ) -> list[Node]:
        """Write what is wanted, and what then takes fewer registers than it frees; return others.

        A sum over the stages of an integrator is such: it would hold all of them to the end.
        """
        self._write(wanted)
        left = [n for n in rest if n not in self.values]
        users = dict[Node, int]()
        for node in left:
            for a in set(node.args):
                users[a] = users.get(a, 0) + 1
        kept, others = set(results), list[Node]()
        for node in left:
            ready = node.args and all(
                a in self.values or a.op in ("constant", "leaf") for a in node.args
            )
            held = {a for a in node.args if not a.uniform and a.op != "leaf" and a not in kept}
            if ready and sum(users[a] == 1 for a in held) >= 1:
                self._write([a for a in node.args if a.op == "leaf"])
                self._write([node])
                for a in set(node.args):
                    users[a] -= 1
            else:
                others.append(node)
        return [n for n in others if n not in self.values]

    def _leave(self, level: Sequence[Node], otherwise: str) -> None:
        """Write a branch that is taken where one of some truths holds in any lane."""
        w, truths = self.writer, self.writer.kind(True, False)
        name = f"llvm.vector.reduce.or.v{w.lanes}i1"
        w.declare("i1", name, truths)
        found = list[str]()
        bounds = dict[float, str]()
        for node in level:
            if node.op == "lt" and node.args[0].op == "constant":
                value, x = node.args[0].value, self.value(node.args[1])
                if value in bounds:
                    more = w.put(f"fcmp ogt {w.vector} {x}, {bounds[value]}")
                    x = w.put(f"select {truths} {more}, {w.vector} {x}, {w.vector} {bounds[value]}")
                bounds[value] = x
            else:
                found.append(self.value(node))
        for value, x in bounds.items():
            bound = f"splat ({w.scalar} {number(value, w.bits)})"
            # Of what is no number as well: the other code looks at it lane by lane.
            found.append(w.put(f"fcmp ugt {w.vector} {x}, {bound}"))
        one = found[0]
        for other in found[1:]:
            one = w.put(f"or {truths} {one}, {other}")
        some, after = w.put(f"call i1 @{name}({truths} {one})"), w.fresh("usual")
        w.do(f"br i1 {some}, label %{otherwise}, label %{after}, !prof !0")
        w.label(after)

    def value(self, node: Node, uniform: bool = False) -> str:
        """Return the operand that a node is, for scalars or for vectors."""
        if node.op == "constant":
            return self.writer.constant(node, uniform)
        if node.uniform and not uniform:
            return self._spread(node)
        return self.values[node]

    def _spread(self, node: Node) -> str:
        if node not in self._wide:
            self._wide[node] = self.writer.splat(self.values[node], node.truth)
        return self._wide[node]

    def _write(self, nodes: Iterable[Node]) -> None:
        for node in nodes:
            if node in self.values or node.op == "constant":
                continue
            if node.op == "leaf":
                self.values[node] = self.load(node)
                continue
            self.values[node] = self._operation(node)

    def _operation(self, node: Node) -> str:
        w, uniform = self.writer, node.uniform
        args = [self.value(a, uniform) for a in node.args]
        if node.op == "select":
            which, kind = w.kind(True, uniform), w.kind(node.truth, uniform)
            return w.put(f"select {which} {args[0]}, {kind} {args[1]}, {kind} {args[2]}")
        return w.operation(node.op, args, node.args[0].truth, uniform)

    # ---- branches ----

    def _write_with_branches(self, nodes: list[Node], results: Sequence[Node]) -> None:
        """Write nodes in order; those that one side of a choice alone needs, behind a branch."""
        owned = {node: arm for arm in arms(nodes, results) for node in arm.nodes}
        self._write_in_order(nodes, owned)

    def _write_in_order(self, nodes: Iterable[Node], owned: Mapping[Node, Branch]) -> None:
        """Write nodes that no arm owns; before what reads of an arm, the arm behind its branch."""
        for node in nodes:
            if node in owned or node in self.values:
                continue
            for arm in dict.fromkeys(owned[a] for a in node.args if a in owned):
                if arm.nodes[0] not in self.values:
                    # Arms rest on no choice of their own, so that this comes to an end.
                    rest = needed([arm.which, *arm.nodes])
                    self._write_in_order([n for n in rest if owned.get(n) is not arm], owned)
                    self._branch(arm)
            self._write([node])

    def _branch(self, arm: Branch) -> None:
        """Write an arm behind a branch, and what it leaves as values that hold after it."""
        w, which = self.writer, self.value(arm.which)
        truths = f"<{w.lanes} x i1>"
        name = f"llvm.vector.reduce.or.v{w.lanes}i1"
        w.declare("i1", name, truths)
        taken = which if arm.side else w.put(f"xor {truths} {which}, splat (i1 true)")
        some = w.put(f"call i1 @{name}({truths} {taken})")
        before, inside, after = (w.fresh(stem) for stem in ("from", "take", "join"))
        # Leaves that only the arm reads are loaded in it, and no further.
        w.do(f"br label %{before}")
        w.label(before)
        w.do(f"br i1 {some}, label %{inside}, label %{after}")
        w.label(inside)
        # What is spread over the lanes in here does not hold after it.
        wide = dict(self._wide)
        self._write(arm.nodes)
        self._wide = wide
        end = w.fresh("end")
        w.do(f"br label %{end}")
        w.label(end)
        w.do(f"br label %{after}")
        w.label(after)
        for node in arm.left:
            kind = w.kind(node.truth, False)
            held = f"[ {self.values[node]}, %{end} ], [ zeroinitializer, %{before} ]"
            self.values[node] = w.put(f"phi {kind} {held}")
