"""Time and peak memory of `echelon check` on a geometric graph of 100,000 agents.

Writes the scenario, runs the command line on it in a process of its own, and prints what it took,
imports and all. Run it as `python benchmarks/check_large.py [AGENTS]`; the scenario stays in
check_large.yaml of the folder that it is run in.
"""

import math
import resource
import subprocess
import sys
import time
from pathlib import Path

SCENARIO = """name: check-large
model: {{name: quadrotor}}
graph: {{name: geometric, agents: {agents}, radius: {radius:.6g}, seed: 0}}
formation: {{name: grid, spacing: 1.0}}
leader: {{law: passive}}
follower: {{law: consensus, gain: {{method: riccati}}, feedforward: relay}}
initial: {{spread: {{position: 1.0}}}}
simulation: {{horizon: 1.0, dt: 0.005}}
"""


def main() -> None:
    """Write the scenario, check it, and print the figures."""
    agents = int(sys.argv[1]) if len(sys.argv) > 1 else 100_000
    # Well above the radius at which random points of the unit square become connected.
    radius = math.sqrt(2.0 * math.log(agents) / (math.pi * agents))
    file = Path("check_large.yaml")
    file.write_text(SCENARIO.format(agents=agents, radius=radius), "utf-8")
    began = time.perf_counter()
    command = [sys.executable, "-m", "echelon", "check", str(file)]
    done = subprocess.run(command, capture_output=True, text=True)
    seconds = time.perf_counter() - began
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    print(done.stdout or done.stderr)
    print(f"{agents} agents, exit code {done.returncode}: {seconds:.1f} s of wall time,")
    print(
        f"{used.ru_utime + used.ru_stime:.1f} s of CPU time, peak {used.ru_maxrss / 2**20:.2f} GB"
    )


if __name__ == "__main__":
    main()
