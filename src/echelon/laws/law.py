"""The interface of a control law, and all that an agent may know when it runs one."""

import abc
from collections.abc import Iterator
from typing import Any, ClassVar, NamedTuple, Self, TypeAlias, cast, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Float

from echelon.agents.models.heading_symmetry import heading_index, rest_heading
from echelon.agents.models.model import ControlAffine
from echelon.agents.network.exchange import Near
from echelon.agents.network.formation_motion import OwnOffset
from echelon.agents.network.graph import Graph
from echelon.agents.references.reference import LeaderPath
from echelon.core.errors import LawError
from echelon.core.types import Array, Declared, Input, PyTree, Scalar, State
from echelon.core.words import Feedforward
from echelon.laws.safety import Safety
from echelon.synthesis.gains.gain import Gain
from echelon.synthesis.gains.integral import Integral

Memory: TypeAlias = PyTree


@final
class LocalView(eqx.Module):
    """What one agent knows at one time.

    Attributes:
        t: time, s.
        x: own state (n,).
        offset: own goal offset xi (n,).
        disagreement: z = e + d (n,), from the neighbours' messages; of signals where the law has
            some.
        feedforward: what the agent's leader or parent sent, or zeros (m,): a normalized input (m,)
            unless the law's `message` says otherwise.
        period: how long the input will be held, s; 0 where it is not known.
        near: the others, where the law keeps away from them; None elsewhere.
        offset_rate: of `offset` (n,), per s; None of a constant one, or if the law uses none.

    Raises:
        LawError: it is made of numbers while JAX computes in float32.
    """

    t: Scalar
    x: State
    offset: State
    disagreement: Float[jax.Array, " s"]
    feedforward: Float[jax.Array, " k"]
    period: Scalar | float = 0.0
    near: Near | None = None
    offset_rate: State | None = None

    def __check_init__(self) -> None:
        """Refuse to lose digits silently."""
        # `simulate` and the like choose a precision; a caller of a law by hand has chosen none.
        traced = any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(self))
        if not traced and jnp.result_type(float) != np.float64:
            raise LawError(
                "a `LocalView` is made where JAX computes in float32, and a law would return 7 "
                "digits; make it, and call the law, inside `with jax.enable_x64(True):`."
            )


class Expected(NamedTuple):
    """Where a leader is expected, and what it will send.

    Attributes:
        signal: its signal (s,), or its state less its offset (n,).
        feedforward: what it sends to followers (k,); None for what its law does at that state.
    """

    signal: Float[jax.Array, " s"]
    feedforward: Float[jax.Array, " k"] | None = None


class Law(Declared):
    """A control law: a pure function of what one agent knows.

    It is the same for one agent in its own process and for a million in a batch. What else a law
    may do are the abilities below: it has those whose methods it defines.

    Attributes:
        feedforward: which feed-forward the law needs, none unless replaced by a field, an
            attribute or a property.
        leaderward: whether followers use messages of neighbours nearer to a leader alone.
        prover: the `Guarantee` of followers under the law, as `module:class`.
        turning: whether followers receive the heading that their leader follows.
        unlike: whether agents under it may have different models.
        safety: how followers keep away from each other; None where they do not.
    """

    feedforward = Feedforward.NONE
    leaderward = False
    turning = False
    unlike = False
    # Without an annotation, which would make it a field of every law.
    safety = cast("Safety | None", None)
    prover: ClassVar[str] = "echelon.guarantees.promises.metric_promise:MetricPromise"

    def __init_subclass__(cls, **options: object) -> None:
        """Read a `feedforward` that the class gives by its name, such as `relay`."""
        super().__init_subclass__(**options)
        if isinstance(vars(cls).get("feedforward"), str):
            what = f"`feedforward` of `{cls.__name__}`"
            cls.feedforward = Feedforward.checked(vars(cls)["feedforward"], what)

    @property
    def information(self) -> tuple[str, ...]:
        """What the law must receive from others, in words."""
        return ()

    def prepared(self, model: ControlAffine, graph: Graph) -> "Law":
        """Return the law completed with what depends on the model and the graph.

        Unless replaced, it returns the law itself.

        Raises:
            LawError: the law does not fit the model.
        """
        return self

    def init(self) -> Memory:
        """Return one agent's memory before the first step; none unless replaced."""
        return None

    def begin(self, model: ControlAffine, x: State) -> Memory:
        """Return the memory of an agent that begins at x, in the form of `init`."""
        return self.init()

    def settle(
        self,
        model: ControlAffine,
        view: LocalView,
        desired: Input,
        delivered: Input,
        memory: Memory,
    ) -> Memory:
        """Return the memory after a step, given the desired and the delivered input (m,)."""
        return memory

    @abc.abstractmethod
    def update(self, model: ControlAffine, view: LocalView, memory: Memory) -> tuple[Input, Memory]:
        """Return one agent's physical input (m,), before actuator limits, and its next memory."""


# ---- what a law may do beside it -----------------------------------------------------------------


