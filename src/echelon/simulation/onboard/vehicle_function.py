"""The motion of one simulated vehicle, as a function on a graph of scalars."""

import dataclasses

import jax

from echelon.simulation.native.agent_step import leaves_of
from echelon.simulation.onboard.law_functions import LawFunction
from echelon.simulation.scalars import ScalarGraph, lower, nodes
from echelon.simulation.step.motion import Motion, MotionState


def move_function(motion: Motion) -> LawFunction:
    """Return `move`: how one agent moves in a step of its own motion, under its actuators.

    Raises:
        Unsupported: the plant has no scalar operations; with the file and line of a user's code.
    """
    plant, lags = motion.plant, motion.motors is not None and motion.motors.lag is not None
    n, m = len(plant.state_names), len(plant.input_names)

    def move(
        x: jax.Array, u: jax.Array, memory: jax.Array, push: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        u = motion.deliver(u)
        if motion.motors is None:
            return motion.move(x, u, push, None), memory
        x, after = motion.follow(x, u, push, None, MotionState(memory if lags else None))
        return x, memory if after.actuators is None else after.actuators

    sizes = {"x": n, "u": m, "memory": m if lags else 0, "push": n}
    graph = ScalarGraph()
    leaves = [leaves_of(graph, name, range(size)) for name, size in sizes.items()]
    x, memory = (nodes(graph, part) for part in lower(move, graph, leaves))
    about = "the state and what the actuators remember, a step later"
    return LawFunction("move", about, sizes, {"x": x, "memory": memory})


def motions_of(motion: Motion, agents: int, substeps: int) -> list[Motion]:
    """Return the motion of each agent in a part of a step."""
    rows = [motion] * agents
    if motion.rows is not None:
        rows = [
            motion.of_row(jax.tree.map(lambda a, k=k: a[k], motion.rows)) for k in range(agents)
        ]
    return [dataclasses.replace(each, dt=motion.dt / substeps) for each in rows]
