"""Each self-check can fail: where its claim is broken, `doctor` says so."""

import contextlib

import jax

from echelon.core import numerics
from echelon.models import Pendulum, SingleIntegrator
from echelon.models.check import check_model
from echelon.scenario import registry
from echelon.studies import doctor


def verdict(name):
    with numerics.precision("float64"):
        return getattr(doctor, name)()


def test_every_listed_model_is_tried(monkeypatch):
    tried = []

    def remember(model):
        tried.append(type(model))
        return check_model(model)

    monkeypatch.setattr(doctor, "check_model", remember)
    found = verdict("_models")
    assert found.holds and found.found == f"{len(registry.MODELS)} models"
    assert len(set(tried)) == len(registry.MODELS)


def test_a_broken_model_fails_the_check_of_models(monkeypatch):
    monkeypatch.setattr(SingleIntegrator, "drift", lambda self, x: x[:1])
    found = verdict("_models")
    assert not found.holds
    assert found.found == "`drift` of `SingleIntegrator` has shape (1,), and must have shape (2,)."


def test_a_verb_that_computes_in_single_precision_fails_the_check_of_precision(monkeypatch):
    assert verdict("_precision_kept").holds
    honest = doctor.linearize

    def rounds(model):
        return honest(Pendulum(damping=float(jax.numpy.float32(model.damping))))

    monkeypatch.setattr(doctor, "linearize", rounds)
    assert not verdict("_precision_kept").holds


def test_a_verb_that_switches_precision_for_good_fails_the_check_of_precision(monkeypatch):
    honest = doctor.linearize
    with contextlib.ExitStack() as left:

        def switches(model):
            left.enter_context(numerics.precision("float64"))
            return honest(model)

        monkeypatch.setattr(doctor, "linearize", switches)
        assert not verdict("_precision_kept").holds
