"""What a network costs: a step by JAX of a thousand Crazyflies, with messages and without.

    python benchmarks/radio.py [AGENTS]

Prints processor time per agent and step, and the ratio. The machine may be busy: only the time of
this process counts.
"""

import sys
import time

import jax
import numpy as np

import echelon as ech
from echelon.core.numerics import precision
from echelon.simulation.engine.jax_stepper import JaxStepper
from echelon.simulation.engine.prepare import prepare
from echelon.simulation.step.assembly import assemble

AGENTS, STEPS, TRIALS = 1000, 40, 5


def cost(network: ech.Network | None, agents: int) -> float:
    """Return the least processor time (us) of a trial, for one agent and step."""
    sets = [f"graph={{name: geometric, agents: {agents}, radius: {2.0 / np.sqrt(agents):.3g}}}"]
    sets += ["formation={name: grid, spacing: 1.0}", "simulation.engine=jax"]
    parts, settings = ech.build(ech.load_scenario("paper-global", sets))
    prepared = prepare(parts.replace(world=ech.World(network=network)), settings)
    drive, problem = prepared.parts.drive, prepared.problem
    with precision("float64"):
        stepper = JaxStepper(assemble(problem, drive.leader, drive.follower), problem.states)
        counts, now, times = np.array([STEPS, 0], np.int32), stepper.start(), []
        reference = drive.reference_states(problem.model, np.zeros(STEPS + 1))
        reference = np.asarray(reference)
        for _ in range(1 + TRIALS):
            before = time.process_time()
            now = jax.block_until_ready(stepper.advance(now, counts, reference).now)
            times.append(time.process_time() - before)
    return 1e6 * min(times[1:]) / (agents * STEPS)


def main() -> None:
    """Print the costs."""
    agents = int(sys.argv[1]) if sys.argv[1:] else AGENTS
    ideal = cost(None, agents)
    print(f"ideal network: {ideal:.2f} us an agent and step")
    for name, network in {
        "50 Hz, 20 ms": ech.Network(delay=0.02),
        "50 Hz, 20 to 50 ms, 20 % lost": ech.Network(delay=0.02, jitter=0.03, loss=0.2),
    }.items():
        late = cost(network, agents)
        print(f"{name}: {late:.2f} us, {late / ideal:.2f} times as much", flush=True)


if __name__ == "__main__":
    main()
