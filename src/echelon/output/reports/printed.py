"""The numbers of the paper's Table II (arXiv 2309.09156), for comparison."""

from collections.abc import Mapping

PRINTED: Mapping[str, tuple[float, ...]] = {
    "consensus": (0.186, 9.289e-17, 7.692e-17, 5.207e-17),
    "optimization": (0.186, 0.0302, 7.692e-17, 0.018),
}
"""RMSE in m of leader and followers 1, 2, 3, per method, over 10 s."""

ROUNDING = (
    "The printed values are the paper's Table II (10 s). Its followers' errors of 1e-17 m are "
    "rounding errors of constant offsets (all its samples are multiples of 2^-53), not errors of a "
    "closed loop; compare them with the steady RMSE from random starts above."
)


def is_papers_experiment(scenario: str, model: str, agents: int) -> bool:
    """Return whether a scenario is comparable: `paper` or a variant, with 4 quadrotors."""
    return (
        model == "Quadrotor"
        and agents == 4
        and (scenario == "paper" or scenario.startswith("paper-"))
    )
