"""The common base of leaders and followers under the law `stopping-point`."""

import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Self, TypeAlias, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from echelon.agents.models.chains import (
    Chains,
    chains_of,
    check_bounds,
    to_flat,
)
from echelon.agents.models.model import ControlAffine, FlatBound
from echelon.agents.models.relative_equilibrium import moves
from echelon.agents.models.unlike import UnlikeAgents
from echelon.agents.network.formation_motion import OwnOffset
from echelon.core.compiled import cached_jit
from echelon.core.errors import LawError, ModelError, listing
from echelon.core.limits import LARGEST
from echelon.core.types import Array, Input, Scalar, State
from echelon.laws.flat_loop import FlatLoop, FlatMemory, Observer
from echelon.laws.law import Checks, Feeds, KeepsApart, Law, LocalView, Speaks
from echelon.laws.safety import MOST_POINTS, hull_points
from echelon.laws.unlike_loop import UnlikeLoop

Speed: TypeAlias = float | tuple[float, ...]

RATE = 4.0
"""Of the slowest root, 1/s, unless it is given."""
SPEED, LEAD_SPEED = 2.5, 1.5
"""Of followers and leaders, m/s and rad/s, unless given, and of a bounded output no more than these
parts of what its bound leaves: with the default roots both together leave a vehicle its thrust,
from any place (9.81 / 2.416 m/s; theory page, T5)."""
SHARE, LEAD_SHARE = 0.6, 0.36
_CHAINED = 1.0
"""Of each link where speeds add up along parents, of what has no bound: as long as links are short
this is hardly ever reached."""
CHAIN_SHARE = 0.96
"""Of all links together, of a bounded output: a leader is then to start on its path there."""
_SPREAD = 0.125
"""Roots of a rate r are r, 1.125 r, 1.25 r, ..: distinct, as the certificate requires."""
_REST = 1e-9
"""Of a bounded length: what floats leave of 0."""
_LEAST = 1e-3
"""Of the push upward at the trim: what is left of it a thousandth of a radian from the border."""


def plain_speeds(speeds: float | Sequence[float] | None) -> Speed | None:
    """Return speeds as plain numbers, which a compiled step takes for constants."""
    return tuple(map(float, speeds)) if isinstance(speeds, Sequence | np.ndarray) else speeds


