"""The law of one agent as source code in C99 and in Python, an assignment for each operation.

In C no memory is allocated, and of the library only `sqrt` is called. Python has floats, lists and
`math`.
"""

import itertools
import json
import math
from collections.abc import Callable, Collection, Mapping
from string import Template
from typing import NamedTuple, final

import numpy as np

from echelon.simulation.codegen.scheduling import depth_first, lateness
from echelon.simulation.scalars import Node, needed, within


class LawFunction(NamedTuple):
    """A function of numbers.

    Attributes:
        name: of the function.
        about: what it does, a sentence.
        inputs: name -> how many numbers it has; None for a number that is no array.
        outputs: name -> its numbers.
        valid: whether all that the outputs rest on is finite and accurate; None if not computed.
    """

    name: str
    about: str
    inputs: Mapping[str, int | None]
    outputs: Mapping[str, list[Node]]
    valid: Node | None = None

    @property
    def results(self) -> list[Node]:
        """All outputs, and whether they are valid."""
        valid = [] if self.valid is None else [self.valid]
        return sum(self.outputs.values(), start=valid)

    @property
    def operations(self) -> int:
        """How many operations there are; those of loops may be done several times, or never."""
        return sum(node.op not in _NO_OPERATION for node in needed(self.results))


_NO_OPERATION = ("constant", "leaf", "carried", "loop", "result")

COMMON = {
    "add": "{0} + {1}",
    **dict.fromkeys(("sub", "unfused_sub"), "{0} - {1}"),
    "mul": "{0} * {1}",
    **dict.fromkeys(("div", "exact_div"), "{0} / {1}"),
    # Two roundings, as in plain code for processors without a fused operation.
    "fma": "{0} * {1} + {2}",
    "fms": "{0} * {1} - {2}",
    "fnma": "{2} - {0} * {1}",
    "neg": "-{0}",
    "lt": "{0} < {1}",
    "le": "{0} <= {1}",
    "eq": "{0} == {1}",
    **dict.fromkeys(("ne", "xor"), "{0} != {1}"),
    **dict.fromkeys(("unlikely", "rare"), "{0}"),
    "bit0": "law_bit({0}, 0)",
    "bit1": "law_bit({0}, 1)",
    **{name: f"law_{name}({{0}})" for name in ("abs", "sqrt", "floor", "ceil", "rint")},
    **{name: f"law_{name}({{0}})" for name in ("pow2", "exponent", "mantissa", "root_guess")},
    "single": "law_single({0})",
    **{name: f"law_{name}({{0}}, {{1}})" for name in ("min", "max", "copysign")},
}
"""The text of each operation where languages agree, with the places of its operands."""


class Syntax(NamedTuple):
    """How a language writes what differs between languages.

    Attributes:
        operations: operation -> text, with the places of its operands.
        literal: returns a plain number, to the bit.
        word: a name, with the place of a plain one.
        entry: an assignment, with the places of a `word`, and of the `name` and `place` of a number
            in an array.
        number, truth: an assignment, with the places of a name and an expression.
        carried, again: that of a number that a loop carries, before the loop and in it.
        loop: lines that begin a loop, that leave it unless a truth holds, and that end it.
        helpers: functions by name, each after those that it calls.
    """

    operations: Mapping[str, str]
    literal: Callable[[float | bool], str]
    word: str
    entry: str
    number: str
    truth: str
    carried: str
    again: str
    loop: tuple[str, str, str]
    helpers: Mapping[str, str]

    def used_helpers(self, text: str) -> str:
        """Return the functions that a text calls, directly or not."""
        used = ""
        for name, helper in reversed([*self.helpers.items()]):
            if f"{name}(" in text + used:
                used = f"{helper}\n{used}"
        return used


