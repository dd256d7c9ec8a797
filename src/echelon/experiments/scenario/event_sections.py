"""The sections of a scenario file on what happens during a run: events, heirs, live changes."""

from typing import Annotated, final

from pydantic import BaseModel, Field

from echelon.experiments.scenario.sections import Share
from echelon.experiments.scenario.values import (
    STRICT,
    Agent,
    Agents,
    NotNegative,
    Numbers,
    Positive,
    Unit,
    either,
)

_Link = Annotated[Annotated[tuple[Agent, Agent], Field(strict=False)] | None, Unit("agents")]


@final
class EventSpec(BaseModel, **either("lose", "cut", "join")):
    """What happens to the formation at a time; no law and no gain is made for it."""

    at: Annotated[Positive, Unit("s")]
    """Time, s; below the horizon."""
    lose: Agent | None = None
    """The number of an agent that is lost: it falls silent, and its body is gone."""
    cut: _Link = None
    """The two agents of a link that carries nothing, either way."""
    duration: Annotated[Positive | None, Unit("s"), Field(alias="for")] = None
    """Time after which a cut link is restored, s; by default never."""
    join: Agent | None = None
    """The number of an agent that joins, in its initial state; before, or since it was lost, it is
    absent."""


@final
class LeadershipSpec(BaseModel, **STRICT):
    """Who takes the lead when nobody hears of the leader any more."""

    heirs: Agents
    """Numbers of followers, in the order in which they take over."""
    timeout: Annotated[Positive, Unit("s")] = 0.3
    """Time without news of a leader after which the first heir takes the lead, s; the second does
    after twice that, and so on."""


@final
class LiveSpec(BaseModel, **STRICT):
    """A change made during `echelon live`, which repeats it; `echelon run` rejects it."""

    at: Annotated[NotNegative, Unit("s")]
    """Time of the change, s."""
    law: str | None = None
    """The followers' law from then on; its memory starts anew."""
    coupling: Annotated[Positive | None, Unit("1")] = None
    """The coupling from then on."""
    weight: Annotated[Positive | None, Unit("1")] = None
    """Weight of the inputs in the Riccati equation of the gain, relative to the scenario's."""
    feedforward: Annotated[Annotated[float, Field(ge=0.0, le=1.0)] | None, Unit("1")] = None
    """Share of the feed-forward of `follower.feedforward` that followers receive: 1 all, 0
    nothing."""
    method: str | None = None
    """The method of the followers' gain, with the coupling that it chooses; `scenario` for the
    scenario's."""
    shape: str | None = None
    """Shape of the formation, by a name of `formation`; `scenario` for the scenario's."""
    reshape: str | None = None
    """Shape to which the formation changes within 3 s, by a name of `formation`; `scenario` for the
    scenario's."""
    size: Annotated[Positive | None, Unit("1")] = None
    """Size of the formation, relative to that of `formation`."""
    turn: Annotated[float | None, Unit("deg")] = None
    """Rotation of the formation about its first leader, degrees."""
    wind: Annotated[float | None, Unit("the states', per s")] = None
    """Wind on the first velocity, or on the first position, added to `disturbance`."""
    delay: Annotated[NotNegative | None, Unit("s")] = None
    """Delay of the messages of `network`, s."""
    loss: Annotated[Share | None, Unit("1")] = None
    """Share of these messages that is lost."""
    outages: Annotated[Share | None, Unit("1")] = None
    """Share of the time that each link of `network` is out."""
    noise: Annotated[NotNegative | None, Unit("1")] = None
    """Size of the noise, relative to that of `sensing`."""
    lose: int | None = None
    """The number of an agent that is lost: it falls silent, and its body is gone."""
    cut: Annotated[Annotated[tuple[int, int], Field(strict=False)] | None, Unit("agents")] = None
    """The two agents of an edge that is removed."""
    restore: Annotated[Annotated[tuple[int, int], Field(strict=False)] | None, Unit("agents")] = (
        None
    )
    """The two agents of an edge that is restored."""
    join: int | None = None
    """The number of a lost agent that joins again, in its initial state."""
    kick: Annotated[dict[int, Numbers] | None, Unit("the states'")] = None
    """By agent: jump of its states, in the states' units."""