class FlatLaw(Law, Speaks, Feeds, KeepsApart, Checks):
    """A law with its loop closed in flat coordinates, whose agents exchange zeta.

    Args:
        roots: of q, 1/s, distinct and positive; one fewer than the longest chain of the model.
        rate: the slowest root, in place of `roots`; the others follow from it.
        coupling: c > 0.
        speed: s, of all outputs or one each, in their units per second; infinite is linear. By
            default what the model's bounds allow.
        observer: of the acceleration that the model lacks, which is compensated; True for the
            default one, False for none.
        loop: of the model; computed by `prepared`.
        speeds: s in use; computed by `prepared`.
    """

    unlike = True
    roots: tuple[float, ...] | None = eqx.field(default=None, static=True)
    rate: float | None = eqx.field(default=None, static=True)
    coupling: float | None = None
    speed: Speed | None = eqx.field(default=None, converter=plain_speeds)
    observer: Observer = eqx.field(default=Observer(), static=True, converter=Observer.of)
    loop: FlatLoop | UnlikeLoop | None = None
    speeds: Speed | None = None

    def __check_init__(self) -> None:
        if self.roots is not None and self.rate is not None:
            raise LawError("got `roots` and `rate`, allowed is one of them.")
        for name in ("rate", "coupling"):
            value = getattr(self, name)
            if isinstance(value, int | float) and not 0.0 < value <= LARGEST:
                raise LawError(f"`{name}` is {value}, and must be positive, at most {LARGEST:g}.")
        roots = (1.0,) if self.roots is None else self.roots
        if not isinstance(roots, Sequence) or not all(map(_positive, roots)):
            raise LawError(
                f"`roots` are {self.roots}, and must be a list of positive numbers, 1/s."
            )
        if len(set(roots)) < len(roots):
            raise LawError(f"`roots` are {list(roots)}, and must be different from each other.")
        speeds = self.speed if isinstance(self.speed, Sequence) else (self.speed,)
        numbers = all(isinstance(speed, int | float) and speed > 0.0 for speed in speeds)
        if self.speed is not None and not numbers:
            raise LawError(
                f"`speed` is {self.speed}, and must be positive, or a list of such numbers."
            )

    # ---- numbers ----

    def roots_for(self, count: int) -> tuple[float, ...]:
        """Return the first roots of q, the slowest first."""
        if self.roots is not None:
            return tuple(sorted(self.roots))[:count]
        rate = RATE if self.rate is None else self.rate
        return tuple(rate * (1.0 + _SPREAD * k) for k in range(count))

    @property
    def slowest_root(self) -> float:
        """The slowest root, 1/s."""
        return self.roots_for(1)[0]

    @property
    def fastest(self) -> float:
        """The sum of all roots, 1/s, of the longest chain."""
        return sum(self.roots_for(max(self.ready.chains.degrees) - 1))

    @property
    def ready(self) -> FlatLoop:
        """The loop of a prepared law; that of unlike agents has the same methods.

        Raises:
            LawError: it is not prepared.
        """
        if self.loop is None:
            raise LawError(
                f"`{type(self).__name__}` has no loop yet; call `prepared(model, graph)` first."
            )
        return cast(FlatLoop, self.loop)

    def speed_of(self, output: int) -> float:
        """Return s of an output."""
        assert self.speeds is not None, "`prepared` finds the speeds"
        return float(self.speeds[output] if isinstance(self.speeds, Sequence) else self.speeds)

    def build_loop(self, model: ControlAffine, agents: Iterable[int] = ()) -> FlatLoop | UnlikeLoop:
        """Return the inner loop for a model; `agents` are those under the law, where unlike.

        Raises:
            LawError: the model has no flat coordinates, or bounds of which nothing is proved, or
                roots or speeds are not as many as it needs.
        """
        kinds = [(part, _checked_chains(part)) for part in groups_of(model)]
        roots = self._roots_of(kinds)
        lengths = [max(chains.degrees) - 1 for _, chains in kinds]
        loops = [
            FlatLoop.of(part, chains, roots[:length], self.observer)
            for (part, chains), length in zip(kinds, lengths, strict=True)
        ]
        loop = loops[0]
        if isinstance(model, UnlikeAgents):
            self._check_unlike(model)
            loop = UnlikeLoop.of(model, loops, roots, agents)
        outputs = loop.chains.outputs
        if isinstance(self.speed, Sequence) and len(self.speed) != len(outputs):
            raise LawError(
                f"`speed` has {len(self.speed)} numbers, and must be one, or one for each of "
                f"{listing(outputs)}."
            )
        return loop

    def _check_unlike(self, model: UnlikeAgents) -> None:
        if self.safety is not None:
            raise LawError("`safety` is of agents that are alike, and these are not.")
        for name, part in zip(model.names, model.models, strict=True):
            if moves(part):
                raise LawError(
                    f"`{name}` moves at its trim, and unlike agents agree on where they rest; use "
                    "a model that can stand still."
                )

    def _roots_of(self, kinds: Sequence[tuple[ControlAffine, Chains]]) -> tuple[float, ...]:
        """Return as many roots as the longest chain of some models needs."""
        model, chains = max(kinds, key=lambda pair: max(pair[1].degrees))
        needed = max(chains.degrees) - 1
        if self.roots is not None and len(self.roots) != needed:
            raise LawError(
                f"`roots` are {list(self.roots)}, and `{type(model).__name__}` needs {needed}: its "
                f"longest chain is of {needed + 1} integrators."
            )
        return self.roots_for(needed)

    def speeds_within(
        self,
        model: ControlAffine,
        loop: FlatLoop | UnlikeLoop,
        most: float,
        share: float,
        links: int = 1,
        slowest: Callable[[FlatBound], float] = lambda _: 0.0,
    ) -> Speed:
        """Return s as set by the user, or what bounds allow each link of the path from a leader.

        `links` speeds add up; `slowest` gives what the path takes a bounded length to, at least.
        """
        if self.speed is not None:
            return self.speed
        link = most if links == 1 else min(most, max(most / links, _CHAINED))

        cap, each = most if links == 1 else math.inf, list[dict[str, float]]()
        for part, own in zip(groups_of(model), loops_of(loop), strict=True):
            each.append(dict.fromkeys(own.chains.outputs, link))
            for bound in part.flat_bounds or ():
                left = self._left(own.chains, bound, slowest(bound))
                bounded = min(cap, share * left) / links if left > 0.0 else link
                each[-1] |= dict.fromkeys(bound.outputs, bounded)
        # All groups agree on a place, so that the slowest sets the speed.
        return tuple(min(x[y] for x in each if y in x) for y in loop.chains.outputs)

    def _left(self, chains: Chains, bound: FlatBound, slowest: float) -> float:
        degree = chains.degrees[chains.outputs.index(bound.outputs[0])]
        return _left(self.roots_for(degree - 1), bound, slowest)

    def bounded(self, x: jax.Array) -> jax.Array:
        """Return sigma(x) = x / sqrt(1 + (x/s)^2): odd, increasing, of slope 1 at 0, below s."""
        # By the inverse, which is 0 where s is infinite and sigma is linear.
        inverse = 1.0 / jnp.asarray(self.speeds, x.dtype)
        return x * jax.lax.rsqrt(1.0 + (x * inverse) ** 2)

    # ---- what any agent does ----

    def carried(
        self,
        model: ControlAffine,
        signal: jax.Array,
        feedforward: jax.Array,
        u: Input,
        time: Scalar,
    ) -> jax.Array:
        """Return zeta (m,) of a leader that moves on at the rate zeta' that it sent."""
        return signal + time * feedforward[: len(signal)]

    def initial_memory(
        self, model: ControlAffine, x: State, ahead: jax.Array, moves: bool = False
    ) -> FlatMemory:
        """Return the memory of an agent that begins at x, with the derivatives of its reference.

        `moves`: whether it moves along the reference.
        """
        return self._counting(self.ready.begin(model, x, ahead, moves))

    def beside(self, memory: FlatMemory, signal: jax.Array) -> FlatMemory:
        """Return the memory of an agent that begins late, its heading next to that of a signal."""
        return self.ready.beside(memory, signal)

    def init(self) -> FlatMemory:
        """Return a memory of zeros."""
        return self._counting(self.ready.zero_memory())

    def _counting(self, memory: FlatMemory) -> FlatMemory:
        return memory if self.safety is None else memory._replace(active=0.0 * memory.half)

    def signal(
        self, model: ControlAffine, x: State, offset: State, memory: FlatMemory
    ) -> jax.Array:
        """Return zeta less the offset, (m,)."""
        return self.ready.place(model, x, offset, memory)

    def goal_offset(self, model: ControlAffine, own: OwnOffset, t: Scalar) -> tuple[State, State]:
        """Return the stopping point q(D) xi / q(0) of an offset, and its rate, (n,) each."""
        return self.ready.stopping_offset(model, own, t)

    def hull(self, model: ControlAffine, x: State, memory: FlatMemory) -> Float[jax.Array, "r d"]:
        """Return the points in whose hull the position stays, the last one of zeta."""
        return self.hull_of(model, self.ready.flat_values(model, x, memory))

    def active(self, memory: FlatMemory) -> jax.Array | None:
        """Return how many others changed the rates of agents, (K,)."""
        return memory.active

    def hull_of(
        self, model: ControlAffine, values: Float[jax.Array, "r m"]
    ) -> Float[jax.Array, "r d"]:
        """Return the same of flat coordinates."""
        places = self.places(model)
        degree = self.ready.chains.degrees[places[0]]
        return hull_points(values[:degree, np.array(places)], self.roots_for(degree - 1))

    def places(self, model: ControlAffine) -> list[int]:
        """Return which flat outputs are the position.

        Raises:
            LawError: a coordinate is none, or their chains are too long or not of one length.
        """
        name, chains = f"`{type(model).__name__}`", self.ready.chains
        places = self.ready.places_of(model)
        degrees = [chains.degrees[k] for k in places]
        if len({*degrees}) > 1 or degrees[0] > MOST_POINTS:
            raise LawError(
                "`safety` needs chains of one length for the coordinates of the position, at most "
                f"{MOST_POINTS}, and {name} has {listing(map(str, degrees))}."
            )
        return places

    def message(self, model: ControlAffine, x: State, v: Input, memory: FlatMemory) -> jax.Array:
        """Return zeta' less that of the own offset, (m,)."""
        return memory.rate

    def signal_names(self, model: ControlAffine) -> tuple[str, ...]:
        """Return the names of the outputs."""
        return self.ready.chains.outputs

    message_names = signal_names

    def settle(
        self,
        model: ControlAffine,
        view: LocalView,
        desired: Input,
        delivered: Input,
        memory: FlatMemory,
    ) -> FlatMemory:
        """Return the memory with the input that the actuators delivered."""
        return self.ready.settle(model, view.x, desired, delivered, memory, view.period)

    def refusals(self, model: ControlAffine, states: Array) -> Iterator[tuple[int, str]]:
        """Yield the starts outside of the model's flat coordinates."""
        if isinstance(model, UnlikeAgents):
            for k, part in enumerate(model.models):
                mine = np.flatnonzero(np.asarray(states)[:, -1] == k)
                own = np.asarray(states)[mine][:, model.states_of(k)]
                found = self._of_group(k).refusals(part, own) if len(mine) else ()
                yield from ((int(mine[row]), why) for row, why in found)
        for bound in model.flat_bounds or ():
            if len(bound.outputs) > 1:
                yield from self._starts_at_rest(model, states, bound)
            else:
                yield from _outside(self.ready.chains, model, states, bound)

    def _of_group(self, kind: int) -> Self:
        """Return the law of a group of unlike agents."""
        loop = self.loop
        assert isinstance(loop, UnlikeLoop)
        law = eqx.tree_at(lambda law: law.loop, self, loop.loops[kind])
        ahead = getattr(law, "ahead", None)
        return law if ahead is None else dataclasses.replace(law, ahead=loop.ahead_of(kind, ahead))

    def _starts_at_rest(
        self, model: ControlAffine, states: Array, bound: FlatBound
    ) -> Iterator[tuple[int, str]]:
        """Yield the rows of states (K, n) at which a bounded vector is 0, and has no direction."""
        chains = self.ready.chains
        places = np.array([chains.outputs.index(name) for name in bound.outputs])

        def one(x: State) -> jax.Array:
            return to_flat(model, chains, x, self.begin(model, x).chain).values

        values = np.asarray(jax.vmap(one)(jnp.asarray(states)))[:, bound.derivative, places]
        names = listing(name + "'" * bound.derivative for name in bound.outputs)
        for k in np.flatnonzero(~(np.linalg.norm(values, axis=1) > bound.above + _REST)):
            yield int(k), f"{names} are 0 there, and allowed is {bound.within}"