@final
class Statements:
    """The assignments that compute the results of a function.

    Attributes:
        lines: of the text.
        words: for each node.
    """

    def __init__(self, function: LawFunction, syntax: Syntax) -> None:
        self.lines, self.words = list[str](), dict[Node, str]()
        self._syntax, self._count = syntax, itertools.count()
        # Each result is computed before the next is begun: a compiler needs less of the stack.
        self._order = depth_first(function.results, lateness(needed(function.results)))
        self._loops = {
            node.value: within(node.value, node.args) for node in self._order if node.op == "loop"
        }
        self._write({*self._order}, frozenset(), "")

    def _write(self, nodes: Collection[Node], inside: frozenset[int], indent: str) -> None:
        """Write what is computed in some loops, and in no other."""
        for node in self._order:
            loops = (loop for loop, changes in self._loops.items() if changes.get(node))
            if node in nodes and node not in self.words and inside.issuperset(loops):
                self._write_one(node, inside, indent)

    def _write_one(self, node: Node, inside: frozenset[int], indent: str) -> None:
        syntax, words = self._syntax, self.words
        if node.op == "constant":
            words[node] = syntax.literal(node.value)
        elif node.op == "leaf":
            name, *place = node.value
            words[node] = word = syntax.word.format("".join(map(str, node.value)))
            entries = (syntax.entry.format(word=word, name=name, place=k) for k in place)
            self.lines += [indent + entry for entry in entries]
        elif node.op == "loop":
            words[node] = ""
            self._write_loop(node, inside, indent)
        elif node.op == "result":
            words[node] = _carried_word(node.args[0].value, node.value)
        else:
            expression = syntax.operations[node.op].format(*(words[a] for a in node.args))
            words[node] = self._assign(indent, expression, node.truth)

    def _assign(self, indent: str, expression: str, truth: bool = False) -> str:
        word = self._syntax.word.format(f"v{next(self._count)}")
        text = self._syntax.truth if truth else self._syntax.number
        self.lines.append(indent + text.format(word, expression))
        return word

    def _write_loop(self, node: Node, inside: frozenset[int], indent: str) -> None:
        syntax, words, count = self._syntax, self.words, len(node.args) // 2
        begin, test, after = node.args[:count], node.args[count], node.args[count + 1 :]
        names = [_carried_word(node.value, k) for k in range(count)]
        for k, (name, first) in enumerate(zip(names, begin, strict=True)):
            words[node.graph.carried(node.value, k)] = name
            self.lines.append(indent + syntax.carried.format(name, words[first]))
        within_it, deeper = inside | {node.value}, indent + "    "
        self.lines.append(indent + syntax.loop[0])
        self._write({*needed([test])}, within_it, deeper)
        self.lines += [indent + line for line in syntax.loop[1].format(words[test]).splitlines()]
        self._write({*needed(after)}, within_it, deeper)
        changed = [(k, a) for k, a in enumerate(after) if a.value != (node.value, k)]
        # What takes the place of another number is read before that is replaced.
        ready = [
            self._assign(deeper, words[a]) if a.op == "carried" else words[a] for _, a in changed
        ]
        for (k, _), word in zip(changed, ready, strict=True):
            self.lines.append(deeper + syntax.again.format(names[k], word))
        self.lines += [indent + line for line in syntax.loop[2].splitlines()]


def _carried_word(loop: int, place: int) -> str:
    return f"loop{loop}_{place}"


# ---- C99 -----------------------------------------------------------------------------------------

_C_HELPERS = {
    "law_bits": """
static $bits law_bits(law_real a)
{
    union { law_real number; $bits bits; } word;
    word.number = a;
    return word.bits;
}
""",
    "law_number": """
static law_real law_number($bits bits)
{
    union { law_real number; $bits bits; } word;
    word.bits = bits;
    return word.number;
}
""",
    "law_abs": """
static law_real law_abs(law_real a)
{
    return law_number(law_bits(a) & $size);
}
""",
    "law_copysign": """
static law_real law_copysign(law_real a, law_real b)
{
    return law_number((law_bits(a) & $size) | (law_bits(b) & ~$size));
}
""",
    "law_rint": """
static law_real law_rint(law_real a)
{
    const law_real size = law_abs(a);
    if (!(size < $whole))
        return a;
    return law_copysign((size + $whole) - $whole, a);
}
""",
    "law_floor": """
static law_real law_floor(law_real a)
{
    const law_real nearest = law_rint(a);
    return nearest > a ? nearest - 1 : nearest;
}
""",
    "law_ceil": """
static law_real law_ceil(law_real a)
{
    return -law_floor(-a);
}
""",
    "law_min": """
static law_real law_min(law_real a, law_real b)
{
    return a < b || a != a || (a == b && law_copysign(1, a) < 0) ? a : b;
}
""",
    "law_max": """
static law_real law_max(law_real a, law_real b)
{
    return a < b || b != b || (a == b && law_copysign(1, a) < 0) ? b : a;
}
""",
    "law_pow2": """
static law_real law_pow2(law_real a)
{
    return law_number(law_bits(a + $biased) << $digits);
}
""",
    "law_split": """
static $signed law_split(law_real a)
{
    const $signed away = ($signed)(law_bits(a) - $half_root);
    return away >= 0 ? away >> $digits : -1 - ((-1 - away) >> $digits);
}
""",
    "law_exponent": """
static law_real law_exponent(law_real a)
{
    return (law_real)law_split(a);
}
""",
    "law_mantissa": """
static law_real law_mantissa(law_real a)
{
    return law_number(law_bits(a) - (($bits)law_split(a) << $digits));
}
""",
    "law_root_guess": """
static law_real law_root_guess(law_real a)
{
    return law_number($guess - (law_bits(a) >> 1));
}
""",
    "law_bit": """
static int law_bit(law_real a, int place)
{
    return (int)((law_bits(a) >> place) & 1U);
}
""",
    "law_single": """
static law_real law_single(law_real a)
{
    return (law_real)(float)a;
}
""",
}

