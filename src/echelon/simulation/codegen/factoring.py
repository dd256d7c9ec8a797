"""Sums of products with fewer products: numbers that they have in common are taken out.

What users write as matrices and as stages of an integrator has the same factors many times. Here a
sum is seen as terms, each a plain number times factors: terms of the same factors become one, and
what several terms have in common is multiplied once; there, what is known first is multiplied
first, so that stages of an integrator share it. A sum within a sum is opened only where the two
have something in common. Everything else is computed as it is written, and so is what is marked as
`kept`, the inside of elementary functions.

Where something was taken out, results differ by the rounding of the terms, and numbers may become
too large or too small in other places: x a - x b is none (NaN) at x = 10 and a = b = 1e308 as it is
written, and 0 as x (a - b). What is no number for another reason stays none.
"""

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple, TypeAlias, final

from echelon.simulation.codegen.quotients import inverses_shared
from echelon.simulation.scalars.scalar_graph import Node, needed

_OPEN = {"add", "sub", "mul", "neg"}
_LARGEST = 1e30
"""Of a plain number that is put together, and of its inverse: single precision holds 1e38."""

_MOST = 64
"""Of what a sum is opened for, so that long sums take time and memory by their length alone."""


class Term(NamedTuple):
    """A plain number times factors, which stand in order.

    Attributes:
        share: the plain number.
        factors: what it is multiplied by.
        sign: of the term, where `written` is there.
        written: what it is without its sign, made as it was written.
        inside: the sum, before anything was made of it, that the only factor is.
    """

    share: float
    factors: tuple[Node, ...]
    sign: float = 1.0
    written: Node | None = None
    inside: Node | None = None

    def times(self, sign: float) -> "Term":
        """Return the term or what takes it off."""
        return self._replace(share=sign * self.share, sign=sign * self.sign)


Common: TypeAlias = Node | float
"""What several terms are multiples of: a factor, or the size of the plain number."""


def shortened(results: Sequence[Node]) -> Mapping[Node, Node]:
    """Return what results become with fewer quotients and products, the same but for rounding."""
    first = inverses_shared(results)
    then = _Sums([first[node] for node in results]).made
    return {node: then[first[node]] for node in results}


@final
class _Sums:
    """What nodes become, one after the other; their terms, and what these are multiples of."""

    def __init__(self, results: Sequence[Node]) -> None:
        nodes = needed(results)
        self.users = Counter(a for node in nodes for a in node.args)
        self.users.update(results)
        self.made = dict[Node, Node]()
        self.terms, self.shared = dict[Node, list[Term]](), dict[Node, set[Common]]()
        for node in nodes:
            self.made[node] = self._become(node)

    def _become(self, node: Node) -> Node:
        if not node.args:
            return node
        made = node.graph.make(node.op, *(self.made[a] for a in node.args))
        if node.op not in _OPEN or node.kept or node.uniform:
            made.kept |= node.kept
            return made
        terms, fewer = self._product(node) if node.op == "mul" else self._sum(node)
        if not all(map(_is_sound, terms)):
            return made
        if fewer:
            made = _sum_of(node, terms)
        if len(terms) == 1 and node.op != "neg":
            terms = [terms[0]._replace(sign=1.0, written=made, inside=None)]
        common = set[Common]().union(*map(self._multiples, terms))
        if len(common) <= _MOST:
            self.terms[node], self.shared[node] = terms, common
        return made

    def _product(self, node: Node) -> tuple[list[Term], bool]:
        """Return a product as a term, and whether it has fewer products than were written."""
        share, factors, numbers = 1.0, list[Node](), 0
        for a in node.args:
            # A sum is a factor, but where no more than a product is left of it.
            part = self._operand(a)
            numbers += abs(part.share) != 1.0
            share *= part.share
            factors += part.factors
        term = Term(share, _in_order(factors))
        return [term], numbers > 1

    def _sum(self, node: Node) -> tuple[list[Term], bool]:
        """Return the terms of a sum, and whether they are fewer than were written."""
        signs = {"add": (1.0, 1.0), "sub": (1.0, -1.0), "neg": (-1.0,)}[node.op]
        sides = [self._operand(a).times(sign) for a, sign in zip(node.args, signs, strict=True)]
        if len(sides) == 1:
            return sides, False
        common = set[Common].intersection(*map(self._multiples, sides))
        # A sum stands first: what is added to it then is added to all of it.
        written = sorted(sides, key=lambda term: term.inside is None)
        if not common:
            return written, False
        opened = [part for side in written for part in self._opened(side, common)]
        found = _fewer(opened)
        return (found, True) if len(found) < len(opened) else (written, False)

    def _operand(self, node: Node) -> Term:
        if node.op == "constant":
            return Term(node.value, ())
        whole, made = Term(1.0, (self.made[node],)), self.made[node]
        # Nothing else may read the terms of a node that need not be there.
        if node not in self.terms or self.users[node] > 1:
            return whole._replace(written=made)
        terms = self.terms[node]
        return terms[0] if len(terms) == 1 else whole._replace(written=made, inside=node)

    def _opened(self, term: Term, common: set[Common]) -> list[Term]:
        """Return the terms of a sum down to where none of it is a multiple of something."""
        found, todo = list[Term](), [term]
        while todo:
            term = todo.pop()
            if term.inside is None or not self.shared[term.inside] & common:
                found.append(term)
            else:
                todo += [part.times(term.sign) for part in reversed(self.terms[term.inside])]
        return found

    def _multiples(self, term: Term) -> set[Common]:
        """Return what a term, or one of those inside, is a multiple of."""
        if term.inside is not None:
            return self.shared[term.inside]
        found = set(_multiples(term))
        if any(factor.op == "mul" for factor in term.factors):
            found.update(_multiples(_bare(term)))
        return found


