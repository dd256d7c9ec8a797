"""The data of a run from which its guarantee is computed."""

import math
from typing import NamedTuple

from echelon.agents.models.linearization import at_trim
from echelon.agents.models.straight_range import is_straight
from echelon.agents.network.channel import LATE
from echelon.core.types import Array
from echelon.core.words import Feedforward
from echelon.guarantees.local.local_certificate import LocalCertificate
from echelon.guarantees.promises.closed_loop import LinearLoop
from echelon.guarantees.promises.frozen_laws import FrozenLaws
from echelon.guarantees.promises.leaders import Leaders
from echelon.simulation.engine.parts import Parts
from echelon.simulation.step.settings import Settings
from echelon.synthesis.certificates.certificate import RegionCertificate
from echelon.synthesis.certificates.domain import Domain


class GuaranteeInputs(NamedTuple):
    """The data of a run from which its guarantee is computed.

    Attributes:
        loop: the closed loop near the trim.
        slopes: (K, n, n) the slopes of the drift on all sides of the trim, if it bends there and
            they are known; else None.
        frozen: the law along the leader's path and at the starts; None where it is not needed.
        over_network: whether what is guaranteed covers late messages.
        local: what the steps that run do to small errors; None of a drive that is no law.
        known: whether echelon knows the laws and all members of the step.
    """

    parts: Parts
    settings: Settings
    loop: LinearLoop
    leaders: Leaders
    region: RegionCertificate | None = None
    slopes: Array | None = None
    frozen: FrozenLaws | None = None
    over_network: bool = False
    local: LocalCertificate | None = None
    known: bool = True

    @property
    def domain(self) -> Domain | None:
        """What the region speaks of; None without one."""
        return None if self.region is None else self.region.domain

    @property
    def smooth(self) -> bool:
        """Whether the model has a linearization at its trim."""
        return not at_trim(self.parts.model).kinks.any()

    @property
    def governed(self) -> bool:
        """Whether the followers run a law that a theorem speaks of, u = u_ff - c R^-1 g'P z."""
        model = self.parts.model
        return self.known and self.parts.drive.metric(model) is not None and is_straight(model)

    @property
    def fed_by_parents(self) -> bool:
        """Whether each follower is sent the input of its parent."""
        return self.parts.drive.feedforward is Feedforward.PARENT

    @property
    def matched(self) -> bool:
        """Whether the followers are sent an input, or the leader has none beyond the trim."""
        sent = self.parts.drive.feedforward is not Feedforward.NONE
        return sent or self.leaders.rest or self.leaders.alike

    @property
    def leaders_share(self) -> float:
        """The slowest mode of the leaders that is in the followers' errors, 1/s; -inf for none.

        It is there if leaders start apart, and if followers are not sent the input by which their
        leader returns to its path.
        """
        slowest, leaders = self.leaders.slowest, self.leaders
        unsent = not self.matched and leaders.damped
        apart = not (leaders.agree or leaders.alike)
        return slowest if slowest is not None and (unsent or apart) else -math.inf

    @property
    def ignored(self) -> tuple[str, ...]:
        """What acts that no guarantee covers, a phrase each."""
        world = self.parts.world
        acts = world.ignored if self.local is None else world.ignored_at_rest
        acting = [x for x in acts if not (self.over_network and x == LATE)]
        # Far from 0 its numbers are centimetres apart, whatever a law does.
        acting += ["numbers have single precision"] * (self.settings.precision == "float32")
        return tuple(acting)
