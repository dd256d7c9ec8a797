"""The self-checks of `doctor`: each one fails where its claim is broken."""

import contextlib
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import scipy

import echelon as ech
from echelon.agents.models import Pendulum, SingleIntegrator
from echelon.agents.models.model_check import check_model
from echelon.core import numerics
from echelon.core.files import versions
from echelon.experiments.scenario import registry
from echelon.experiments.studies import doctor


def verdict(name):
    with numerics.precision("float64"):
        return getattr(doctor, name)()


def test_every_listed_model_is_tried_and_a_broken_one_found(monkeypatch):
    tried = []
    with monkeypatch.context() as changed:
        changed.setattr(doctor, "check_model", lambda x: (tried.append(type(x)), check_model(x)))
        found = verdict("_models")
    assert found.holds and found.found == f"{len(registry.MODELS)} models"
    assert len(set(tried)) == len(registry.MODELS)
    # Another class: of a model that was checked before it is known what was found.
    broken = type("SingleIntegrator", (SingleIntegrator,), {"drift": lambda self, x: x[:1]})
    monkeypatch.setattr(sys.modules["echelon.agents.models"], "SingleIntegrator", broken)
    found = verdict("_models")
    assert not found.holds
    assert found.found == "`drift` of `SingleIntegrator` has shape (1,), and must have shape (2,)."


def test_a_verb_that_loses_or_switches_precision_fails_the_check_of_precision(monkeypatch):
    assert verdict("_precision_kept").holds
    honest = doctor.linearize
    with contextlib.ExitStack() as left:

        def rounds(model):
            return honest(Pendulum(damping=float(jax.numpy.float32(model.damping))))

        def switches(model):
            left.enter_context(numerics.precision("float64"))
            return honest(model)

        for false in (rounds, switches):
            monkeypatch.setattr(doctor, "linearize", false)
            assert not verdict("_precision_kept").holds


def test_versions_are_those_of_what_is_imported_and_of_the_checkout():
    found = versions()
    assert found["echelon"] == ech.__version__
    assert found["python"] == sys.version.split()[0]
    assert [found[name] for name in ("jax", "numpy", "scipy")] == [
        package.__version__ for package in (jax, np, scipy)
    ]
    home = Path(ech.__file__).resolve().parents[2]
    assert ("git" in found) == (home / ".git").exists()
    if "git" in found:
        ends = [
            subprocess.run(["git", "-C", str(home), "rev-parse", name], capture_output=True).stdout
            for name in ("HEAD", found["git"].removesuffix("+"))
        ]
        assert ends[0] and ends[0] == ends[1]
