"""Agents of different models in one formation, as one model whose state says which agent it is."""

import functools
from collections.abc import Iterable, Sequence
from typing import Self, TypeVar, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.model import ControlAffine, Limits, Pair, Rows
from echelon.core.errors import ModelError, listing
from echelon.core.types import Array, Input, InputMap, Output, State

KIND = "kind"
"""The last state, which says of which group an agent is, from 0 on."""
_AWAY = 1e-9
"""m; what rounding leaves of an offset."""
_Entry = TypeVar("_Entry")


@final
class UnlikeAgents(ControlAffine):
    """Groups of agents of different models: xdot = f_k(x) + g_k(x) u of the group k of an agent.

    States of one name are one state, such as `x`, and each group has inputs of its own. The last
    state, `kind`, is the number of the group and stays. States that an agent does not have stay at
    the trim, and inputs that it does not have do nothing.

    Args:
        models: of the groups.
        names: of the groups, all different.
        kinds: of each agent, the number of its group.
        leader: the number of an agent that leads: the trim is of its group.

    Raises:
        ModelError: groups give a state of one name different units or trims, or one is `kind`.
    """

    models: tuple[ControlAffine, ...]
    names: tuple[str, ...] = eqx.field(static=True)
    kinds: tuple[int, ...] = eqx.field(static=True)
    leader: int = eqx.field(static=True, default=0)

    @classmethod
    def of(cls, groups: Iterable[tuple[str, int, ControlAffine]], leader: int = 0) -> Self:
        """Return the agents of groups (name, count, model), numbered one group after another."""
        names, counts, models = zip(*groups, strict=True)
        again = [f"{name} {names[: k + 1].count(name)}" for k, name in enumerate(names)]
        named = [new if names.count(old) > 1 else old for old, new in zip(names, again)]
        kinds = np.repeat(np.arange(len(counts)), counts).tolist()
        return cls(tuple(models), tuple(named), tuple(kinds), leader)

    def __check_init__(self) -> None:
        if len(set(self.names)) < len(self.names):
            raise ModelError(f"groups have the names {listing(self.names)}, allowed is each once.")
        if any(KIND in model.state_names for model in self.models):
            raise ModelError(f"got a state `{KIND}`, which is the number of a group; rename it.")
        for what in ("state_units", "trim"):
            seen = dict[str, tuple[object, str]]()
            for name, model in zip(self.names, self.models, strict=True):
                values = model.trim[0] if what == "trim" else model.state_units
                for state, value in zip(model.state_names, values, strict=True):
                    other, whose = seen.setdefault(state, (value, name))
                    if other != value:
                        raise ModelError(
                            f"the state `{state}` of `{name}` has the {what.split('_')[-1]} "
                            f"{value!r}, and that of `{whose}` {other!r}; states of one name are "
                            "one state in a formation."
                        )

    # ---- whose is what ----

    def kinds_of(self, agents: Iterable[int]) -> tuple[int, ...]:
        """Return the groups that some agents are of."""
        return tuple(sorted({self.kinds[agent] for agent in agents}))

    @property
    def own_kind(self) -> int:
        """The group of the agent that leads."""
        return self.kinds[self.leader]

    def states_of(self, kind: int) -> Array:
        """Return where the states of a group are among all."""
        return np.array([self.state_names.index(x) for x in self.models[kind].state_names])

    def inputs_of(self, kind: int) -> slice:
        """Return where the inputs of a group are among all."""
        ends = np.cumsum([0, *(len(model.input_names) for model in self.models)]).tolist()
        return slice(ends[kind], ends[kind + 1])

    def chosen(
        self, x: State, each: Sequence[_Entry], kinds: tuple[int, ...] | None = None
    ) -> _Entry:
        """Return of values for each group, or for some, that of the group of an agent at x."""
        known = kinds or tuple(range(len(self.models)))

        def choose(*leaves: jax.Array) -> jax.Array:
            pairs = zip(known[1:], leaves[1:], strict=True)
            return functools.reduce(
                lambda before, pair: jnp.where(x[-1] > pair[0] - 0.5, pair[1], before),
                pairs,
                leaves[0],
            )

        return jax.tree.map(choose, *each)

    def part(self, kind: int, x: State) -> jax.Array:
        """Return the states of a group; those of its trim for an agent of another group."""
        mine = jnp.abs(x[-1] - kind) < 0.5
        return jnp.where(mine, x[self.states_of(kind)], jnp.asarray(self._rest(kind), x.dtype))

    def whole(self, kind: int, part: jax.Array) -> State:
        """Return the state of an agent of a group; what it does not have is at the trim."""
        rest = jnp.asarray(np.asarray(self.trim[0], float), part.dtype)
        return rest.at[self.states_of(kind)].set(part).at[-1].set(kind)

    def settled(self, states: Array) -> Array:
        """Return states (..., N, n) of all agents, each of its group, in NumPy."""
        rest = np.broadcast_to(np.asarray(self.trim[0], float), states.shape).copy()
        for agent, kind in enumerate(self.kinds):
            at = self.states_of(kind)
            rest[..., agent, at] = states[..., agent, at]
            rest[..., agent, -1] = kind
        return rest

    def check_goals(self, goals: Array) -> None:
        """Raise `ModelError` where a goal (N, n) is off in a coordinate that an agent lacks."""
        gaps = goals - self.settled(goals)
        for agent, kind in enumerate(self.kinds):
            for name in sorted({*self.position} - {*self.models[kind].position}):
                away = float(gaps[agent, self.state_names.index(name)])
                if abs(away) > _AWAY:
                    raise ModelError(
                        f"agent {agent}, a `{self.names[kind]}`, has no `{name}`, and its goal "
                        f"there is {away:.4g} off; change its offset."
                    )

    def with_kinds(self, offsets: Array) -> Array:
        """Return offsets (N, n) with those between the groups of agents and of the leader.

        Raises:
            ModelError: there are more or fewer agents.
        """
        self.check_count(len(offsets))
        return np.column_stack([offsets[:, :-1], np.array(self.kinds, float) - self.own_kind])

    def start_of(self, agent: int, state: Sequence[float]) -> Array:
        """Return the start (n,) of an agent from the states of its group.

        Raises:
            ModelError: they are not as many as the group has.
        """
        if not 0 <= agent < len(self.kinds):
            return np.asarray(state, float)
        kind = self.kinds[agent]
        names = self.models[kind].state_names
        if len(state) != len(names):
            raise ModelError(
                f"the initial state of agent {agent} has {len(state)} numbers, and `"
                f"{self.names[kind]}` has {len(names)} states, {listing(names)}."
            )
        whole = np.array(self.trim[0], float)
        whole[self.states_of(kind)], whole[-1] = state, kind
        return whole

    def check_count(self, agents: int) -> None:
        """Raise `ModelError` unless the groups have so many agents in all."""
        if agents != len(self.kinds):
            raise ModelError(
                f"the groups have {len(self.kinds)} agents in all, and the graph {agents}."
            )

    def states_called(self, name: str) -> tuple[int, ...]:
        """Return the indices of a state or of a group of states; `kind` is nobody's to change."""
        if name == KIND:
            raise ModelError(f"got the state `{KIND}`, which says of which group an agent is.")
        return super().states_called(name)

    def in_words(self) -> str:
        """Return which agents are of which group."""
        return ", ".join(
            f"{name} {_range(np.flatnonzero(np.array(self.kinds) == k))}"
            for k, name in enumerate(self.names)
        )

    def _rest(self, kind: int) -> Array:
        return np.asarray(self.models[kind].trim[0], float)

    # ---- names ----

    @property
    def state_names(self) -> tuple[str, ...]:
        """All states, and `kind`."""
        names = dict.fromkeys(name for model in self.models for name in model.state_names)
        return (*names, KIND)

    @property
    def state_units(self) -> tuple[str, ...]:
        """Those of the groups."""
        pairs = (zip(model.state_names, model.state_units) for model in self.models)
        units = {name: unit for pair in pairs for name, unit in pair}
        return tuple(units.get(name, "") for name in self.state_names)

    @property
    def input_names(self) -> tuple[str, ...]:
        """The inputs of each group, after its name."""
        pairs = zip(self.names, self.models, strict=True)
        return tuple(f"{name} {entry}" for name, model in pairs for entry in model.input_names)

    @property
    def input_units(self) -> tuple[str, ...]:
        """Those of the groups."""
        return sum((tuple(model.input_units) for model in self.models), start=())

    @property
    def output_names(self) -> tuple[str, ...]:
        """All outputs."""
        return tuple(dict.fromkeys(name for model in self.models for name in model.output_names))

    @property
    def state_groups(self) -> dict[str, tuple[str, ...]]:
        """Those of the groups together."""
        named = dict[str, dict[str, None]]()
        for model in self.models:
            for key, members in model.state_groups.items():
                named.setdefault(key, {}).update(dict.fromkeys(members))
        return {key: tuple(members) for key, members in named.items()}

    @property
    def position(self) -> tuple[str, ...]:
        """All coordinates of a position."""
        return tuple(dict.fromkeys(name for model in self.models for name in model.position))

    @property
    def radius(self) -> float | None:  # pyright: ignore
        """The largest one."""
        return max((x.radius for x in self.models if x.radius is not None), default=None)

    @property
    def chart(self) -> dict[str, tuple[float, float]]:  # pyright: ignore
        """Those of the groups."""
        return {name: bounds for model in self.models for name, bounds in model.chart.items()}

    # ---- the trim, and inputs ----

    @property
    def trim(self) -> Pair:
        """That of the leader's group, with the inputs of all groups."""
        pairs = (zip(model.state_names, model.trim[0]) for model in self.models)
        rest = {name: value for pair in pairs for name, value in pair}
        rest[KIND] = float(self.own_kind)
        inputs = sum((tuple(model.trim[1]) for model in self.models), start=())
        return tuple(rest[name] for name in self.state_names), inputs

    @property
    def input_scale(self) -> Rows:
        """S of each group, block by block."""
        return _blocks([np.asarray(model.input_scale, float) for model in self.models])

    @property
    def weights(self) -> Pair:
        """Ones: a gain is of one model, and no law uses these."""
        return (1.0,) * len(self.state_names), (1.0,) * len(self.input_names)

    @property
    def input_limits(self) -> Limits | None:  # pyright: ignore
        """Those of each group; none where no group has any."""
        limits = [model.input_limits or _none(model) for model in self.models]
        if all(model.input_limits is None for model in self.models):
            return None
        low = sum((tuple(x.low) for x in limits), start=())
        high = sum((tuple(x.high) for x in limits), start=())
        return Limits(_blocks([np.asarray(x.matrix, float) for x in limits]), low, high)

    def limit(self, u: Input) -> Input:
        """Return what the actuators of each group deliver."""
        each = enumerate(self.models)
        return jnp.concatenate([model.limit(u[self.inputs_of(k)]) for k, model in each])

    def own_state(self, x: State) -> State:
        """Return a state of which nothing that the agent does not have has moved."""
        kinds = range(len(self.models))
        return self.chosen(x, [self.whole(k, x[self.states_of(k)]) for k in kinds])

    # ---- equations ----

    def drift(self, x: State) -> State:
        """Return f(x) of the agent's group."""
        none = jnp.zeros_like(x)
        return self.chosen(
            x,
            [
                none.at[self.states_of(k)].set(model.drift(self.part(k, x)))
                for k, model in enumerate(self.models)
            ],
        )

    def input_map(self, x: State) -> InputMap:
        """Return g(x) of the agent's group."""
        none = jnp.zeros((len(x), len(self.input_names)), x.dtype)
        return self.chosen(
            x,
            [
                none.at[self.states_of(k), self.inputs_of(k)].set(model.input_map(self.part(k, x)))
                for k, model in enumerate(self.models)
            ],
        )

    def output(self, x: State) -> Output:
        """Return h(x) of the agent's group; 0 for what it does not have."""
        none, names = jnp.zeros(len(self.output_names), x.dtype), self.output_names
        each = list[jax.Array]()
        for k, model in enumerate(self.models):
            at = np.array([names.index(name) for name in model.output_names])
            each.append(none.at[at].set(model.output(self.part(k, x))))
        return self.chosen(x, each)

    def difference(self, x: State, y: State) -> State:
        """Return x - y by the agent's group."""
        plain, each = x - y, list[jax.Array]()
        for k, model in enumerate(self.models):
            at = self.states_of(k)
            each.append(plain.at[at].set(model.difference(x[at], y[at])))
        return self.chosen(x, each)

    # ---- what leads ----

    @property
    def flat_outputs(self) -> tuple[str, ...]:
        """Those of the leader's group."""
        return self.models[self.own_kind].flat_outputs

    @property
    def flat_order(self) -> int:
        """That of the leader's group."""
        return self.models[self.own_kind].flat_order

    def flat(self, derivatives: jax.Array) -> tuple[State, Input]:
        """Return the state and input of the leader on a path."""
        kind = self.own_kind
        x, u = self.models[kind].flat(derivatives)
        rest = jnp.asarray(np.asarray(self.trim[1], float), x.dtype)
        return self.whole(kind, x), rest.at[self.inputs_of(kind)].set(u)


