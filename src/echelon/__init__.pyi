# The public names of echelon and where they live; `__init__.py` loads each when it is first used.

from . import (
    laws as laws,
)
from .agents import (
    models as models,
)
from .agents import (
    network as network,
)
from .agents import (
    references as references,
)
from .agents.models.model import ControlAffine as ControlAffine
from .agents.network.channel import Bursts as Bursts
from .agents.network.channel import Channel as Channel
from .agents.network.channel import Network as Network
from .agents.network.formation import Formation as Formation
from .agents.network.graph import Graph as Graph
from .agents.network.inbox import Message as Message
from .agents.part import Effects as Effects
from .agents.part import WorldPart as WorldPart
from .agents.references.reference import Reference as Reference
from .agents.world.actuator import Actuator as Actuator
from .agents.world.disturbance import Disturbance as Disturbance
from .agents.world.sensing import Sensing as Sensing
from .agents.world.sensing import SensorStage as SensorStage
from .agents.world.world import World as World
from .core import errors as errors
from .core.errors import EchelonError as EchelonError
from .core.errors import Outcome as Outcome
from .core.words import Feedforward as Feedforward
from .experiments.results.dataset import (
    dataset as dataset,
)
from .experiments.results.dataset import (
    save_dataset as save_dataset,
)
from .experiments.results.lyapunov import lyapunov as lyapunov
from .experiments.results.metrics import metrics as metrics
from .experiments.results.summary import summary as summary
from .experiments.scenario.build import build as build
from .experiments.scenario.build import run as run
from .experiments.scenario.scenario import (
    Scenario as Scenario,
)
from .experiments.scenario.scenario import (
    bundled_scenarios as bundled_scenarios,
)
from .experiments.scenario.scenario import (
    load_scenario as load_scenario,
)
from .experiments.scenario.scenario import (
    scenario_from_mapping as scenario_from_mapping,
)
from .experiments.studies.assumptions import finite_condition as finite_condition
from .experiments.studies.check import check as check
from .experiments.studies.compare import compare as compare
from .experiments.studies.design import design as design
from .experiments.studies.observed_region import observed_region as observed_region
from .experiments.studies.seed_comparison import compare_seeds as compare_seeds
from .experiments.studies.state_space import state_space as state_space
from .guarantees.promises.promise import Guarantee as Guarantee
from .guarantees.promises.promise import guarantee as guarantee
from .laws.law import Law as Law
from .laws.safety import Safety as Safety
from .output.archive.export import export as export
from .output.archive.export import table as table
from .output.archive.run_folder import load as load
from .output.archive.run_folder import save_run as save_run
from .output.archive.verify_folder import verify as verify
from .output.plots.run_figures import figures as figures
from .output.plots.run_figures import save_figures as save_figures
from .output.plots.video import save_video as save_video
from .output.reports.comparison_report import comparison_report as comparison_report
from .output.reports.guarantee_text import guarantee_text as guarantee_text
from .output.reports.run_report import report as report
from .simulation import (
    optimal as optimal,
)
from .simulation.engine.agent import Agent as Agent
from .simulation.engine.gradient import gradient as gradient
from .simulation.engine.law_drive import Laws as Laws
from .simulation.engine.parts import Parts as Parts
from .simulation.engine.result import Result as Result
from .simulation.engine.simulate import simulate as simulate
from .simulation.step.leadership import Leadership as Leadership
from .simulation.step.motion import IdealMotors as IdealMotors
from .simulation.step.settings import Settings as Settings
from .synthesis import (
    certificates as certificates,
)
from .synthesis import (
    gains as gains,
)
from .synthesis.gains.gain import Gain as Gain
from .synthesis.gains.gain import Method as Method
from .synthesis.gains.gain import synthesize as synthesize
from .synthesis.gains.gain_file import load_gain as load_gain
from .synthesis.gains.gain_file import save_gain as save_gain

__version__: str
from .experiments.sweeps.sweep import sweep as sweep
