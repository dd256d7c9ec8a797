"""Agents: the interface `ControlAffine` and the bundled members."""

from echelon.agents.models.crazyflie_attitude import CrazyflieAttitude
from echelon.agents.models.heading import Heading
from echelon.agents.models.integrator import DoubleIntegrator, SingleIntegrator
from echelon.agents.models.linear_agent import Linear
from echelon.agents.models.model import ControlAffine, Limits
from echelon.agents.models.pendulum import Pendulum
from echelon.agents.models.planar_quadrotor import PlanarQuadrotor
from echelon.agents.models.quadrotor import Quadrotor
from echelon.agents.models.quadrotor_euler import QuadrotorEuler, QuadrotorThrust
from echelon.agents.models.quadrotor_printed import PrintedQuadrotor
from echelon.agents.models.unicycle import Unicycle, UnicyclePoint
from echelon.agents.models.van_der_pol import VanDerPol

__all__ = [
    "ControlAffine",
    "CrazyflieAttitude",
    "DoubleIntegrator",
    "Heading",
    "Limits",
    "Linear",
    "Pendulum",
    "PlanarQuadrotor",
    "PrintedQuadrotor",
    "Quadrotor",
    "QuadrotorEuler",
    "QuadrotorThrust",
    "SingleIntegrator",
    "Unicycle",
    "UnicyclePoint",
    "VanDerPol",
]