def _multiples(term: Term) -> list[Common]:
    """Return what may be taken out of a term."""
    # r + r s by one product would round r itself.
    found: list[Common] = [*dict.fromkeys(term.factors)] if len(term.factors) > 1 else []
    return [*found, abs(term.share)] if term.factors and abs(term.share) != 1.0 else found


def _in_order(factors: Iterable[Node]) -> tuple[Node, ...]:
    return tuple(sorted(factors, key=lambda node: (not node.uniform, node.number)))


def _is_sound(term: Term) -> bool:
    return term.share == 0.0 or 1.0 / _LARGEST <= abs(term.share) <= _LARGEST


# ---- fewer terms ---------------------------------------------------------------------------------


def _fewer(terms: Sequence[Term]) -> list[Term]:
    """Return fewer terms that make the same sum, or as many where there are none."""
    found, bare = _merged(terms), list(map(_bare, terms))
    if all(map(_is_sound, bare)):
        found = min(found, _merged(bare), key=len)
    if any(term.share == 0.0 and term.factors for term in found):
        # Of infinite factors the difference is no number, which 0 would hide.
        return list(terms)
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
    return term._replace(share=share, factors=_in_order(factors))


def _merged(terms: Sequence[Term]) -> list[Term]:
    """Return terms of which no two are the same product.

    Numbers alone stay: one that is added and taken off again is there for what rounding does.
    """
    found = list[Term]()
    places = dict[tuple[Node, ...], int]()
    for term in terms:
        share, factors = term.share, term.factors
        place = places.setdefault(factors, len(found)) if len(factors) > 1 else len(found)
        if place == len(found):
            found.append(term)
        else:
            found[place] = Term(found[place].share + share, factors)
    return found


def _most_common(terms: Sequence[Term]) -> Common | None:
    """Return what most terms are multiples of, if there are several."""
    counts = Counter(common for term in terms for common in _multiples(term))
    # The first of them, by the order of nodes, so that text is the same each time.
    order = {f: k for k, f in enumerate(f for t in terms for f in (*t.factors, abs(t.share)))}
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
    share, factors = term.share, term.factors
    if not isinstance(common, Node):
        there = factors and abs(share) == common
        return Term(math.copysign(1.0, share), factors) if there else None
    if common not in factors or len(factors) < 2:
        return None
    place = factors.index(common)
    return Term(share, factors[:place] + factors[place + 1 :])


# ---- and back ------------------------------------------------------------------------------------


def _sum_of(like: Node, terms: Sequence[Term]) -> Node:
    """Return a sum, in the order of its terms, as a node of the same graph as another."""
    total, sign = like.graph.constant(0.0), 0.0
    for term in terms:
        its, product = _size_of(like, term)
        sign = sign or its
        if its == sign:
            total = total + product
        elif sign < 0.0:
            # (-a - b) + c as c - (a + b), which is the same to the bit.
            total, sign = product - total, 1.0
        else:
            total = total - product
    return -total if sign < 0.0 else total


def _size_of(like: Node, term: Term) -> tuple[float, Node]:
    """Return the sign of a term and the rest of it, as written where nothing was taken out."""
    if term.written is not None:
        return term.sign, term.written
    product = like.graph.constant(abs(term.share))
    for factor in term.factors:
        product = product * factor
    return math.copysign(1.0, term.share), product
