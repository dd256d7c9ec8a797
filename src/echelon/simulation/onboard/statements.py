"""A graph of scalars as assignments of a programming language, one for each operation."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

from echelon.simulation.codegen.scheduling import depth_first, lateness
from echelon.simulation.onboard.law_functions import LawFunction
from echelon.simulation.scalars import Node, needed

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
    "unlikely": "{0}",
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
        helpers: functions by name, each after those that it calls.
    """

    operations: Mapping[str, str]
    literal: Callable[[float | bool], str]
    word: str
    entry: str
    number: str
    truth: str
    helpers: Mapping[str, str]

    def used_helpers(self, text: str) -> str:
        """Return the functions that a text calls, directly or not."""
        used = ""
        for name, helper in reversed([*self.helpers.items()]):
            if f"{name}(" in text + used:
                used = f"{helper}\n{used}"
        return used


class Statements(NamedTuple):
    """The assignments of a function, and the word for each node."""

    lines: list[str]
    words: Mapping[Node, str]


def statements(function: LawFunction, syntax: Syntax) -> Statements:
    """Return the assignments that compute the results of a function."""
    lines, words = list[str](), dict[Node, str]()
    # Each result is computed before the next is begun, so that a compiler needs less of the stack.
    for node in depth_first(function.results, lateness(needed(function.results))):
        if node.op == "constant":
            words[node] = syntax.literal(node.value)
        elif node.op == "leaf":
            name, *place = node.value
            words[node] = word = syntax.word.format("".join(map(str, node.value)))
            lines += [syntax.entry.format(word=word, name=name, place=k) for k in place]
        else:
            words[node] = word = syntax.word.format(f"v{len(lines)}")
            expression = syntax.operations[node.op].format(*(words[a] for a in node.args))
            lines.append((syntax.truth if node.truth else syntax.number).format(word, expression))
    return Statements(lines, words)
