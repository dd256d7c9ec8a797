"""The numbers that the paper prints, to stand beside ours (arXiv 2309.09156, Table II)."""

from collections.abc import Mapping

PRINTED: Mapping[str, tuple[float, ...]] = {
    "consensus": (0.186, 9.289e-17, 7.692e-17, 5.207e-17),
    "optimization": (0.186, 0.0302, 7.692e-17, 0.018),
}
"""RMSE in m of leader and followers 1, 2, 3, per method, over 10 s."""

ROUNDING = (
    "Printed is the paper's Table II (10 s). Its followers' 1e-17 m is the rounding "
    "of constant offsets (all its samples are multiples of 2^-53, and start there), not the error "
    "of a closed loop; compare it with the steady RMSE from random starts above."
)


def is_papers_experiment(scenario: str, model: str, agents: int) -> bool:
    """Tell whether the printed values belong beside a scenario: `paper`, its variants, 4 agents."""
    flown = model == "Quadrotor" and agents == 4
    return flown and (scenario == "paper" or scenario.startswith("paper-"))
