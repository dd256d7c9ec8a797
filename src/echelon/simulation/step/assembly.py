"""The loop of a run: which member of each component its parts ask for."""

from echelon.core.words import Feedforward
from echelon.laws.law import Law, Travels
from echelon.laws.law_check import signal_size
from echelon.simulation.step.drive import Problem
from echelon.simulation.step.leadership import FixedLeaders, leaders_of
from echelon.simulation.step.loop import IdealNetwork, Loop, NobodyNear, Turns
from echelon.simulation.step.nearby import ExactHulls, LateHulls
from echelon.simulation.step.networks import (
    IdealWithBackups,
    LateNetwork,
    MessageRules,
)
from echelon.simulation.step.own_members import with_own_members
from echelon.simulation.step.places import FixedPlaces
from echelon.simulation.step.roster import Links, roster_of
from echelon.simulation.step.run_laws import RunLaws, has_angles
from echelon.simulation.step.turns import (
    Announced,
    BackupsToo,
    ByDepth,
    LeadersFirst,
    Relay,
    SameStep,
)


def assemble(problem: Problem, leader: Law, follower: Law) -> Loop:
    """Return the loop of prepared laws."""
    graph, settings, channel = problem.graph, problem.settings, problem.channel
    leader = leader if channel is None else Travels.of(leader).predictable(problem.model)
    leadership = leaders_of(graph, problem.leadership)
    signals = signal_size(follower, problem.model) is not None
    laws = RunLaws.of(graph, leader, follower, leadership.changes, signals)
    loop = Loop(
        model=problem.model,
        laws=laws,
        sensing=problem.sensors,
        places=FixedPlaces.of(problem.formation),
        graph=Links.of(graph, settings, follower.leaderward),
        network=_network(problem, leadership),
        surroundings=_surroundings(problem, follower),
        turns=_turns(problem, laws),
        motion=problem.motion,
        roster=roster_of(graph, settings, has_angles(follower)),
        meter=problem.meter,
    )
    return with_own_members(loop, problem)


def _network(problem: Problem, leadership: FixedLeaders) -> IdealNetwork:
    channel = problem.channel
    if channel is not None:
        rules = MessageRules.of(channel, leadership, problem.graph.agents)
        return LateNetwork(leadership, rules, channel)
    return IdealWithBackups(leadership) if leadership.changes else IdealNetwork(leadership)


def _surroundings(problem: Problem, follower: Law) -> NobodyNear:
    if follower.safety is None:
        return NobodyNear()
    return ExactHulls() if problem.channel is None else LateHulls(problem.channel)


def _turns(problem: Problem, laws: RunLaws) -> Turns:
    if laws.backups:
        return BackupsToo(Announced() if problem.channel is None else Relay())
    if problem.channel is not None:
        return LeadersFirst(Relay())
    if laws.follower.feedforward is Feedforward.PARENT:
        return LeadersFirst(ByDepth.of(problem.graph))
    # The place of each follower's leader among the leaders, whose numbers ascend.
    nearest = problem.meter.nearest[laws.followers]
    return LeadersFirst(SameStep(laws.leaders.searchsorted(nearest)))
