"""Agents: the interface `ControlAffine` and the bundled members."""

from echelon.agents.models.bicycle import Bicycle
from echelon.agents.models.boat import Boat
from echelon.agents.models.body_file import MassProperties, read_mass_properties
from echelon.agents.models.fixed_wing import FixedWing
from echelon.agents.models.linear_agent import DoubleIntegrator, Linear, SingleIntegrator
from echelon.agents.models.model import ControlAffine, Heading, Limits
from echelon.agents.models.oscillators import Pendulum, VanDerPol
from echelon.agents.models.planar_quadrotor import PlanarQuadrotor
from echelon.agents.models.quadrotor import PrintedQuadrotor, Quadrotor
from echelon.agents.models.quadrotor_euler import CrazyflieAttitude, QuadrotorEuler, QuadrotorThrust
from echelon.agents.models.unicycle import Unicycle, UnicyclePoint
from echelon.agents.models.unlike import UnlikeAgents

__all__ = [
    "Bicycle",
    "Boat",
    "ControlAffine",
    "CrazyflieAttitude",
    "DoubleIntegrator",
    "FixedWing",
    "Heading",
    "Limits",
    "Linear",
    "MassProperties",
    "Pendulum",
    "PlanarQuadrotor",
    "PrintedQuadrotor",
    "Quadrotor",
    "QuadrotorEuler",
    "QuadrotorThrust",
    "SingleIntegrator",
    "Unicycle",
    "UnicyclePoint",
    "UnlikeAgents",
    "VanDerPol",
    "read_mass_properties",
]
