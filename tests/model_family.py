"""One or more instances of every bundled model, on which several files of tests run."""

import numpy as np

from echelon.agents.models import (
    Bicycle,
    Boat,
    CrazyflieAttitude,
    DoubleIntegrator,
    FixedWing,
    Linear,
    Pendulum,
    PlanarQuadrotor,
    PrintedQuadrotor,
    Quadrotor,
    QuadrotorEuler,
    QuadrotorThrust,
    SingleIntegrator,
    Unicycle,
    UnicyclePoint,
    VanDerPol,
)

rng = np.random.default_rng(7)
A, B, C = rng.normal(size=(3, 3)), rng.normal(size=(3, 2)), rng.normal(size=(1, 3))

MODELS = {
    "line": SingleIntegrator(1),
    "plane": SingleIntegrator(),
    "five axes": SingleIntegrator(5),
    "double": DoubleIntegrator(3),
    "drag": DoubleIntegrator(2, drag=0.7),
    "linear": Linear(A, B, C),
    "van der pol": VanDerPol(1.5),
    "pendulum": Pendulum(damping=0.3, stiffness=4.0),
    "unicycle": Unicycle(),
    "point": UnicyclePoint(ahead=0.3),
    "unicycle at speed": Unicycle(speed=1.5),
    "bicycle": Bicycle(),
    "boat": Boat(),
    "fixed wing": FixedWing(),
    "planar": PlanarQuadrotor(mass=0.5, inertia=0.002, arm=0.1, motor_thrust=4.0),
    "planar crazyflie": PlanarQuadrotor(),
    "crazyflie": Quadrotor.crazyflie(),
    "big": Quadrotor(mass=1.2, inertia=(0.011, 0.013, 0.02), arm=0.17, motor_thrust=6.0),
    "printed": PrintedQuadrotor(),
    "euler": QuadrotorEuler(gravity=3.7),
    "thrust": QuadrotorThrust(),
    "attitude": CrazyflieAttitude(),
}
FLAT_MODELS = {name: model for name, model in MODELS.items() if model.flat_outputs}
