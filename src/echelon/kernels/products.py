"""Sums of products with fewer products: numbers that they have in common are taken out.

What users write as matrices and as stages of an integrator has the same factors many times. Here a
sum is seen as terms, each a plain number times factors: terms of the same factors become one, and
what several terms have in common is multiplied once. What is known first is multiplied first, so
that stages of an integrator share it. Results may differ by rounding from what was written; what is
marked as `kept`, the inside of elementary functions, stays as it is.
"""

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple, TypeAlias, final

from echelon.kernels.quotients import inverses_shared
from echelon.kernels.scalar import Node, needed

_OPEN = {"add", "sub", "mul", "neg"}
_LARGEST = 1e30
"""Of a plain number that is put together, and of its inverse: single precision holds 1e38."""


class Term(NamedTuple):
    """A plain number times factors, which stand in order."""

    share: float
    factors: tuple[Node, ...]


Common: TypeAlias = Node | float
"""What several terms are multiples of: a factor, or the size of the plain number."""


def shortened(results: Sequence[Node]) -> Mapping[Node, Node]:
    """Return what results become with fewer quotients and products, the same but for rounding."""
    first = inverses_shared(results)
    then = _Sums([first[node] for node in results]).made
    return {node: then[first[node]] for node in results}


@final
class _Sums:
    """What nodes become, one after the other: the terms of each, as they are and shortened."""

    def __init__(self, results: Sequence[Node]) -> None:
        nodes = needed(results)
        self.users = Counter(a for node in nodes for a in node.args)
        self.users.update(results)
        self.made = dict[Node, Node]()
        self.terms, self.short = dict[Node, list[Term]](), dict[Node, list[Term]]()
        for node in nodes:
            self.made[node] = self._become(node)

    def _become(self, node: Node) -> Node:
        if not node.args:
            return node
        made = node.graph.make(node.op, *(self.made[a] for a in node.args))
        if node.op not in _OPEN or node.kept or node.uniform:
            made.kept |= node.kept
            return made
        self.terms[node] = self.short[node] = terms = self._of(node)
        if not all(map(_is_sound, terms)):
            return made
        self.short[node] = short = _fewer(terms)
        simpler = len(short) < len(terms) or any(map(_is_long, short))
        return _sum_of(node, short) if simpler else made

    def _of(self, node: Node) -> list[Term]:
        """Return the terms of a node."""
        if node.op == "mul":
            return [self._product(node)]
        signs = {"add": (1.0, 1.0), "sub": (1.0, -1.0), "neg": (-1.0,)}[node.op]
        return [
            Term(sign * share, factors)
            for a, sign in zip(node.args, signs, strict=True)
            for share, factors in self._operand(a)
        ]

    def _operand(self, node: Node) -> list[Term]:
        if self._is_open(node):
            return self.terms[node]
        return [Term(node.value, ()) if node.op == "constant" else Term(1.0, (self.made[node],))]

    def _is_open(self, node: Node) -> bool:
        """Tell whether nothing else reads the terms of a node, so that it need not be there."""
        return node in self.terms and self.users[node] == 1

    def _product(self, node: Node) -> Term:
        share, factors = 1.0, list[Node]()
        for a in node.args:
            # A sum is a factor, but where no more than a product is left of it.
            parts = self.short[a] if self._is_open(a) else self._operand(a)
            [part] = parts if len(parts) == 1 else [Term(1.0, (self.made[a],))]
            share *= part.share
            factors += part.factors
        return Term(share, _in_order(factors))


def _in_order(factors: Iterable[Node]) -> tuple[Node, ...]:
    return tuple(sorted(factors, key=lambda node: (not node.uniform, node.number)))


def _is_sound(term: Term) -> bool:
    return term.share == 0.0 or 1.0 / _LARGEST <= abs(term.share) <= _LARGEST


def _is_long(term: Term) -> bool:
    """Tell whether the order of its products may matter."""
    return len(term.factors) + (abs(term.share) != 1.0) > 2


# ---- fewer terms ---------------------------------------------------------------------------------


def _fewer(terms: Sequence[Term]) -> list[Term]:
    """Return fewer terms that make the same sum."""
    found, bare = _merged(terms), list(map(_bare, terms))
    if all(map(_is_sound, bare)):
        found = min(found, _merged(bare), key=len)
    while (common := _most_common(found)) is not None:
        found = _taken_out(found, common)
    return found


def _bare(term: Term) -> Term:
    """Return a term whose factors are no multiples of others."""
    share, factors = term.share, list[Node]()
    for factor in term.factors:
        plain = [a for a in factor.args if factor.op == "mul" and a.op == "constant"]
        if plain:
            share *= plain[0].value
            [factor] = (a for a in factor.args if a not in plain)
        factors.append(factor)
    return Term(share, _in_order(factors))


def _merged(terms: Sequence[Term]) -> list[Term]:
    """Return terms of which no two are the same product.

    Numbers alone stay: one that is added and taken off again is there for what rounding does.
    """
    found = list[Term]()
    places = dict[tuple[Node, ...], int]()
    for share, factors in terms:
        place = places.setdefault(factors, len(found)) if len(factors) > 1 else len(found)
        if place == len(found):
            found.append(Term(share, factors))
        else:
            found[place] = Term(found[place].share + share, factors)
    return [term for term in found if term.share or len(term.factors) < 2]


def _most_common(terms: Sequence[Term]) -> Common | None:
    """Return what most terms are multiples of, if there are several."""
    counts = Counter[Common]()
    for share, factors in terms:
        # r + r s by one product would round r itself.
        if len(factors) > 1:
            counts.update(set(factors))
        if factors and abs(share) != 1.0:
            counts[abs(share)] += 1
    # The first of them, by the order of nodes, so that text is the same each time.
    order = {f: k for k, f in enumerate(f for share, fs in terms for f in (*fs, abs(share)))}
    found = max(counts, key=lambda c: (counts[c], -order[c]), default=None)
    return found if found is not None and counts[found] > 1 else None


def _taken_out(terms: Sequence[Term], common: Common) -> list[Term]:
    """Return terms of which those with something in common are one, where the last of them was."""
    inner, others, place = list[Term](), list[Term](), 0
    for term in terms:
        rest = _without(term, common)
        if rest is None:
            others.append(term)
        else:
            inner.append(rest)
            place = len(others)
    made = _sum_of(inner[0].factors[0], _fewer(inner))
    if isinstance(common, Node):
        new = Term(1.0, _in_order((common, made)))
    else:
        new = Term(common, (made,))
    return [*others[:place], new, *others[place:]]


def _without(term: Term, common: Common) -> Term | None:
    """Return a term without something that it is a multiple of; None where it is not."""
    share, factors = term
    if not isinstance(common, Node):
        there = factors and abs(share) == common
        return Term(math.copysign(1.0, share), factors) if there else None
    if common not in factors or len(factors) < 2:
        return None
    place = factors.index(common)
    return Term(share, factors[:place] + factors[place + 1 :])


# ---- and back ------------------------------------------------------------------------------------


def _sum_of(like: Node, terms: Sequence[Term]) -> Node:
    """Return a sum as a node of the same graph as another."""
    total = like.graph.constant(0.0)
    # What is taken off comes after what it is taken off from.
    first = next((k for k, term in enumerate(terms) if term.share > 0.0), 0)
    for term in (*terms[first:], *terms[:first]):
        product = like.graph.constant(abs(term.share))
        for factor in term.factors:
            product = product * factor
        total = total - product if term.share < 0.0 else total + product
    return total
