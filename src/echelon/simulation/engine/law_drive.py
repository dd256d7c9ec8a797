"""The drive by control laws: inputs are functions of what each agent knows."""

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, TypeVar, final

import jax

from echelon.agents.models.model import ControlAffine
from echelon.agents.network.formation import Formation
from echelon.agents.network.graph import Graph
from echelon.agents.network.matrices import lost_at_times
from echelon.agents.world.world import World
from echelon.core.errors import (
    EchelonError,
    LawError,
    MissingExtraError,
    SimulationError,
    check_kind,
)
from echelon.core.identity import process_key
from echelon.core.numerics import precision
from echelon.core.types import Array, Scalar, State
from echelon.core.words import Feedforward, Frame
from echelon.laws.flat_law import FlatLaw
from echelon.laws.flat_loop import FlatMemory
from echelon.laws.integral_check import check_sums
from echelon.laws.law import Checks, Faces, Law, Proves, Speaks, Travels, gain_of
from echelon.laws.law_check import (
    check_signals,
    information_of,
    leader_warnings,
    prepare_law,
    unknown_class,
)
from echelon.laws.safety import Safety
from echelon.laws.safety_check import check_numbers, hulls_at, separations, too_near
from echelon.simulation.engine.jax_stepper import JaxStepper
from echelon.simulation.native import is_installed
from echelon.simulation.native.agent_step import memories_of
from echelon.simulation.native.stepper import NativeStepper
from echelon.simulation.scalars import Unsupported
from echelon.simulation.step.assembly import assemble
from echelon.simulation.step.drive import Controller, Information, Problem, Stepper
from echelon.simulation.step.settings import Settings

if TYPE_CHECKING:  # a gain is passed on to callers, and never read here
    from echelon.synthesis.gains.gain import Gain