# The same instructions on the bits of numbers as those of `codegen.vector_ir`.
_C_WORDS = {
    64: {
        "bits": "uint64_t",
        "signed": "int64_t",
        "size": "0x7FFFFFFFFFFFFFFFULL",
        "whole": "4503599627370496.0",
        "biased": "6755399441056767.0",
        "digits": "52",
        "half_root": "0x3FE6A09E667F3BCDULL",
        "guess": "0x5FE6EB50C7B537A9ULL",
    },
    32: {
        "bits": "uint32_t",
        "signed": "int32_t",
        "size": "0x7FFFFFFFU",
        "whole": "8388608.0f",
        "biased": "12583039.0f",
        "digits": "23",
        "half_root": "0x3F3504F3U",
        "guess": "0x5F375A86U",
    },
}


def _c_literal(bits: int, value: float | bool) -> str:
    """Return a plain number; a literal without `f` would make single precision double."""
    if isinstance(value, bool):
        return str(int(value))
    if math.isfinite(value):
        return repr(value) if bits == 64 else f"{np.float32(value)!s}f"
    return "(law_real)NAN" if math.isnan(value) else f"{'-' * (value < 0.0)}(law_real)INFINITY"


def _c_syntax(bits: int) -> Syntax:
    words = _C_WORDS[bits]
    return Syntax(
        {
            **COMMON,
            "sqrt": "sqrt({0})" if bits == 64 else "sqrtf({0})",
            "and": "{0} && {1}",
            "or": "{0} || {1}",
            "not": "!{0}",
            "select": "{0} ? {1} : {2}",
        },
        lambda value: _c_literal(bits, value),
        "{}",
        "    const law_real {word} = {name}[{place}];",
        "    const law_real {} = {};",
        "    const int {} = {};",
        "    law_real {} = {};",
        "    {} = {};",
        ("    for (;;) {", "        if (!{})\n            break;", "    }"),
        {name: Template(text).substitute(words) for name, text in _C_HELPERS.items()},
    )


def c_text(double: Collection[LawFunction], single: Collection[LawFunction], about: str) -> str:
    """Return functions as a file of C, single if `LAW_SINGLE` is defined; `about` is its head."""
    parts = [
        f"/* {about} */",
        "",
        "#include <math.h>",
        "#include <stdint.h>",
        "",
        '#include "law.h"',
        "",
        "#ifdef LAW_SINGLE",
        _c_functions(single, 32),
        "#else",
        _c_functions(double, 64),
        "#endif",
        "",
    ]
    return "\n".join(parts)


def _c_functions(functions: Collection[LawFunction], bits: int) -> str:
    syntax = _c_syntax(bits)
    body = "\n".join(_c_function(function, syntax) for function in functions)
    return f"{syntax.used_helpers(body)}\n{body}".replace("\n\n\n", "\n\n")


def header_text(
    functions: Collection[LawFunction], about: str, constants: Mapping[str, float | str]
) -> str:
    """Return the declarations of the functions, and constants by name."""
    return "\n".join(
        [
            f"/* {about} */",
            "",
            "#ifndef LAW_H",
            "#define LAW_H",
            "",
            "#ifdef LAW_SINGLE",
            "typedef float law_real;",
            "#else",
            "typedef double law_real;",
            "#endif",
            "",
            *(f"#define LAW_{name} {json.dumps(value)}" for name, value in constants.items()),
            "",
            *(f"/* {f.about[0].upper()}{f.about[1:]}. */\n{_c_head(f)};\n" for f in functions),
            "#endif",
            "",
        ]
    )


def _c_head(function: LawFunction) -> str:
    # Memory is replaced where it is both an input and an output.
    inputs = {
        name: f"law_real {name}" if size is None else f"const law_real *{name}"
        for name, size in function.inputs.items()
    }
    arguments = {**inputs, **{name: f"law_real *{name}" for name in function.outputs}}
    kind = "void" if function.valid is None else "int"
    return f"{kind} law_{function.name}({', '.join(arguments.values())})"


def _c_function(function: LawFunction, syntax: Syntax) -> str:
    written = Statements(function, syntax)
    lines, words = written.lines, written.words
    read = {node.value[0] for node in words if node.op == "leaf"}
    unread = [name for name in function.inputs if name not in read]
    valid = None if function.valid is None else words[function.valid]
    return "\n".join(
        [
            _c_head(function),
            "{",
            *(f"    (void){name};" for name in unread if function.outputs.get(name) is None),
            *(f"    (void){name};" for name, part in function.outputs.items() if not part),
            *lines,
            *([] if valid is None else [f"    if (!{valid})", "        return 0;"]),
            *(
                f"    {name}[{k}] = {words[node]};"
                for name, part in function.outputs.items()
                for k, node in enumerate(part)
            ),
            *([] if valid is None else ["    return 1;"]),
            "}",
            "",
        ]
    )


