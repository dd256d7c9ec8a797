"""Sums of products with fewer products: common factors are taken out.

What users write as matrices and as stages of an integrator has the same factors many times. Here a
sum is a list of terms, each a plain number times factors: terms of the same factors are merged, and
a factor of several terms is multiplied once; uniform factors are multiplied first, so that stages
of an integrator share the product. A sum within a sum is expanded only if the two have a common
factor. Everything else is computed as it is written, and so are nodes marked as `verbatim`, the
insides of elementary functions.

Where a factor was taken out, results differ by the rounding of the terms, and numbers may overflow
or underflow in other places: x a - x b is NaN at x = 10 and a = b = 1e308 as it is written, and 0
as x (a - b). NaN that has another cause stays NaN.
"""

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple, TypeAlias, final

from echelon.simulation.scalars import Node, needed, rewritten

_OPEN = {"add", "sub", "mul", "neg"}
_LARGEST = 1e30
"""Of a product of plain numbers, and of its inverse: single precision holds 1e38."""

_MOST = 64
"""Common factors considered, so that time and memory are linear in the length of a sum."""


class Term(NamedTuple):
    """A plain number times factors, which are in order.

    Attributes:
        number: the plain number.
        factors: what it is multiplied by.
        sign: of the term, if it has a `verbatim`.
        verbatim: the node of the term without its sign, as it was written.
        inside: the original sum that the only factor is.
    """

    number: float
    factors: tuple[Node, ...]
    sign: float = 1.0
    verbatim: Node | None = None
    inside: Node | None = None

    def times(self, sign: float) -> "Term":
        """Return the term or its negative."""
        return self._replace(number=sign * self.number, sign=sign * self.sign)


Common: TypeAlias = Node | float
"""What several terms are multiples of: a factor, or the magnitude of the plain number."""


def factored(results: Sequence[Node]) -> Mapping[Node, Node]:
    """Return results with fewer quotients and products, equal except for rounding."""
    first = _inverses_shared(results)
    after = _Sums([first[node] for node in results]).after
    return {node: after[first[node]] for node in results}


@final
class _Sums:
    def __init__(self, results: Sequence[Node]) -> None:
        nodes = needed(results)
        self.users = Counter(a for node in nodes for a in node.args)
        self.users.update(results)
        self.after = dict[Node, Node]()
        self.terms, self.shared = dict[Node, list[Term]](), dict[Node, set[Common]]()
        for node in nodes:
            self.after[node] = self._factored(node)

    def _factored(self, node: Node) -> Node:
        if not node.args:
            return node
        after = node.graph.make(node.op, *(self.after[a] for a in node.args))
        if node.op not in _OPEN or node.verbatim or node.uniform:
            after.verbatim |= node.verbatim
            return after
        terms, fewer = self._product(node) if node.op == "mul" else self._sum(node)
        if not all(map(_is_sound, terms)):
            return after
        if fewer:
            after = _sum_of(node, terms)
        if len(terms) == 1 and node.op != "neg":
            terms = [terms[0]._replace(sign=1.0, verbatim=after, inside=None)]
        common = set[Common]().union(*map(self._multiples, terms))
        if len(common) <= _MOST:
            self.terms[node], self.shared[node] = terms, common
        return after

    def _product(self, node: Node) -> tuple[list[Term], bool]:
        """Return a product as a term, and whether it has fewer products than the original."""
        number, factors, numbers = 1.0, list[Node](), 0
        for a in node.args:
            # A sum is a factor, unless only a product is left of it.
            part = self._operand(a)
            numbers += abs(part.number) != 1.0
            number *= part.number
            factors += part.factors
        return [Term(number, _in_order(factors))], numbers > 1

    def _sum(self, node: Node) -> tuple[list[Term], bool]:
        """Return the terms of a sum, and whether they are fewer than in the original."""
        signs = {"add": (1.0, 1.0), "sub": (1.0, -1.0), "neg": (-1.0,)}[node.op]
        sides = [self._operand(a).times(sign) for a, sign in zip(node.args, signs, strict=True)]
        if len(sides) == 1:
            return sides, False
        common = set[Common].intersection(*map(self._multiples, sides))
        # A sum comes first: what is added to it then is added to all of it.
        ordered = sorted(sides, key=lambda term: term.inside is None)
        if not common:
            return ordered, False
        expanded = [part for side in ordered for part in self._expanded(side, common)]
        fewer = _fewer(expanded)
        return (fewer, True) if len(fewer) < len(expanded) else (ordered, False)

    def _operand(self, node: Node) -> Term:
        if node.op == "constant":
            return Term(node.value, ())
        after = self.after[node]
        whole = Term(1.0, (after,), verbatim=after)
        # If anything else reads the node, it is computed anyway.
        if node not in self.terms or self.users[node] > 1:
            return whole
        terms = self.terms[node]
        return terms[0] if len(terms) == 1 else whole._replace(inside=node)

    def _expanded(self, term: Term, common: set[Common]) -> list[Term]:
        """Return the terms of a sum, expanded as far as they have a common factor."""
        terms, todo = list[Term](), [term]
        while todo:
            term = todo.pop()
            if term.inside is None or not self.shared[term.inside] & common:
                terms.append(term)
            else:
                todo += [part.times(term.sign) for part in reversed(self.terms[term.inside])]
        return terms

    def _multiples(self, term: Term) -> set[Common]:
        if term.inside is not None:
            return self.shared[term.inside]
        common = set(_multiples(term))
        if any(factor.op == "mul" for factor in term.factors):
            common.update(_multiples(_bare(term)))
        return common


