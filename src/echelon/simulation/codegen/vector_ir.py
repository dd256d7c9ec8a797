"""LLVM's instructions as text: numbers in the lanes of vectors, loads and stores.

Text and not an object per instruction: the step of a model is a thousand of them.
"""

import contextlib
import functools
import math
import struct
from collections.abc import Callable, Iterator, Sequence
from typing import final

from echelon.simulation.scalars import Node

_INSTRUCTIONS = {
    **{name: f"f{name} {{T}} {{0}}, {{1}}" for name in ("add", "sub", "mul", "div")},
    "fma": "call {T} @llvm.fmuladd.{S}({T} {0}, {T} {1}, {T} {2})",
    "unfused_sub": "fsub {T} {0}, {1}",
    "exact_div": "fdiv {T} {0}, {1}",
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
        # Not `minnum`: the NaN of a diverged agent must not become a number again.
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

_NEGATED = {"fms": 2, "fnma": 0}
"""Which operand of a fused operation is negated; a processor does that at no cost."""


def _as_single(value: float) -> float:
    """Return a number that single precision can hold; too large ones become infinite."""
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

    def integers(self, uniform: bool) -> str:
        """Return the type of whole numbers with as many bits as a number."""
        return f"i{self.bits}" if uniform else f"<{self.lanes} x i{self.bits}>"

    def fresh(self, stem: str = "v") -> str:
        """Return an unused name."""
        self._count += 1
        return f"{stem}{self._count}"

    # ---- instructions ----

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

    def splat(self, value: str, kind: str = "") -> str:
        """Write a vector with the same scalar in all lanes, a number unless a type is given."""
        one = kind or self.scalar
        many = f"<{self.lanes} x {one}>"
        first = self.put(f"insertelement {many} poison, {one} {value}, i32 0")
        zeros = f"<{self.lanes} x i32> zeroinitializer"
        return self.put(f"shufflevector {many} {first}, {many} poison, {zeros}")

    def any_lane(self, truths: str) -> str:
        """Write whether a truth holds in any lane."""
        name, kind = f"llvm.vector.reduce.or.v{self.lanes}i1", self.kind(True, False)
        self.declare("i1", name, kind)
        return self.put(f"call i1 @{name}({kind} {truths})")

    # ---- memory ----

    def at(self, kind: str, base: str, index: str | int) -> str:
        """Write the address of a place behind another, counted in values of a type."""
        return self.put(f"getelementptr {kind}, ptr {base}, i64 {index}")

    def part(self, base: str, number: str, size: str | int, kind: str = "") -> str:
        """Write the address of a part, of parts with so many numbers (or values of a type) each."""
        far = self.put(f"mul i64 {number}, {size}")
        return self.at(kind or self.scalar, base, far)

    def load(self, kind: str, base: str, *index: str | int) -> str:
        """Write the load of a value, from places behind each other counted in its numbers."""
        element, alignment = self._layout(kind)
        for place in index:
            base = self.at(element, base, place)
        return self.put(f"load {kind}, ptr {base}{alignment}")

    def store(self, kind: str, value: str, base: str, *index: str | int) -> None:
        """Write the store of a value, at places behind each other counted in its numbers."""
        element, alignment = self._layout(kind)
        for place in index:
            base = self.at(element, base, place)
        self.do(f"store {kind} {value}, ptr {base}{alignment}")

    def load_row(self, base: str, row: int) -> str:
        """Write the load of a row of a block."""
        return self.load(self.vector, base, row * self.lanes)

    def store_row(self, value: str, base: str, row: int) -> None:
        """Write the store of a row of a block."""
        self.store(self.vector, value, base, row * self.lanes)

    def load_place(self, places: str, *index: str | int) -> str:
        """Write the load of a whole number of 32 bits from a list, as 64 bits."""
        return self.put(f"sext i32 {self.load('i32', places, *index)} to i64")

    def _layout(self, kind: str) -> tuple[str, str]:
        """Return the type of the numbers of a value, and how its address is aligned."""
        count, _, element = kind.strip("<>").rpartition(" x ")
        if element == "i32":
            return element, ", align 4"
        return element, f", align {int(count) * self.bits // 8}" if count else ""

    # ---- nodes ----

    def number(self, value: float, uniform: bool = False) -> str:
        """Return a plain number as an operand, to the bit."""
        if self.bits == 32:
            value = struct.unpack("f", struct.pack("f", _as_single(value)))[0]
        one = f"0x{struct.unpack('Q', struct.pack('d', value))[0]:016X}"
        return one if uniform else f"splat ({self.scalar} {one})"

    def constant(self, node: Node, uniform: bool) -> str:
        """Return a constant as an operand."""
        if not node.truth:
            return self.number(node.value, uniform)
        one = "true" if node.value else "false"
        return one if uniform else f"splat (i1 {one})"

    def integer(self, value: int, uniform: bool) -> str:
        """Return a whole number as an operand."""
        return str(value) if uniform else f"splat (i{self.bits} {value})"

    def operation(
        self, op: str, args: Sequence[str], truth: bool = False, uniform: bool = False
    ) -> str:
        """Write an operation and return its result; `truth` is that of its operands."""
        real, kind = self.kind(False, uniform), self.kind(truth, uniform)
        if op in _BITS:
            return _BITS[op](self, args[0], uniform)
        if op == "not":
            return self.put(f"xor {kind} {args[0]}, {'true' if uniform else 'splat (i1 true)'}")
        if op in _NEGATED:
            place = _NEGATED[op]
            negative = self.put(f"fneg {kind} {args[place]}")
            args, op = [*args[:place], negative, *args[place + 1 :]], "fma"
        pattern, suffix = _INSTRUCTIONS[op], f"{'' if uniform else f'v{self.lanes}'}f{self.bits}"
        if "@" in pattern:
            name = pattern[pattern.index("@") + 1 : pattern.index("(")].format(S=suffix)
            self.declare(real, name, *[real] * len(args))
        return self.put(pattern.format(*args, T=kind, A=real, S=suffix))


def _pow2(w: Writer, k: str, uniform: bool) -> str:
    """Write 2^k for whole k: its bits are k plus the bias, shifted."""
    real, whole = w.kind(False, uniform), w.integers(uniform)
    mantissa, bias = (52, 1023) if w.bits == 64 else (23, 127)
    # Adding 1.5 2^mantissa leaves a whole number in the last bits.
    magic = w.number(1.5 * 2.0**mantissa + bias, uniform)
    moved = w.put(f"fadd {real} {k}, {magic}")
    as_bits = w.put(f"bitcast {real} {moved} to {whole}")
    shifted = w.put(f"shl {whole} {as_bits}, {w.integer(mantissa, uniform)}")
    return w.put(f"bitcast {whole} {shifted} to {real}")


def _split(w: Writer, x: str, uniform: bool) -> tuple[str, str]:
    """Write e and m of |x| = m 2^e with m in [sqrt(1/2), sqrt(2)), as whole numbers of bits."""
    real, whole = w.kind(False, uniform), w.integers(uniform)
    mantissa = 52 if w.bits == 64 else 23
    form, other = ("d", "q") if w.bits == 64 else ("f", "i")
    root = struct.unpack(other, struct.pack(form, math.sqrt(0.5)))[0]
    as_bits = w.put(f"bitcast {real} {x} to {whole}")
    away = w.put(f"sub {whole} {as_bits}, {w.integer(root, uniform)}")
    e = w.put(f"ashr {whole} {away}, {w.integer(mantissa, uniform)}")
    back = w.put(f"shl {whole} {e}, {w.integer(mantissa, uniform)}")
    return e, w.put(f"sub {whole} {as_bits}, {back}")


def _exponent(w: Writer, x: str, uniform: bool) -> str:
    e, _ = _split(w, x, uniform)
    return w.put(f"sitofp {w.integers(uniform)} {e} to {w.kind(False, uniform)}")


def _mantissa(w: Writer, x: str, uniform: bool) -> str:
    _, m = _split(w, x, uniform)
    return w.put(f"bitcast {w.integers(uniform)} {m} to {w.kind(False, uniform)}")


def _root_guess(w: Writer, x: str, uniform: bool) -> str:
    """Write 1 / sqrt(x) to a thirtieth: a constant less half of the bits of x (Lomont, 2003)."""
    real, whole = w.kind(False, uniform), w.integers(uniform)
    start = 0x5FE6EB50C7B537A9 if w.bits == 64 else 0x5F375A86
    as_bits = w.put(f"bitcast {real} {x} to {whole}")
    half = w.put(f"lshr {whole} {as_bits}, {w.integer(1, uniform)}")
    guess = w.put(f"sub {whole} {w.integer(start, uniform)}, {half}")
    return w.put(f"bitcast {whole} {guess} to {real}")


def _bit(w: Writer, x: str, uniform: bool, place: int) -> str:
    real, whole = w.kind(False, uniform), w.integers(uniform)
    as_bits = w.put(f"bitcast {real} {x} to {whole}")
    masked = w.put(f"and {whole} {as_bits}, {w.integer(1 << place, uniform)}")
    return w.put(f"icmp ne {whole} {masked}, {w.integer(0, uniform)}")


def _single(w: Writer, x: str, uniform: bool) -> str:
    real, one = w.kind(False, uniform), "float" if uniform else f"<{w.lanes} x float>"
    return w.put(f"fpext {one} {w.put(f'fptrunc {real} {x} to {one}')} to {real}")


_BITS: dict[str, Callable[[Writer, str, bool], str]] = {
    "pow2": _pow2,
    "exponent": _exponent,
    "mantissa": _mantissa,
    "root_guess": _root_guess,
    "single": _single,
    "bit0": functools.partial(_bit, place=0),
    "bit1": functools.partial(_bit, place=1),
}


# ---- loops, choices, and numbers at listed places ------------------------------------------------


@contextlib.contextmanager
def loop(
    w: Writer, start: str, end: str, carried: Sequence[tuple[str, str]] = ()
) -> Iterator[tuple[str, list[str], list[str]]]:
    """Write a loop; yield its index, its carried values, and a list for their next values.

    After the loop the carried values are in the same list.
    """
    before, head, body, after = (w.fresh(s) for s in ("before", "head", "body", "after"))
    index = "%" + w.fresh("i")
    names = ["%" + w.fresh("c") for _ in carried]
    w.do(f"br label %{before}")
    w.label(before)
    w.do(f"br label %{head}")
    w.label(head)
    place = len(w.lines)
    w.lines += [""] * (1 + len(carried))
    more = w.put(f"icmp slt i64 {index}, {end}")
    w.do(f"br i1 {more}, label %{body}, label %{after}")
    w.label(body)
    following = list(names)
    yield index, names, following
    final, latch = w.put(f"add i64 {index}, 1"), w.fresh("latch")
    w.do(f"br label %{latch}")
    w.label(latch)
    w.do(f"br label %{head}")
    values = [("i64", start), *carried], [index, *names], [final, *following]
    for k, ((kind, first), name, new) in enumerate(zip(*values, strict=True)):
        w.lines[place + k] = f"  {name} = phi {kind} [ {first}, %{before} ], [ {new}, %{latch} ]"
    w.label(after)


@contextlib.contextmanager
def only_if(w: Writer, condition: str) -> Iterator[None]:
    """Write what is done only if a whole number is not 0."""
    some = w.put(f"icmp ne i64 {condition}, 0")
    then, after = w.fresh("then"), w.fresh("done")
    w.do(f"br i1 {some}, label %{then}, label %{after}")
    w.label(then)
    yield
    w.do(f"br label %{after}")
    w.label(after)


def flag(w: Writer, truths: str, place: str) -> str:
    """Write the load of a truth from a list of bytes."""
    return w.put(f"icmp ne i8 {w.load('i8', truths, place)}, 0")


def either(w: Writer, which: str, write: Callable[[bool], Sequence[str]]) -> list[str]:
    """Write vectors in one of two ways, by a truth."""
    labels, after = {True: w.fresh("so"), False: w.fresh("else")}, w.fresh("both")
    w.do(f"br i1 {which}, label %{labels[True]}, label %{labels[False]}")
    vectors, ends = dict[bool, Sequence[str]](), dict[bool, str]()
    for way, label in labels.items():
        w.label(label)
        vectors[way], ends[way] = write(way), w.fresh("end")
        w.do(f"br label %{ends[way]}")
        w.label(ends[way])
        w.do(f"br label %{after}")
    w.label(after)
    pairs = zip(vectors[True], vectors[False], strict=True)
    return [
        w.put(f"phi {w.vector} [ {a}, %{ends[True]} ], [ {b}, %{ends[False]} ]") for a, b in pairs
    ]


def listed_block(w: Writer, places: str, k: str, start: str) -> str:
    """Write the address of a block whose distance from a start is entry k of a list."""
    return w.at(w.scalar, start, w.load_place(places, k))


def load_places(w: Writer, start: str, first: str) -> str:
    """Write the load of whole numbers of 32 bits, one a lane, as 64 bits."""
    places = w.load(f"<{w.lanes} x i32>", start, first)
    return w.put(f"sext <{w.lanes} x i32> {places} to <{w.lanes} x i64>")


def gather(w: Writer, start: str, places: str, offset: int) -> str:
    """Write the load of one number a lane, at `places` after a start and an offset."""
    at = w.at(w.scalar, start, offset)
    lanes, name = w.lanes, f"llvm.masked.gather.v{w.lanes}f{w.bits}.v{w.lanes}p0"
    truths = f"<{lanes} x i1>"
    w.declare(w.vector, name, f"<{lanes} x ptr>", "i32", truths, w.vector)
    pointers = w.put(f"getelementptr {w.scalar}, ptr {at}, <{lanes} x i64> {places}")
    return w.put(
        f"call {w.vector} @{name}(<{lanes} x ptr> {pointers}, i32 {w.bits // 8}, "
        f"{truths} splat (i1 true), {w.vector} poison)"
    )