def groups_of(model: ControlAffine) -> tuple[ControlAffine, ...]:
    """Return the models of all groups of agents: one, unless they are unlike."""
    return model.models if isinstance(model, UnlikeAgents) else (model,)


def loops_of(loop: FlatLoop | UnlikeLoop) -> tuple[FlatLoop, ...]:
    """Return the loops of all groups."""
    return loop.loops if isinstance(loop, UnlikeLoop) else (loop,)


def _checked_chains(model: ControlAffine) -> Chains:
    try:
        chains = chains_of(model)
        check_bounds(model, chains)
    except ModelError as error:
        raise LawError(str(error)) from None
    return chains


def _left(roots: tuple[float, ...], bound: FlatBound, slowest: float) -> float:
    """Return the speed of each output at which agreement alone leads to a bound; 0 for none."""
    allowed = slowest - bound.above
    if not allowed > 0.0 or bound.derivative > min(2, len(roots)):
        return 0.0
    if bound.derivative == 1:
        return allowed / math.sqrt(len(bound.outputs))
    # v' is at most the variation of h over that speed, and h rises once to its largest value.
    products = [np.prod([b - a for b in roots if b != a]) for a in roots]
    times = np.linspace(0.0, 20.0 / min(roots), 20_000)
    falls = np.exp(-np.outer(roots, times))
    h = (np.prod(roots) / np.array(products)) @ falls
    return allowed / (2.0 * float(h.max())) / math.sqrt(len(bound.outputs))