def _multiples(term: Term) -> list[Common]:
    # r + r s by one product would round r itself.
    common: list[Common] = [*dict.fromkeys(term.factors)] if len(term.factors) > 1 else []
    return [*common, abs(term.number)] if term.factors and abs(term.number) != 1.0 else common


def _in_order(factors: Iterable[Node]) -> tuple[Node, ...]:
    return tuple(sorted(factors, key=lambda node: (not node.uniform, node.number)))


def _is_sound(term: Term) -> bool:
    return term.number == 0.0 or 1.0 / _LARGEST <= abs(term.number) <= _LARGEST


def _fewer(terms: Sequence[Term]) -> list[Term]:
    fewer, bare = _merged(terms), list(map(_bare, terms))
    if all(map(_is_sound, bare)):
        fewer = min(fewer, _merged(bare), key=len)
    if any(term.number == 0.0 and term.factors for term in fewer):
        # With infinite factors the difference is NaN, which 0 would hide.
        return list(terms)
    while (common := _most_common(fewer)) is not None:
        fewer = _take_out(fewer, common)
    return fewer


def _bare(term: Term) -> Term:
    """Return a term with the plain numbers of its factors multiplied into its own."""
    number, factors = term.number, list[Node]()
    for factor in term.factors:
        plain = [a for a in factor.args if factor.op == "mul" and a.op == "constant"]
        if plain:
            number *= plain[0].value
            [factor] = (a for a in factor.args if a not in plain)
        factors.append(factor)
    return term._replace(number=number, factors=_in_order(factors))


def _merged(terms: Sequence[Term]) -> list[Term]:
    """Plain numbers stay: one that is added and subtracted again is there for its rounding."""
    merged, places = list[Term](), dict[tuple[Node, ...], int]()
    for term in terms:
        factors = term.factors
        place = places.setdefault(factors, len(merged)) if len(factors) > 1 else len(merged)
        if place == len(merged):
            merged.append(term)
        else:
            merged[place] = Term(merged[place].number + term.number, factors)
    return merged


def _most_common(terms: Sequence[Term]) -> Common | None:
    counts = Counter(common for term in terms for common in _multiples(term))
    # The first of them, by the order of nodes, so that the text is the same each time.
    order = {f: k for k, f in enumerate(f for t in terms for f in (*t.factors, abs(t.number)))}
    most = max(counts, key=lambda c: (counts[c], -order[c]), default=None)
    return most if most is not None and counts[most] > 1 else None


def _take_out(terms: Sequence[Term], common: Common) -> list[Term]:
    """Return terms with those that have a common factor merged, at the place of the last."""
    inner, others, place = list[Term](), list[Term](), 0
    for term in terms:
        rest = _without(term, common)
        if rest is None:
            others.append(term)
        else:
            inner.append(rest)
            place = len(others)
    inside = _sum_of(inner[0].factors[0], _fewer(inner))
    if isinstance(common, Node):
        new = Term(1.0, _in_order((common, inside)))
    else:
        new = Term(common, (inside,))
    return [*others[:place], new, *others[place:]]


def _without(term: Term, common: Common) -> Term | None:
    number, factors = term.number, term.factors
    if not isinstance(common, Node):
        has = factors and abs(number) == common
        return Term(math.copysign(1.0, number), factors) if has else None
    if common not in factors or len(factors) < 2:
        return None
    place = factors.index(common)
    return Term(number, factors[:place] + factors[place + 1 :])


def _sum_of(like: Node, terms: Sequence[Term]) -> Node:
    total, sign = like.graph.constant(0.0), 0.0
    for term in terms:
        own_sign, product = _size_of(like, term)
        sign = sign or own_sign
        if own_sign == sign:
            total = total + product
        elif sign < 0.0:
            # (-a - b) + c as c - (a + b), which has the same bits.
            total, sign = product - total, 1.0
        else:
            total = total - product
    return -total if sign < 0.0 else total


def _size_of(like: Node, term: Term) -> tuple[float, Node]:
    """Return the sign and the magnitude of a term, as written if nothing was taken out."""
    if term.verbatim is not None:
        return term.sign, term.verbatim
    product = like.graph.constant(abs(term.number))
    for factor in term.factors:
        product = product * factor
    return math.copysign(1.0, term.number), product


_CONTINUOUS = {"add", "sub", "mul", "neg"}
"""Operations that may read a quotient with another rounding; if it is truncated or compared, 49/49
must be 1."""


def _inverses_shared(results: Sequence[Node]) -> Mapping[Node, Node]:
    """A division is the slowest operation; results may differ by one unit in the last place."""
    nodes = needed(results)
    exact = {a for node in nodes if node.op not in _CONTINUOUS for a in node.args}
    quotients = [n for n in nodes if n.op == "div" and not n.uniform and n not in exact]
    uses = Counter(node.args[1] for node in quotients)
    shared = {node for node in quotients if uses[node.args[1]] > 1 or node.args[1].uniform}

    def product(node: Node, args: Sequence[Node]) -> Node | None:
        return args[0] * node.graph.make("div", 1.0, args[1]) if node in shared else None

    return rewritten(results, product)