@final
class Laws(Controller):
    """One law for the leaders, and one for all others.

    Args:
        leader: law of the leaders.
        follower: law of all others.
    """

    leader: Law
    follower: Law

    def __check_init__(self) -> None:
        for place in ("leader", "follower"):
            check_kind(place, getattr(self, place), Law)

    @property
    def information(self) -> Information:
        """What the two laws must receive from others."""
        return Information(self.leader.information, self.follower.information)

    def information_for(self, model: ControlAffine, graph: Graph) -> Information:
        """Return the same, with what an unknown law uses of what it receives."""
        laws = self.leader, self.follower
        return Information(*(information_of(law, model, graph) for law in laws))

    @property
    def unknown(self) -> str:
        """The class of a law that echelon does not know; empty without any."""
        return unknown_class(self.leader) or unknown_class(self.follower)

    @property
    def gain(self) -> "Gain | None":
        """The gain of the followers' law, where it has one."""
        return gain_of(self.follower)

    @property
    def feedforward(self) -> Feedforward:
        """What the followers' law needs of others' inputs."""
        return self.follower.feedforward

    @property
    def frame(self) -> Frame:
        """The axes of the followers' gain, as chosen by the user."""
        # A law without the choice has a gain that turns with the heading where it can.
        return getattr(self.follower, "frame", Frame.HEADING)

    @property
    def reacts(self) -> bool:
        """Whether the leaders' law has a reaction."""
        # By name, since a user's own law need not have one.
        return getattr(self.leader, "reaction", None) is not None

    @property
    def safety(self) -> Safety | None:
        """How the followers' law keeps them away from each other."""
        return self.follower.safety

    @property
    def trimmed(self) -> bool:
        """Whether the followers' law applies the trim input."""
        return getattr(self.follower, "trim", True)

    def prepare(self, model: ControlAffine, graph: Graph) -> "Laws":
        """Return both laws completed; the same object if they already are.

        Raises:
            LawError: one does not fit the model or the graph.
        """
        leader, follower = (prepare_law(law, model, graph) for law in (self.leader, self.follower))
        follower = Checks.of(follower).following(leader, model)
        check_sums(leader, follower, model)
        with precision("float64"):
            check_signals(leader, follower, model)
        drive = Laws(leader, follower)
        same, key = leader is self.leader and follower is self.follower, process_key(drive)
        # Caches use the identity of what is complete already.
        return self if same or key is not None and key == process_key(self) else drive

    def check_world(self, world: World, graph: Graph, dt: float) -> None:
        """Check that both laws work with all parts of a world.

        Raises:
            EchelonError: a part does not suit them, such as a network of late messages.
        """
        for part in world.all_parts:
            part.check_laws(self, graph, dt)

    def check_late(self, graph: Graph, dt: float) -> None:
        """Raise `LawError` if a step dt (s) is too long for late messages."""
        Checks.of(self.follower).check_late(graph, dt)

    @property
    def plans(self) -> bool:
        """Whether leaders have a plan."""
        return Travels.of(self.leader).plans

    @property
    def speak_alike(self) -> bool:
        """Whether leaders and followers both say a signal, or both a state."""
        return Speaks.may(self.leader, "signal") is Speaks.may(self.follower, "signal")

    @property
    def lags(self) -> bool:
        """Whether followers lag behind offsets that change with time."""
        return not Speaks.may(self.follower, "goal_offset")

    def check_motion(self, formation: Formation, graph: Graph) -> tuple[str, ...]:
        """Return that a law of states lags behind, and which reshapes lead agents together.

        Raises:
            LawError: with `safety`, the leader's offset changes.
        """
        motion = formation.motion
        assert motion is not None
        if self.safety is not None and motion.moves([*graph.leaders, *graph.backups]):
            raise LawError(
                "`safety` keeps agents apart that move relative to the leader, whose own offset "
                "must be constant; leave out its new offset."
            )
        # What an unknown law does with an offset is not known.
        if not self.lags or self.unknown:
            return ()
        return (
            f"the law `{type(self.follower).__name__}` uses the position and the velocity of "
            "offsets that change with time, and lags behind them; `stopping-point` does not.",
        )

    def check_backups(self, graph: Graph) -> None:
        """Check that followers can take the lead, and leaders can follow.

        Raises:
            SimulationError: they cannot.
        """
        if not graph.backups:
            return
        name = f"`{type(self.leader).__name__}`"
        if not self.plans:
            raise SimulationError(
                f"got `backups`, but a leader under the law {name} has no plan that they could "
                "carry on; give it a `reference`."
            )
        if self.follower.feedforward is Feedforward.PARENT:
            raise SimulationError(
                "got `backups`, but with `feedforward: parent` nobody knows who leads; use `relay`."
            )
        observers = {getattr(law, "observer", None) for law in (self.leader, self.follower)}
        first, then = self.leader.init(), self.follower.init()
        # How many others hold it back a backup leader forgets when it leads.
        then = then._replace(active=None) if isinstance(then, FlatMemory) else then
        trees = {*map(jax.tree.structure, (first, then))}
        if len(trees) > 1 or len(observers) > 1:
            raise SimulationError(
                f"got `backups`, but followers under `{type(self.follower).__name__}` remember "
                f"other things than a leader under {name}, and could not take over; give both "
                "the same kind of law, with the same `observer`."
            )

    def accept(self, problem: Problem) -> None:
        """Check the starts of leaders and followers by their laws.

        Raises:
            LawError: one is refused.
        """
        if isinstance(self.follower, FlatLaw) and self.safety is not None:
            motion, dt = problem.formation.motion, problem.settings.dt
            least = 1.0 if motion is None else motion.least_scale
            for shape in problem.formation.shapes:
                rows = problem.graph, least * shape.offsets, dt
                check_numbers(self.follower, problem.model, *rows)
        refused = self.refusals(problem.model, problem.graph, problem.states[None])
        for _, agent, text in refused:
            raise LawError(f"agent {agent} starts where its law has no meaning: {text}.")

    def refusals(
        self, model: ControlAffine, graph: Graph, states: Array
    ) -> Iterator[tuple[int, int, str]]:
        """Yield the starts (K, N, n) that a law cannot take: their numbers, the agent, and why."""
        for law, agents in ((self.leader, graph.leaders), (self.follower, graph.followers)):
            starts = states[:, list(agents)].reshape(-1, states.shape[2])
            for place, text in Checks.of(law).refusals(model, starts):
                yield place // len(agents), agents[place % len(agents)], text
        if isinstance(self.follower, FlatLaw) and self.safety is not None:
            for place, start in enumerate(states):
                hulls = hulls_at(self.follower, model, self.leader, graph, start)
                apart = separations(hulls * self.safety.scales(model))
                near = too_near(self.safety, apart)
                if near is not None:
                    yield place, near.agent, f"it is too near to {near.text}"

    def check_engine(self, problem: Problem) -> None:
        """Check that native code, if it is requested, can step what the agents know and do.

        Raises:
            SimulationError: it cannot.
        """
        if problem.settings.engine == "native":
            loop = assemble(problem, self.leader, self.follower)
            choose_engine(problem.settings, 0, lambda: memories_of(loop), lambda _: None)

    def warnings(self, model: ControlAffine, graph: Graph, settings: Settings) -> tuple[str, ...]:
        """Return the warnings of both laws, and of what they cannot follow or do not hear."""
        laws = map(Checks.of, (self.leader, self.follower))
        warnings = sum((law.warnings(model, graph) for law in laws), start=())
        lost = lost_at_times(graph) if graph.events and self.lags else ""
        if lost and self.unknown:
            warnings += (f"{lost}, and receives nothing then.",)
        elif lost:
            warnings += (
                f"{lost}, in which the law `{type(self.follower).__name__}` does not correct their "
                "errors, so that the run may diverge; add links, or use `stopping-point`.",
            )
        return warnings + leader_warnings(self.leader, model, settings.horizon, settings.limits)

    def start(self, model: ControlAffine) -> State:
        """Return the start state of the leaders' law."""
        return Travels.of(self.leader).start(model)

    def reference_states(self, model: ControlAffine, times: jax.Array) -> jax.Array | None:
        """Return the reference states of the leaders' law."""
        return Travels.of(self.leader).reference_states(model, times)

    def with_follower(self, law: Law) -> "Laws":
        """Return the same law for the leaders, and another one for all others."""
        return Laws(self.leader, law)

    def metric(self, model: ControlAffine) -> Array | None:
        """Return the metric of the followers' law."""
        return Proves.of(self.follower).metric(model)

    def heading(self, model: ControlAffine, t: Scalar, x: State) -> Scalar | None:
        """Return the heading that a leader at x sends."""
        return Faces.of(self.leader).heading(model, t, x) if self.follower.turning else None

    def drift(self, model: ControlAffine, x: State, heading: Scalar | None = None) -> State:
        """Return the drift under the followers' law."""
        law = self.follower if heading is None else Faces.of(self.follower).facing(heading)
        return Proves.of(law).drift(model, x)

    def stepper(self, problem: Problem) -> Stepper:
        """Return the stepper of the closed loop, by JAX or by native code.

        Raises:
            SimulationError: native code is requested, and there is none.
        """
        loop, settings = assemble(problem, self.leader, self.follower), problem.settings
        states, devices = problem.states, settings.devices

        def native() -> Stepper:
            bits = int(settings.precision[5:])
            return NativeStepper([loop], states, bits, JaxStepper(loop, states))

        return choose_engine(
            settings, len(states), native, lambda why: JaxStepper(loop, states, why, devices)
        )