class Ability:
    """Something that a law may do beside `update`; this class is of a law that does not.

    A law has it that defines one of its methods, whether it inherits from it or not.
    """

    @classmethod
    def of(cls, law: object) -> Self:
        """Return what a law does of this: with the methods that it defines, and the ideal ones."""
        if isinstance(law, cls):
            return law
        able = cls()
        for name in vars(cls):
            if hasattr(type(law), name) and not name.startswith("_"):
                setattr(able, name, getattr(law, name))
        able.__dict__["_law"] = law
        return able

    @classmethod
    def may(cls, law: object, name: str) -> bool:
        """Tell whether a law defines the method of a name."""
        own = getattr(cls, name)
        return getattr(type(law), name, own) is not own

    @property
    def itself(self) -> Any:
        """The law."""
        return vars(self).get("_law", self)


class Speaks(Ability):
    """What a law says to neighbours: its states less their offsets, unless it has a `signal`."""

    def signal(
        self, model: ControlAffine, x: State, offset: State, memory: Memory
    ) -> Float[jax.Array, " s"] | None:
        """Return what an agent sends to its neighbours, for z; None for x - offset."""
        return None

    def signal_names(self, model: ControlAffine) -> tuple[str, ...]:
        """Return the names of what an agent sends for z, by which unlike agents use it."""
        return model.state_names

    def goal_offset(
        self, model: ControlAffine, own: OwnOffset, t: Scalar
    ) -> tuple[State, State | None]:
        """Return what the law takes for an offset (n,) that moves, and its rate (n,) or None.

        Unless replaced, it is the position, and the velocity where that is a state: agents lag.
        """
        return own.state(t), None

    def carried(
        self,
        model: ControlAffine,
        signal: Float[jax.Array, " s"],
        feedforward: Float[jax.Array, " k"],
        u: Input,
        time: Scalar,
    ) -> Float[jax.Array, " s"]:
        """Return the signal of a leader a time (s) after its last message, by a follower's law.

        Unless replaced, it stays. A state in place of a signal moves on by the model.

        Args:
            model: the agent.
            signal: (s,) then.
            feedforward: (k,) that the leader sent.
            u: the input (m,) that its actuators delivered.
            time: how long it moves on.
        """
        return signal


class Feeds(Ability):
    """What an agent sends to its followers in the same step: its input, unless a law says more."""

    def message(
        self, model: ControlAffine, x: State, v: Input, memory: Memory
    ) -> Float[jax.Array, " k"]:
        """Return what an agent sends to followers under this law, with its memory after a step.

        Unless replaced, it is `broadcast` of the state and the input alone.
        """
        return self.broadcast(model, x, v)

    def broadcast(self, model: ControlAffine, x: State, v: Input) -> Float[jax.Array, " k"]:
        """Return what an agent at x with normalized input v sends to followers under this law.

        Unless replaced, it is the input: a law with an inner loop of its own needs what is applied
        beyond that loop.
        """
        return v

    def message_names(self, model: ControlAffine) -> tuple[str, ...]:
        """Return the names of what `message` sends, likewise."""
        return model.input_names


class Travels(Ability):
    """What a law knows of its own way: nothing, unless it follows a reference or has a plan."""

    def start(self, model: ControlAffine) -> State:
        """Return the state (n,) in which a leader under this law begins, the trim by default."""
        return jnp.asarray(np.asarray(model.trim[0], float))

    def reference_states(self, model: ControlAffine, times: jax.Array) -> jax.Array | None:
        """Return the states (T, n) that the law follows, or None where it follows nothing."""
        return None

    def own_mode(self, model: ControlAffine) -> float | None:
        """Return the slowest mode (1/s) of a leader about what it follows; None if not known."""
        return None

    plans: bool = False
    """Whether a leader under the law has a plan, so that others can predict it."""

    def predictable(self, model: ControlAffine) -> "Law":
        """Return a prepared leader's law, completed with what others need to predict it."""
        return self.itself

    def deviation(
        self, model: ControlAffine, t: Scalar, x: State, offset: State, memory: Memory
    ) -> Float[jax.Array, " s"] | None:
        """Return a leader's deviation (s,) from its plan, which it sends; None without a plan."""
        return None

    def expected(
        self,
        model: ControlAffine,
        t: Scalar,
        deviation: Float[jax.Array, " s"],
        age: Scalar,
        period: Scalar | float,
    ) -> Expected | None:
        """Return where a leader is expected at a time t (s); None without a plan.

        Args:
            model: the agent.
            t: the time.
            deviation: (s,) from its plan, `age` earlier.
            age: s.
            period: how long its inputs are held, s.
        """
        return None


