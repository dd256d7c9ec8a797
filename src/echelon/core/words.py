"""Enumerations of the words that tables and files contain, with their meanings.

Nothing here needs JAX, so scenarios can be checked without it. Code compares members, never names.
"""

import enum
from typing import Self

from echelon.core.errors import SimulationError, check_name


def amount(count: int, noun: str, nouns: str = "") -> str:
    """Return a count with its noun, such as `1 agent`; `nouns` is an irregular plural."""
    return f"{count} {noun if count == 1 else nouns or noun + 's'}"


class Word(enum.Enum):
    """A word with a meaning: its name stands in tables and files, its value is the meaning."""

    def __str__(self) -> str:
        return self.name.lower().replace("_", "-")

    @classmethod
    def named(cls, name: object) -> Self:
        """Return the member of a name, or a member itself; `KeyError` if there is none."""
        if isinstance(name, cls):
            return name
        return {str(member): member for member in cls}[str(name)]

    @classmethod
    def checked(cls, name: object, what: str) -> Self:
        """Return `named`; raise `SimulationError` about `what`, such as "`a` of the b"."""
        check_name(f"{what} is", str(name), map(str, cls), SimulationError)
        return cls.named(name)


class Feedforward(Word):
    """What a follower is sent of others' inputs of the same step, after their limits."""

    NONE = "nothing of others' inputs"
    RELAY = "the leader's input of the same step"
    RELAY_VELOCITY = "the velocity that the leader's input of the same step makes"
    PARENT = "its parent's input of the same step"


class Frame(Word):
    """The axes in which a follower's gain stands."""

    WORLD = "axes that stand still"
    HEADING = "axes that turn with the heading that the leader follows, which is forwarded"


class NeighbourChoice(Word):
    """Which of its neighbours' messages an agent uses."""

    ALL = "all of its neighbours"
    LEADERWARD = "the neighbours that are nearer to a leader"


class MessageContent(Word):
    """What a message on a network contains."""

    DEVIATION = "the sender's deviation from where it expects the leader"
    STATE = "the sender's signal itself"


class Prediction(Word):
    """How agents predict the leader from what it last sent."""

    PREVIEW = "by its plan, which they know"
    PACKET = "by the motion that it was in when it sent it"


class Estimation(Word):
    """What agents make of what they measure of themselves."""

    NONE = "they use it as it is"
    CONSTANT_GAIN = "a prediction by the model, corrected by a constant gain"


ENGINES = ("auto", "jax", "native")
"""What may step agents under laws."""

DEFAULT_FEEDFORWARD = Feedforward.RELAY
"""Of the law `consensus`, in scenarios and in Python: without it followers lag behind a leader that
moves, which is seldom what is meant; the paper's own network is `none`."""


class Kind(Word):
    """The kind of an argument, the strongest first."""

    PROOF = "Proved in exact arithmetic, in continuous time"
    VERTICES = "By eigenvalues at the corners of a hull of all Jacobians, in continuous time"
    SAMPLES = "Seen at samples, which is no proof"
    LINEARIZATION = "By linearization at the trim"

    @property
    def strength(self) -> int:
        """How strong the argument is: 3 for a proof, 0 for linearization."""
        return len(Kind) - 1 - list(Kind).index(self)


class Theorem(Word):
    """A theorem of the theory page, and what it says of errors."""

    T1 = "errors of all sizes shrink while all agents stay in"
    T2 = "small errors shrink while the leader stays in"
    A5 = "the drift does not expand P while all agents stay in"
    T5 = "stopping points agree from anywhere, and each agent stays in its tube"
    T9 = "the same over a network that delays and loses messages"
    T10 = "agents never touch, and each stays in its tube"

    def __str__(self) -> str:
        return self.name


class GuaranteeVerdict(Word):
    """Whether what is claimed of a run is guaranteed."""

    GUARANTEED = "all conditions hold by computation"
    CONDITIONAL = "a condition is left that only the run can show"
    NONE = "nothing is claimed"


class Verdict(Word):
    """What a line of a check ends in."""

    HOLDS = "holds"
    FAILS = "fails"
    NOT_NEEDED = "not needed"
    VACUOUS = "vacuous"

    def __str__(self) -> str:
        return self.value

    @classmethod
    def of(cls, holds: bool) -> "Verdict":
        """Return the verdict on what either holds or fails."""
        return cls.HOLDS if holds else cls.FAILS