_WORTH = 100_000
"""Agent steps above which native code saves more than its compilation takes, one second."""
_R = TypeVar("_R")


def choose_engine(
    settings: Settings,
    agents: int,
    native: Callable[[], _R],
    by_jax: Callable[[str], _R],
) -> _R:
    """Return the result of one of the two engines for so many agents.

    Args:
        settings: of the run.
        agents: how many.
        native: computes it by native code.
        by_jax: computes it by JAX; takes why there is no native code, empty where none is needed.

    Raises:
        SimulationError: native code is requested, and there is none.
    """
    if not worth_native(settings, agents):
        return by_jax("")
    try:
        return native()
    except (Unsupported, MissingExtraError) as error:
        if settings.engine == "native":
            raise SimulationError(f"`engine` is `native`, and {_in_words(error)}.") from error
        return by_jax(_in_words(error))


def worth_native(settings: Settings, agents: int) -> bool:
    """Tell whether native code is requested, or saves time; it computes on processors alone."""
    if settings.engine != "auto":
        return settings.engine == "native"
    if settings.devices > 1 or not is_long(settings, agents):
        return False
    return is_installed() and jax.default_backend() == "cpu"


def is_long(settings: Settings, agents: int) -> bool:
    """Tell whether a run is long enough for more compilation than that of its JAX steps."""
    return settings.engine == "native" or settings.steps * agents >= _WORTH


def _in_words(error: EchelonError) -> str:
    if isinstance(error, Unsupported):
        return f"there is no native code for {error}"
    return str(error).rstrip(".")
