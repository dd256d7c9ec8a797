"""The interfaces of a drive, which gives the agents their inputs, and of a stepper, which runs it.

`simulate` knows nothing else of laws, plans or horizons.
"""

import abc
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.agents.network.channel import Channel
from echelon.agents.network.formation import Formation
from echelon.agents.network.graph import Graph
from echelon.agents.part import WorldPart
from echelon.agents.world.sensing import Sensors
from echelon.agents.world.world import World
from echelon.core.errors import SimulationError
from echelon.core.types import Array, Declared, PyTree, Scalar, State
from echelon.core.words import Feedforward, Frame
from echelon.laws.law import Law
from echelon.laws.safety import Safety
from echelon.simulation.step.leadership import Leadership
from echelon.simulation.step.meter import RunStatistics, Sums
from echelon.simulation.step.motion import PlantStep
from echelon.simulation.step.settings import Settings
from echelon.simulation.step.solver_stats import SolverStats

if TYPE_CHECKING:  # a gain is passed on to callers, and never read here
    from echelon.synthesis.gains.gain import Gain

LoopState: TypeAlias = PyTree
"""All that changes during a run, as `records.LoopState`."""


class Problem(NamedTuple):
    """What a stepper needs: agents, their graph and goals, how they move, how they start.

    Attributes:
        model: what laws and solvers know of an agent.
        graph: who receives messages of whom.
        formation: the goal offsets.
        motion: the plant in its world, with the integrator.
        meter: what is measured at each step.
        settings: horizon, step and the like.
        states: (N, n) at the beginning.
        channel: what the network does to messages; None for the ideal network.
        sensors: of the agents' own states.
        leadership: who takes the lead after the leader; None for nobody.
        parts: of the world, which replace members of the loop.
    """

    model: ControlAffine
    graph: Graph
    formation: Formation
    motion: PlantStep
    meter: RunStatistics
    settings: Settings
    states: Array
    channel: Channel | None = None
    sensors: Sensors = Sensors()
    leadership: Leadership | None = None
    parts: Sequence[WorldPart] = ()


class Chunk(NamedTuple):
    """A stretch of a run, or of F formations whose agents follow each other.

    Attributes:
        now: where it ended.
        states: (T, F N, n) of the stored frames, float64.
        inputs: (T, F N, m) delivered from each of them on, float64.
        sums: over its steps, with an axis F in front; F is 1 for a run alone.
        stopped: why no further step can be taken, in words; None where one can.
        inexact: (F,) the formations whose numbers are not those that JAX would compute.
    """

    now: LoopState
    states: Array
    inputs: Array
    sums: Sums
    stopped: str | None = None
    inexact: Array | bool = False


def numbers(now: LoopState) -> tuple[Array, ...]:
    """Return the numbers of a moment, in the order of its tree."""
    leaves = jax.tree.leaves(now)
    return tuple(np.asarray(jax.random.key_data(x) if _is_key(x) else x) for x in leaves)


def _leaf(stored: Array, like: jax.Array) -> jax.Array:
    if _is_key(like):
        return jax.random.wrap_key_data(jnp.asarray(stored), impl=jax.random.key_impl(like))
    return jnp.asarray(stored, like.dtype)


def _is_key(leaf: object) -> bool:
    """Tell whether a law remembers a random key, which is no number to NumPy."""
    return isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


class Stopped(Exception):
    """Raised by a callback or a pilot to end the run; its text is the reason."""