class KeepsApart(Ability):
    """Where an agent may be before it rests, for others' safety: not known."""

    def hull(
        self, model: ControlAffine, x: State, memory: Memory
    ) -> Float[jax.Array, "r d"] | None:
        """Return points in whose hull the agent's position stays, for others' safety, or None."""
        return None

    def expected_hull(
        self, model: ControlAffine, t: Scalar, signal: Float[jax.Array, " s"]
    ) -> Float[jax.Array, "r d"] | None:
        """Return `hull` of a leader that is expected at a signal at a time (s), or None."""
        return None

    def active(self, memory: Memory) -> jax.Array | None:
        """Return how many others changed what agents with memories (K, ..) do, or None."""
        return None


class Faces(Ability):
    """In the axes of which heading a law works."""

    def facing(self, heading: Scalar) -> "Law":
        """Return a follower's law in the axes of a heading (rad), which it receives every step.

        Called if `turning`.
        """
        return self.itself

    def heading(self, model: ControlAffine, t: Scalar, x: State) -> Scalar:
        """Return the heading that a leader at x follows, relative to the trim's, rad.

        Without a reference it is the leader's own. Called if the model has a heading.
        """
        reference = reference_of(self.itself)
        heading = x[heading_index(model)] if reference is None else reference.heading(model, t)
        return heading - rest_heading(model)

    def keeps_heading(self, model: ControlAffine) -> bool:
        """Tell whether `heading` is known to be 0 at all times."""
        reference = reference_of(self.itself)
        return reference is not None and not reference.turns(model)


class Proves(Ability):
    """What the theory knows of a law: that it drifts without feedback."""

    def metric(self, model: ControlAffine) -> Array | None:
        """Return P (n, n) of the paper's Lyapunov function for this law; None if it has none."""
        return None

    def drift(self, model: ControlAffine, x: State) -> State:
        """Return xdot (n,) when the disagreement and the feed-forward are zero."""
        # The trim input is no feedback: about the trim the drift f + g u* remains.
        return model.normalized_drift(x)

    def strength(self, period: Scalar | float) -> Scalar | float | None:
        """Return the coupling c where inputs are held for a period (s); None if it has none."""
        return None


class Checks(Ability):
    """What a law asks of its leader, its network and its starts: nothing."""

    def following(self, leader: "Law", model: ControlAffine) -> "Law":
        """Return a follower's prepared law, completed with what it needs of its leader's.

        Raises:
            LawError: it cannot follow a leader under that law.
        """
        return self.itself

    def check_late(self, graph: Graph, period: float) -> None:
        """Check that a follower's law works with late messages, with inputs held for a period (s).

        Raises:
            LawError: it does not.
        """

    def refusals(self, model: ControlAffine, states: Array) -> Iterator[tuple[int, str]]:
        """Yield the rows of starts (K, n) that the law cannot take, and why in words."""
        yield from ()

    def warnings(self, model: ControlAffine, graph: Graph) -> tuple[str, ...]:
        """Return what is allowed but probably not meant, a sentence each."""
        return ()


def check_gain_fits(
    law: Law, model: ControlAffine, P_shape: tuple[int, ...], R_shape: tuple[int, ...]
) -> None:
    """Check that a gain fits a model of this size.

    Raises:
        LawError: it does not.
    """
    n, m = len(model.state_names), len(model.input_names)
    if P_shape != (n, n) or R_shape != (m, m):
        raise LawError(
            f"the gain of `{type(law).__name__}` has P {P_shape} and R {R_shape}, "
            f"and `{type(model).__name__}` needs P {(n, n)} and R {(m, m)}."
        )


def gain_of(law: Law) -> Gain | None:
    """Return the gain of a law, of a prepared leader the one in use; None where it has none."""
    # With sums a law does more than its gain, and no statement about the gain is about it.
    if isinstance(getattr(law, "integral", None), Integral):
        return None
    # By name, since a user's own law need not have one.
    named = (getattr(law, name, None) for name in ("regulator", "gain"))
    return next((gain for gain in named if isinstance(gain, Gain)), None)


def reference_of(law: object) -> LeaderPath | None:
    """Return the `reference` of a law; None where it has none."""
    reference = getattr(law, "reference", None)
    return reference if isinstance(reference, LeaderPath) else None


def without_certificates(law: Law) -> Law:
    """Return a law whose gains have no certificate and a traced coupling.

    So another coupling, or another graph of the same size, compiles nothing again.
    """

    def strip(node: object) -> object:
        if not isinstance(node, Gain):
            return node
        # `filter_jit` takes floats for constants: every other graph would be compiled anew.
        parts = (np.asarray(node.coupling), None)
        return eqx.tree_at(lambda gain: (gain.coupling, gain.certificate), node, parts)

    # A user's own law may have a gain anywhere, under any name.
    return jax.tree.map(strip, law, is_leaf=lambda node: isinstance(node, Gain))


# ---- the law that does nothing -------------------------------------------------------------------


class TrimInput(Law):
    """u = u* + S v_ff, where v_ff = 0 since the law uses no feed-forward.

    The agent moves freely about its trim.
    """

    def update(self, model: ControlAffine, view: LocalView, memory: Memory) -> tuple[Input, Memory]:
        """Return the trim input."""
        return model.physical(view.feedforward), memory
