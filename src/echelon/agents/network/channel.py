"""What a real network does to messages: it sends at a rate, delays, loses and reorders them.

It knows neither models nor laws: a message is a row of arrays. Which messages are lost, and when
the others arrive, depends only on the seed, the message's number, its sender and its receiver.
"""

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Int

from echelon.agents.part import Effects, WorldPart
from echelon.core.errors import SimulationError, check_kind, is_number
from echelon.core.numerics import Draw, key_of, uniform
from echelon.core.types import Array, PyTree
from echelon.core.words import Feedforward, MessageContent, NeighbourChoice, Prediction

LATE = "messages are late or lost"
NO_DEVIATIONS = (
    "the scenario has {}, and agents in processes of their own need messages of deviations; use "
    "`--set network.messages=deviation --set network.rate=50`"
)
_MOST = 2**30
NEVER = -_MOST
"""The stamp of a message that never came, and the arrival of one that never does: before all steps,
and all times in s."""
_ROUNDING = 1e-6
"""Of a step: what divisions of times leave of whole numbers."""


@final
@dataclasses.dataclass(frozen=True)
class Bursts:
    """Outages of a link, during which all its messages are lost.

    Args:
        share: of the time that a link is out, from 0 to below 1.
        length: mean length of an outage, s.
    """

    share: float = 0.0
    length: float = 0.2