class Stepper(abc.ABC):
    """Moves all agents from step to step."""

    @property
    @abc.abstractmethod
    def longest(self) -> int:
        """The most steps of a chunk, so that one takes well under two seconds."""

    @abc.abstractmethod
    def start(self) -> LoopState:
        """Return the moment at which the run begins."""

    @abc.abstractmethod
    def advance(self, now: LoopState, counts: Array, reference: Array | None) -> Chunk:
        """Store a frame and take counts[k] steps, for each k.

        `reference` (S, n) is what the leaders follow at this step and the next ones, which the
        meter measures them against; None where they follow nothing. A chunk that meets a state
        that is not finite may end early, with that state in its last frame.
        """

    def recall(self, leaves: Sequence[Array]) -> LoopState:
        """Return the moment of its numbers in tree order; `SimulationError` if of another run."""
        # The moment at the start says of what kind and shape each of the numbers is.
        like, tree = jax.tree.flatten(self.start())
        if [np.shape(leaf) for leaf in numbers(like)] != [np.shape(leaf) for leaf in leaves]:
            raise SimulationError("the stored moment has another shape than this run's.")
        return tree.unflatten(map(_leaf, leaves, like))

    @property
    def repeats(self) -> bool:
        """Whether steps can be taken again from a moment, with the same results."""
        return True

    @property
    def work(self) -> SolverStats | None:
        """The work of the solvers so far; None where nothing is solved."""
        return None

    @property
    def devices(self) -> int:
        """How many devices the agents are spread over."""
        return 1

    @property
    def engine(self) -> str:
        """What computes the steps."""
        return "jax"

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is allowed but probably not meant, a sentence each."""
        return ()


class Information(NamedTuple):
    """What leaders and followers must receive from others, in words."""

    leader: tuple[str, ...]
    follower: tuple[str, ...]


class Controller(Declared):
    """What gives the agents their inputs: laws, plans made before, or a receding horizon."""

    @property
    @abc.abstractmethod
    def information(self) -> Information:
        """What the agents must receive from others."""

    @property
    def unknown(self) -> str:
        """The class of a law that echelon does not know; empty without any."""
        return ""

    def information_for(self, model: ControlAffine, graph: Graph) -> Information:
        """Return the same, with what an unknown law uses of what it receives."""
        return self.information

    @abc.abstractmethod
    def stepper(self, problem: Problem) -> Stepper:
        """Return the stepper of agents under a prepared drive, else raise `EchelonError`."""

    def check_motion(self, formation: Formation, graph: Graph) -> tuple[str, ...]:
        """Return warnings of a moving formation; `EchelonError` if the drive cannot follow it."""
        raise SimulationError(
            "a formation that changes with time needs control laws, and plans and receding "
            "horizons have constant offsets; leave out `motion`."
        )

    @property
    def gain(self) -> "Gain | None":
        """The followers' gain; None where they have none."""
        return None

    @property
    def feedforward(self) -> Feedforward:
        """What the followers receive of others' inputs."""
        return Feedforward.NONE

    @property
    def frame(self) -> Frame:
        """The axes of the followers' gain, as chosen by the user."""
        return Frame.WORLD

    @property
    def reacts(self) -> bool:
        """Whether the leaders react to their neighbours."""
        return False

    @property
    def safety(self) -> Safety | None:
        """How followers keep away from each other; None where they do not."""
        return None

    @property
    def lags(self) -> bool:
        """Whether followers lag behind offsets that change with time."""
        return False

    @property
    def trimmed(self) -> bool:
        """Whether the trim input is applied."""
        return True

    def prepare(self, model: ControlAffine, graph: Graph) -> "Controller":
        """Return the drive completed for model and graph; `LawError` if a law does not fit."""
        return self

    def warnings(self, model: ControlAffine, graph: Graph, settings: Settings) -> tuple[str, ...]:
        """Return what is allowed but probably not meant, a sentence each."""
        return ()

    def check_world(self, world: World, graph: Graph, dt: float) -> None:
        """Raise `EchelonError` unless a world suits the drive at a step dt (s)."""
        for part in world.all_parts:
            if part.needs_laws:
                name = part.key or type(part).__name__
                raise SimulationError(
                    f"got `{name}`, but `{type(self).__name__}` optimizes inputs from exact states "
                    f"that arrive at once; use control laws, or remove `{name}`."
                )

    def check_backups(self, graph: Graph) -> None:
        """Raise `EchelonError` unless agents may be lost or join, and backups take the lead."""
        if graph.presence is not None or graph.backups:
            raise SimulationError(
                f"agents are lost or join, or have backup leaders, but `{type(self).__name__}` "
                "optimizes inputs of agents that are all there; use control laws."
            )

    def accept(self, problem: Problem) -> None:
        """Raise `LawError` if an agent starts where its prepared law has no meaning."""

    def check_engine(self, problem: Problem) -> None:
        """Raise `SimulationError`, before compiling, if the requested engine cannot step this."""
        if problem.settings.engine == "native":
            raise SimulationError(
                "`engine` is `native`, and must be `auto` or `jax` where a solver drives agents."
            )

    def start(self, model: ControlAffine) -> State:
        """Return the state (n,) in which leaders begin, the trim unless replaced."""
        # By way of NumPy, so that a trim of whole numbers becomes one of floats.
        return jnp.asarray(np.asarray(model.trim[0], float))

    def reference_states(self, model: ControlAffine, times: jax.Array) -> jax.Array | None:
        """Return the states (T, n) that the leaders follow; None where they follow nothing."""
        return None

    def with_follower(self, law: Law) -> "Controller":
        """Return the drive with another follower law; `SimulationError` if leaders have none."""
        raise SimulationError(
            f"the leaders under `{type(self).__name__}` have no law of their own."
        )

    def metric(self, model: ControlAffine) -> Array | None:
        """Return P (n, n) of the paper's Lyapunov function; None where there is none."""
        return None

    def heading(self, model: ControlAffine, t: Scalar, x: State) -> Scalar | None:
        """Return the heading (rad) of the metric's axes; None for the world's."""
        return None

    def drift(self, model: ControlAffine, x: State, heading: Scalar | None = None) -> State:
        """Return a follower's xdot (n,) without disagreement and feed-forward, at a heading."""
        return model.normalized_drift(x)