# ---- Python --------------------------------------------------------------------------------------

# Python raises errors where C returns infinity or NaN.
_PYTHON_HELPERS = {
    "law_divide": """
def law_divide(a, b):
    return a / b if b != 0.0 else a * math.copysign(math.inf, b)
""",
    "law_sqrt": """
def law_sqrt(a):
    return math.sqrt(a) if a >= 0.0 else math.nan
""",
    "law_rint": """
def law_rint(a):
    size = abs(a)
    if not size < 4503599627370496.0:
        return a
    return math.copysign((size + 4503599627370496.0) - 4503599627370496.0, a)
""",
    "law_floor": """
def law_floor(a):
    nearest = law_rint(a)
    return nearest - 1.0 if nearest > a else nearest
""",
    "law_ceil": """
def law_ceil(a):
    return -law_floor(-a)
""",
    "law_min": """
def law_min(a, b):
    return a if a < b or a != a or (a == b and math.copysign(1.0, a) < 0.0) else b
""",
    "law_max": """
def law_max(a, b):
    return b if a < b or b != b or (a == b and math.copysign(1.0, a) < 0.0) else a
""",
    "law_pow2": """
def law_pow2(a):
    return math.ldexp(1.0, int(a)) if math.isfinite(a) else a
""",
    "law_split": """
def law_split(a):
    half, exponent = math.frexp(abs(a))
    return (2.0 * half, exponent - 1.0) if half < 0.7071067811865476 else (half, exponent + 0.0)
""",
    "law_exponent": """
def law_exponent(a):
    return law_split(a)[1]
""",
    "law_mantissa": """
def law_mantissa(a):
    return law_split(a)[0]
""",
    "law_root_guess": """
def law_root_guess(a):
    if not 2.3e-308 < a < math.inf:
        return 1.0
    half, exponent = math.frexp(a)
    bits = ((exponent + 1022) << 52) + int((half - 0.5) * 2.0**53)
    bits = 0x5FE6EB50C7B537A9 - (bits >> 1)
    return math.ldexp(1.0 + (bits & ((1 << 52) - 1)) * 2.0**-52, (bits >> 52) - 1023)
""",
    "law_bit": """
def law_bit(a, place):
    return math.isfinite(a) and (int(a) >> place) % 2 == 1
""",
    "law_single": """
def law_single(a):
    if not math.isfinite(a):
        return a
    half, exponent = math.frexp(a)
    digits = min(24, exponent + 149)
    size = math.ldexp(round(math.ldexp(abs(half), digits)), exponent - digits)
    return math.copysign(size if size < 2.0**128 else math.inf, a)
""",
}


def _python_literal(value: float | bool) -> str:
    if isinstance(value, bool) or math.isfinite(value):
        return repr(value)
    return "math.nan" if math.isnan(value) else f"{'-' * (value < 0.0)}math.inf"


_PYTHON = Syntax(
    {
        **COMMON,
        **dict.fromkeys(("div", "exact_div"), "law_divide({0}, {1})"),
        "abs": "abs({0})",
        "copysign": "math.copysign({0}, {1})",
        "and": "{0} and {1}",
        "or": "{0} or {1}",
        "not": "not {0}",
        "select": "{1} if {0} else {2}",
    },
    _python_literal,
    "{}",
    "    {word} = {name}[{place}]",
    "    {} = {}",
    "    {} = {}",
    "    {} = {}",
    "    {} = {}",
    ("    while True:", "        if not {}:\n            break", ""),
    _PYTHON_HELPERS,
)


def python_text(
    functions: Collection[LawFunction], about: str, constants: Mapping[str, float | str]
) -> str:
    """Return the functions as a module with constants by name; `about` is its docstring."""
    body = "\n\n".join(map(_python_function, functions))
    helpers = _PYTHON.used_helpers(body).replace("\n\n\n", "\n\n")
    named = "\n".join(f"{name} = {json.dumps(value)}" for name, value in constants.items())
    return f'"""{about}"""\n\nimport math\n\n{named}\n{helpers}\n\n{body}'


def _python_function(function: LawFunction) -> str:
    written = Statements(function, _PYTHON)
    lines, words = written.lines, written.words
    head = f"def {function.name}({', '.join(function.inputs)}):"
    outputs = [f"[{', '.join(words[n] for n in part)}]" for part in function.outputs.values()]
    valid = [] if function.valid is None else [words[function.valid]]
    names = ", ".join([*function.outputs, *(["valid"] if valid else [])])
    return "\n".join(
        [
            head,
            f'    """Return {names}: {function.about}."""',
            *lines,
            f"    return {', '.join([*outputs, *valid])}",
            "",
        ]
    )
