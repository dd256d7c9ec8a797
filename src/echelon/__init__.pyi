# The public names of echelon and where they live; `__init__.py` loads each when it is first used.

from . import (
    certificates as certificates,
)
from . import (
    gains as gains,
)
from . import (
    laws as laws,
)
from . import (
    models as models,
)
from . import (
    network as network,
)
from . import (
    optimal as optimal,
)
from . import (
    references as references,
)
from .archive.open import open_run as open_run
from .archive.run import (
    load_run as load_run,
)
from .archive.run import (
    save_run as save_run,
)
from .core import errors as errors
from .core.errors import EchelonError as EchelonError
from .core.errors import Outcome as Outcome
from .engine.agent import Agent as Agent
from .engine.agent import Message as Message
from .engine.gradient import gradient as gradient
from .engine.laws import Laws as Laws
from .engine.parts import Parts as Parts
from .engine.result import Result as Result
from .engine.settings import Settings as Settings
from .engine.simulate import simulate as simulate
from .gains.file import load_gain as load_gain
from .gains.file import save_gain as save_gain
from .gains.gain import Gain as Gain
from .gains.gain import Method as Method
from .gains.gain import synthesize as synthesize
from .laws.law import Law as Law
from .models.model import ControlAffine as ControlAffine
from .network.formation import Formation as Formation
from .network.graph import Graph as Graph
from .plots.run import figures as figures
from .plots.run import save_figures as save_figures
from .promises.promise import Promise as Promise
from .promises.promise import promise as promise
from .references.reference import Reference as Reference
from .reports.comparison import comparison_report as comparison_report
from .reports.run import report as report
from .results.dataset import (
    dataset as dataset,
)
from .results.dataset import (
    save_dataset as save_dataset,
)
from .results.dataset import (
    summary as summary,
)
from .results.lyapunov import lyapunov as lyapunov
from .results.metrics import metrics as metrics
from .scenario.build import build as build
from .scenario.build import run as run
from .scenario.scenario import (
    Scenario as Scenario,
)
from .scenario.scenario import (
    bundled_scenarios as bundled_scenarios,
)
from .scenario.scenario import (
    load_scenario as load_scenario,
)
from .scenario.scenario import (
    scenario_from_mapping as scenario_from_mapping,
)
from .studies.check import check as check
from .studies.compare import compare as compare
from .studies.design import design as design
from .studies.finite_condition import finite_condition as finite_condition
from .studies.speedup import speedup as speedup
from .studies.tune import tune as tune
from .verifier.verify import verify as verify
from .world.disturbance import Disturbance as Disturbance
from .world.world import World as World

__version__: str
from .sweeps.sweep import sweep as sweep