@final
@dataclasses.dataclass(frozen=True)
class Network(WorldPart):
    """A network on which messages take time and are lost.

    Each agent sends one message to all that receive from it, `rate` times a second, and uses what
    it last received. Its own state is never late.

    Args:
        rate: messages per second, Hz; a whole number of control steps lie between two.
        delay: of each message, s; rounded up to control steps, and at least one.
        jitter: largest additional delay, s, drawn for each message and link; messages may overtake
            each other, and an older one never replaces a newer one.
        loss: probability that a message is lost on a link, from 0 to 1.
        bursts: outages of links.
        messages: `deviation`, the sender's deviation from where it expects the leader, which hardly
            changes while a message is under way; `state`, the signal itself.
        prediction: how agents predict the leader from what it last sent: `preview`, they know its
            plan; `packet`, they carry on its last motion by the model. Only for `deviation`.
        forget: age, s, beyond which what a neighbour sent is not used.
        hears: `all` neighbours, or `leaderward`, those alone with fewer hops to the leader, as
            counted by the messages that arrive.
        seed: of losses and delays; by default that of the run.

    Raises:
        SimulationError: a number is out of its range.
    """

    key = "network"

    rate: float = 50.0
    delay: float = 0.0
    jitter: float = 0.0
    loss: float = 0.0
    bursts: Bursts = Bursts()
    messages: MessageContent = MessageContent.DEVIATION
    prediction: Prediction = Prediction.PREVIEW
    forget: float = 0.5
    hears: NeighbourChoice = NeighbourChoice.ALL
    seed: int | None = None

    def __post_init__(self) -> None:
        check_kind("bursts", self.bursts, Bursts)
        values = dataclasses.asdict(self)
        values |= {f"bursts.{name}": value for name, value in values.pop("bursts").items()}
        for names, (allowed, fits) in _RANGES.items():
            for name in names:
                _check_number(name, values[name], allowed, fits)
        for name, word in (
            ("messages", MessageContent),
            ("prediction", Prediction),
            ("hears", NeighbourChoice),
        ):
            member = word.checked(getattr(self, name), f"`{name}` of the network")
            object.__setattr__(self, name, member)
        least = 2.0 / self.rate + self.delay + self.jitter
        if self.forget < least:
            raise SimulationError(
                f"`forget` of the network is {self.forget:g} s, and must be at least two periods, "
                f"the delay and the jitter together, {least:g} s; otherwise messages are too old "
                "when they arrive."
            )

    def prepared(self, dt: float, horizon: float, seed: int) -> "Channel":
        """Return the network as arrays for a control step and a horizon (s) and a run's seed.

        Raises:
            SimulationError: its rate does not divide that of the control steps, or no message
                would arrive within the horizon.
        """
        every = _steps(1.0, self.rate * dt)
        if every < 1 or abs(every * self.rate * dt - 1.0) > _ROUNDING:
            near = 1.0 / (max(1, every) * dt)
            raise SimulationError(
                f"`rate` of the network is {self.rate:g} Hz, and must be the control rate "
                f"{1.0 / dt:g} Hz divided by a whole number, such as {near:g} Hz."
            )
        for name, late in (("delay", self.delay), ("jitter", self.jitter)):
            if late > horizon:
                raise SimulationError(
                    f"`{name}` of the network is {late:g} s, and must be at most the horizon, "
                    f"{horizon:g} s, within which otherwise no message arrives."
                )
        delay = max(1, math.ceil(self.delay / dt - _ROUNDING))
        jitter = math.floor(self.jitter / dt + _ROUNDING)
        ends = min(1.0, 1.0 / max(self.bursts.length * self.rate, 1.0))
        share = self.bursts.share
        return Channel(
            every=np.asarray(every, np.int32),
            delay=np.asarray(delay, np.int32),
            jitter=np.asarray(jitter, np.int32),
            forget=np.asarray(_steps(self.forget, dt), np.int32),
            loss=np.asarray(self.loss),
            share=np.asarray(share),
            begins=np.asarray(min(1.0, ends * share / (1.0 - share))),
            ends=np.asarray(ends),
            key=key_of(seed if self.seed is None else self.seed),
            slots=-(-(delay + jitter) // every) + 1,
            bursty=share > 0.0,
            messages=self.messages,
            prediction=self.prediction,
            hears=self.hears,
        )

    def ignored(self) -> str:
        """Return that messages take time."""
        return LATE

    def presumed(self) -> str:
        """Return of what messages theorems are."""
        return "messages that arrive at once"

    def effects(self) -> Effects:
        """Return how old messages may be that arrive."""
        return Effects(age=self.delay + self.jitter)

    def check_laws(self, laws: Any, graph: Any, dt: float) -> None:
        """Raise `EchelonError` if laws need what is late, a plan without one, or a shorter step."""
        for fault in self._unsuited(laws):
            raise SimulationError(fault)
        laws.check_late(graph, dt)

    def _unsuited(self, laws: Any) -> Iterator[str]:
        word, leader, follower = laws.feedforward, *map(type, (laws.leader, laws.follower))
        if word in (Feedforward.PARENT, Feedforward.RELAY_VELOCITY):
            yield (
                f"`feedforward` of the follower is `{word}`, {word.value}, and a network delivers "
                "nothing in the same step; use `relay`, which is predicted."
            )
        if laws.safety is not None and not self._by_plan:
            yield (
                "`safety` over a network needs the messages `deviation` and the prediction "
                f"`preview`, and got `{self.messages}` and `{self.prediction}`."
            )
        preview = "`prediction` of the network is `preview`, and"
        if self._by_plan and not laws.plans:
            yield f"{preview} a leader under the law `{leader.__name__}` has no plan; use `packet`."
        if self._by_plan and not laws.speak_alike:
            yield (
                f"{preview} followers under the law `{follower.__name__}` do not send what the plan"
                f" of a leader under `{leader.__name__}` is about; use `packet`."
            )

    @property
    def _by_plan(self) -> bool:
        preview = self.prediction is Prediction.PREVIEW
        return preview and self.messages is MessageContent.DEVIATION

    def uncovered(self, still: bool) -> tuple[str, str]:
        """Return why no theorem bounds late messages, and a remedy; `still` of leaders at rest."""
        if self.loss >= 1.0:
            return "no message arrives", "set `loss` of the network below 1"
        if self.messages is MessageContent.STATE:
            text = "messages contain stopping points that are out of date when they arrive"
            return text, "set `messages: deviation`"
        if self.prediction is not Prediction.PREVIEW and not still:
            text = "without a plan of the leader followers lag behind it"
            return text, "set `prediction: preview`"
        return "", ""

    def unflown(self) -> str:
        """Return that a flight has no outages, and no messages of states."""
        if self.messages is not MessageContent.DEVIATION:
            return NO_DEVIATIONS.format("`network.messages` `state`")
        text = "`network.bursts` has no counterpart in a flight; use `network.loss`"
        return text if self.bursts.share else ""

    def sentences(self, result: Any) -> str:
        """Return what a report says of it."""
        known = " Every agent knows the leader's whole plan before the start. "
        known += "Messages only carry deviations from it, so few are needed."
        traffic, messages = result.traffic, ""
        if traffic is not None and traffic.sent:
            messages = f" Messages: {traffic.sent} sent, {traffic.lost} lost"
            messages += f", {traffic.late} arrived after a newer one" * (traffic.late > 0)
            if np.isfinite(traffic.mean):
                messages += f"; those in use were {1e3 * traffic.mean:.3g} ms old on average and "
                messages += f"{1e3 * traffic.largest:.4g} ms at most"
            messages += "."
        return f"Network: {self}." + known * self._by_plan + messages

    def variables(self, result: Any) -> dict[str, Any]:
        """Return the ages of messages and which were lost, of each frame, link and end."""
        traffic, seconds = result.traffic, {"units": "s"}
        if traffic is None:
            return {}
        link = ("time", "edge", "end")
        ages = traffic.of_agents(result.graph.edges, result.graph.agents, result.presence)
        return {
            "age": (("time", "agent"), ages, seconds),
            "edge_age": (link, traffic.ages, seconds),
            "edge_lost": (link, traffic.losses),
            "forget": ((), self.forget, seconds),
        }

    def received(self, ideal: tuple[str, ...]) -> tuple[str, ...]:
        """Return what each follower receives, in words."""
        if self.messages is MessageContent.STATE:
            return ("neighbours' signals and the feed-forward of the leader, all late",)
        leader = _LEADERS[self.prediction]
        return (f"neighbours' deviations from where they expect the leader; {leader}; all late",)

    def __str__(self) -> str:
        parts = [f"{self.rate:g} Hz", f"delay {1e3 * self.delay:g} ms"]
        parts += [f"jitter up to {1e3 * self.jitter:g} ms"] if self.jitter else []
        parts += [f"{100.0 * self.loss:g} % lost"] if self.loss else []
        if self.bursts.share:
            parts.append(
                f"links out {100.0 * self.bursts.share:g} % of the time, "
                f"{self.bursts.length:g} s on average"
            )
        content = f"messages contain {self.messages.value}"
        return ", ".join(parts) + f"; {content}"


_LEADERS: Mapping[Prediction, str] = {
    Prediction.PREVIEW: "the leader's plan, and its last deviation from it",
    Prediction.PACKET: "the leader's last state and input",
}
_RANGES: Mapping[tuple[str, ...], tuple[str, Callable[[float], bool]]] = {
    ("rate", "forget", "bursts.length"): ("positive", lambda x: x > 0.0),
    ("delay", "jitter"): ("not negative", lambda x: x >= 0.0),
    ("loss",): ("from 0 to 1", lambda x: 0.0 <= x <= 1.0),
    ("bursts.share",): ("at least 0 and below 1", lambda x: 0.0 <= x < 1.0),
}
"""What is allowed of the numbers of a network, all of them finite."""


def _steps(time: float, step: float) -> int:
    """Return how many steps a time takes, at most so many as whole numbers of 32 bits count."""
    return _MOST if time >= _MOST * step else round(time / step)


def _check_number(name: str, value: object, allowed: str, fits: Callable[[float], bool]) -> None:
    if not is_number(value):
        raise SimulationError(f"`{name}` of the network is {value!r}, and must be a number.")
    if not (math.isfinite(value) and fits(float(value))):
        raise SimulationError(f"`{name}` of the network is {value}, and must be {allowed}.")


class InFlight(NamedTuple):
    """The last R messages of each agent, and what becomes of them on each of K links.

    Attributes:
        content: of the messages, leaves (R, N, ...).
        arrival: (R, K) the step at which a message arrives; `NEVER` if it is lost.
        out: (K,) whether the link was out when the last message was sent.
    """

    content: PyTree
    arrival: Int[jax.Array, "R K"]
    out: Bool[jax.Array, " K"]


class Arrival(NamedTuple):
    """What arrives at a step on each link: the newest message that is newer than the last one.

    Attributes:
        slot: (K,) its row of the posts.
        stamp: (K,) the step at which it was sent; where nothing arrives, the last one's.
        new: (K,) whether something arrives.
    """

    slot: Int[jax.Array, " K"]
    stamp: Int[jax.Array, " K"]
    new: Bool[jax.Array, " K"]


class Channel(eqx.Module):
    """The network of a run, in control steps; K links lead from `senders` to `receivers`.

    Attributes:
        every: steps between two messages of an agent.
        delay, jitter, forget: steps.
        loss, share, begins, ends: probabilities; the last two that an outage begins and ends with a
            message.
        key: of the draws.
        slots: R, messages of an agent that may be under way.
        bursty: whether there are outages.
        messages, prediction, hears: as in `Network`.
    """

    every: Array
    delay: Array
    jitter: Array
    forget: Array
    loss: Array
    share: Array
    begins: Array
    ends: Array
    key: Array
    slots: int = eqx.field(static=True)
    bursty: bool = eqx.field(static=True)
    messages: MessageContent = eqx.field(static=True)
    prediction: Prediction = eqx.field(static=True)
    hears: NeighbourChoice = eqx.field(static=True)

    @property
    def still(self) -> "Channel":
        """The network that delays every message alike, and loses none."""
        none = np.zeros_like(self.loss)
        steady = dict(loss=none, jitter=np.zeros_like(self.jitter), share=none, begins=none)
        return dataclasses.replace(self, bursty=False, **steady)

    @property
    def steady(self) -> bool:
        """Whether it delays every message alike, and loses none."""
        return not (self.bursty or self.loss > 0.0 or self.jitter > 0)

    def begin(self, content: PyTree, links: int) -> InFlight:
        """Return posts before the first message, of which `content` (N, ...) is an example."""
        rows = jax.tree.map(lambda x: jnp.zeros((self.slots, *x.shape), x.dtype), content)
        return InFlight(
            rows,
            jnp.full((self.slots, links), NEVER, jnp.int32),
            jnp.zeros(links, bool),
        )

    def post(
        self,
        posts: InFlight,
        step: jax.Array,
        content: PyTree,
        sends: Bool[jax.Array, " K"],
        receivers: Array | jax.Array,
        senders: Array | jax.Array,
    ) -> InFlight:
        """Return the posts after a step; links (K,) that carry nothing lose the message."""
        number = step // self.every
        slot = number % self.slots

        def put(posts: InFlight) -> InFlight:
            lost, late, out = self._draw(number, step, posts.out, receivers, senders)
            arrives = step + self.delay + late
            arrival = jnp.where(lost | ~sends, NEVER, arrives)
            rows = jax.tree.map(lambda row, x: row.at[slot].set(x), posts.content, content)
            return InFlight(rows, posts.arrival.at[slot].set(arrival.astype(jnp.int32)), out)

        return jax.lax.cond(step % self.every == 0, put, lambda posts: posts, posts)

    def _draw(
        self,
        number: jax.Array,
        step: jax.Array,
        out: Bool[jax.Array, " K"],
        receivers: Array | jax.Array,
        senders: Array | jax.Array,
    ) -> tuple[Bool[jax.Array, " K"], Int[jax.Array, " K"], Bool[jax.Array, " K"]]:
        """Return which links lose a message, how late it is beyond the delay, and which are out."""

        def one(
            out: jax.Array, i: jax.Array, j: jax.Array
        ) -> tuple[jax.Array, jax.Array, jax.Array]:
            # By receiver and sender, and not by the link's place: no other edge changes a draw.
            # Without jitter nothing is drawn, which takes as long as all else.
            drawn = jax.lax.cond(
                self.jitter > 0,
                lambda: uniform(self.key, Draw.JITTER, number, i, j),
                lambda: jnp.zeros(()),
            )
            late = jnp.floor(drawn * (self.jitter + 1))
            lost = uniform(self.key, Draw.LOSS, number, i, j) < self.loss
            if self.bursty:
                stays = jnp.where(out, 1.0 - self.ends, self.begins)
                chance = jnp.where(step == 0, self.share, stays)
                out = uniform(self.key, Draw.OUTAGE, number, i, j) < chance
            return lost | out, late.astype(jnp.int32), out

        return jax.vmap(one)(out, jnp.asarray(receivers), jnp.asarray(senders))

    def arrivals(self, posts: InFlight, step: jax.Array, newest: Int[jax.Array, " K"]) -> Arrival:
        """Return what arrives at a step, of what is newer than the `newest` (K,) stamps."""
        # The number of the last message in each row, counted back from the last one sent.
        last = (step - 1) // self.every
        rows = jnp.arange(self.slots)
        stamps = ((last - (last - rows) % self.slots) * self.every).astype(jnp.int32)
        # A row that was not written yet has no arrival.
        now = (posts.arrival == step) & (stamps[:, None] > newest[None])
        stamp = jnp.max(jnp.where(now, stamps[:, None], newest[None]), axis=0)
        slot = jnp.argmax(now & (stamps[:, None] == stamp[None]), axis=0)
        return Arrival(slot, stamp, now.any(axis=0))
