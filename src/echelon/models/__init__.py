"""Agents: the interface `ControlAffine` and the bundled members."""

from echelon.models.heading import Heading
from echelon.models.integrator import DoubleIntegrator, SingleIntegrator
from echelon.models.linear import Linear
from echelon.models.model import ControlAffine, Limits
from echelon.models.pendulum import Pendulum
from echelon.models.planar_quadrotor import PlanarQuadrotor
from echelon.models.quadrotor import Quadrotor
from echelon.models.quadrotor_euler import QuadrotorEuler, QuadrotorThrust
from echelon.models.quadrotor_printed import PrintedQuadrotor
from echelon.models.unicycle import Unicycle, UnicyclePoint
from echelon.models.van_der_pol import VanDerPol

__all__ = [
    "ControlAffine",
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