def title_of(model: ControlAffine) -> str:
    """Return the name of a model, of unlike agents which agents are of which group."""
    return model.in_words() if isinstance(model, UnlikeAgents) else type(model).__name__


def group_of(model: ControlAffine, agent: int) -> str:
    """Return the group of an agent; empty where all agents are alike."""
    return model.names[model.kinds[agent]] if isinstance(model, UnlikeAgents) else ""


def settled(model: ControlAffine, states: Array) -> Array:
    """Return states (..., N, n), of unlike agents each with its own."""
    return model.settled(states) if isinstance(model, UnlikeAgents) else states


def _none(model: ControlAffine) -> Limits:
    m = len(model.input_names)
    return Limits(tuple(map(tuple, np.eye(m).tolist())), (-np.inf,) * m, (np.inf,) * m)


def _blocks(parts: list[Array]) -> Rows:
    """Return matrices along the diagonal of one."""
    rows, columns = (np.cumsum([0, *(part.shape[k] for part in parts)]) for k in (0, 1))
    whole = np.zeros((rows[-1], columns[-1]))
    for k, part in enumerate(parts):
        whole[rows[k] : rows[k + 1], columns[k] : columns[k + 1]] = part
    return tuple(map(tuple, whole.tolist()))


def _range(agents: Array) -> str:
    """Return numbers of neighbouring agents in words, as in `1 to 3`."""
    first, last = int(agents[0]), int(agents[-1])
    if last - first + 1 == len(agents) > 2:
        return f"{first} to {last}"
    return " and ".join(map(str, agents.tolist()))