def _positive(root: object) -> bool:
    return isinstance(root, int | float) and 0.0 < root < math.inf


def _outside(
    chains: Chains, model: ControlAffine, states: Array, bound: FlatBound
) -> Iterator[tuple[int, str]]:
    """There the inputs push it the wrong way, or without integrators it is below."""
    output = chains.outputs.index(bound.outputs[0])
    if not chains.size:
        yield from _below(chains, model, states, bound)
        return
    both = np.concatenate([[np.asarray(model.trim[0], float)], states])
    upright, *ways = np.asarray(_pushes(chains, model, jnp.asarray(both), output)).tolist()
    for k, (x, way) in enumerate(zip(states.tolist(), ways, strict=True)):
        off = [name for name, v in zip(model.state_names, x) if not _charted(model, name, v)]
        # At the border the thrust that is level is infinite, and beyond it is turned downward.
        if off or not way / upright > _LEAST:
            i = model.state_names.index(off[0]) if off else None
            why = f"`{bound.outputs[0]}` is not pushed upward there"
            why = why if i is None else f"`{off[0]}` is {x[i]:.4g} {model.state_units[i]}".rstrip()
            yield k, f"{why}, allowed is {bound.within}"


def _below(
    chains: Chains, model: ControlAffine, states: Array, bound: FlatBound
) -> Iterator[tuple[int, str]]:
    output, order = chains.outputs.index(bound.outputs[0]), bound.derivative

    def one(x: State) -> jax.Array:
        return to_flat(model, chains, x, x[:0]).values[order, output]

    name = bound.outputs[0] + "'" * order
    for k, value in enumerate(np.asarray(jax.vmap(one)(jnp.asarray(states))).tolist()):
        if not value > bound.above:
            yield k, f"`{name}` is {value:.4g} there, allowed is {bound.within}"


def _charted(model: ControlAffine, name: str, value: float) -> bool:
    low, high = model.chart.get(name, (-math.inf, math.inf))
    return low < value < high


@cached_jit
def _pushes(chains: Chains, model: ControlAffine, states: jax.Array, output: int) -> jax.Array:
    """Return how the first integrator before an input moves what it reaches of an output, (K,)."""
    order = chains.degrees[output] - max(chains.integrators)

    def one(x: State) -> jax.Array:
        def derivative(e: jax.Array) -> jax.Array:
            return to_flat(model, chains, x, e).values[order, output]

        return jax.grad(derivative)(jnp.zeros(chains.size, x.dtype))[0]

    return jax.vmap(one)(states)
