"""Errors for malformed models, raised once, when a model enters `synthesize` or `simulate`."""

import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model_family import MODELS
from runs import simulate

from echelon.agents.models import ControlAffine, SingleIntegrator
from echelon.agents.models.linearization import at_trim
from echelon.agents.models.model import Limits
from echelon.agents.models.model_check import check_model
from echelon.agents.network.formation import Formation
from echelon.agents.network.graph import Graph
from echelon.core import numerics
from echelon.core.errors import EchelonError, ModelError
from echelon.laws import TrimInput
from echelon.synthesis.gains import FixedGain
from echelon.synthesis.gains.gain import synthesize

NAN = float("nan")


class Tank(ControlAffine):
    """A sound agent, which every test here spoils in one way."""

    state_names = ("upper", "lower")
    input_names = ("inflow",)

    def drift(self, x):
        return jnp.stack([-x[0], x[0] - x[1]])

    def input_map(self, x):
        return jnp.array([[1.0], [0.0]])


def spoiled(**changes):
    """The agent `Tank` with attributes or methods replaced."""
    return type("Tank", (Tank,), {"__module__": __name__, "__doc__": "Spoiled.", **changes})()


def checked(model):
    with numerics.precision("float64"):
        return check_model(model)


def told(model):
    """The sentence that refuses a model."""
    with pytest.raises(ModelError) as caught:
        checked(model)
    sentence = str(caught.value)
    assert "\n" not in sentence and sentence.endswith(".") and caught.value.exit_code == 2
    return sentence


@pytest.mark.parametrize("model", [*MODELS.values(), Tank()], ids=[*MODELS, "tank"])
def test_sound_agents_pass_without_a_word(model):
    assert checked(model) == ()


def of_two_names(self, x):
    return x[:1]


SENTENCES = {
    "no inputs": (
        {"input_names": ()},
        "`Tank` has 2 state names and 0 input names, and needs at least one of each.",
    ),
    "no states": (
        {"state_names": ()},
        "`Tank` has 0 state names and 1 input names, and needs at least one of each.",
    ),
    "a name twice": (
        {"state_names": ("level", "level")},
        "`state_names` of `Tank` repeats a name: `level`, `level`.",
    ),
    "a position that is no state": (
        {"position": ("uper",)},
        "`position` of `Tank` names `uper`, which is no state; the states are `upper`, `lower` "
        "(did you mean `upper`?).",
    ),
    "a group of strangers": (
        {"state_groups": {"levels": ("upper", "x")}},
        "`state_groups['levels']` of `Tank` names `x`, which is no state; the states are "
        "`upper`, `lower`.",
    ),
    "too few state units": (
        {"state_units": ("m",)},
        "`state_units` of `Tank` has 1 entries, and must have 2.",
    ),
    "too many input units": (
        {"input_units": ("l/s", "l/s")},
        "`input_units` of `Tank` has 2 entries, and must have 1.",
    ),
    "a short trim state": (
        {"trim": ((0.0,), (0.0,))},
        "`trim[0]` of `Tank` has shape (1,), and must have shape (2,).",
    ),
    "a long trim input": (
        {"trim": ((0.0, 0.0), (0.0, 0.0))},
        "`trim[1]` of `Tank` has shape (2,), and must have shape (1,).",
    ),
    "a scale of another size": (
        {"input_scale": ((1.0, 0.0), (0.0, 1.0))},
        "`input_scale` of `Tank` has shape (2, 2), and must have shape (1, 1).",
    ),
    "a singular scale": (
        {"input_scale": ((0.0,),)},
        "`input_scale` of `Tank` is singular, and must be invertible.",
    ),
    "short weights": (
        {"weights": ((1.0,), (1.0,))},
        "`weights[0]` of `Tank` has shape (1,), and must have shape (2,).",
    ),
    "weights of too many inputs": (
        {"weights": ((1.0, 1.0), (1.0, 2.0))},
        "`weights[1]` of `Tank` has shape (2,), and must have shape (1,).",
    ),
    "a short drift": (
        {"drift": of_two_names},
        "`drift` of `Tank` has shape (1,), and must have shape (2,).",
    ),
    "a scalar drift": (
        {"drift": lambda self, x: x[0]},
        "`drift` of `Tank` has shape (), and must have shape (2,).",
    ),
    "an input map that is a vector": (
        {"input_map": lambda self, x: jnp.array([1.0, 0.0])},
        "`input_map` of `Tank` has shape (2,), and must have shape (2, 1).",
    ),
    "an input map that lies down": (
        {"input_map": lambda self, x: jnp.array([[1.0, 0.0]])},
        "`input_map` of `Tank` has shape (1, 2), and must have shape (2, 1).",
    ),
    "an output without its names": (
        {"output": of_two_names},
        "`output` of `Tank` has shape (1,), and must have shape (2,).",
    ),
    "a limit of another size": (
        {"limit": lambda self, u: jnp.zeros(3)},
        "`limit` of `Tank` has shape (3,), and must have shape (1,).",
    ),
    "a drift without a value": (
        {"drift": lambda self, x: jnp.log(x)},
        "`drift` of `Tank` is not finite at the trim [0.0, 0.0].",
    ),
    "a drift without a slope": (
        {"drift": lambda self, x: jnp.sqrt(x)},
        "the Jacobian of `drift` of `Tank` is not finite at the trim [0.0, 0.0].",
    ),
    "an input map without a slope": (
        {"input_map": lambda self, x: jnp.sqrt(x)[:, None]},
        "the Jacobian of `input_map` of `Tank` is not finite at the trim [0.0, 0.0].",
    ),
    "an output without a value": (
        {"output": lambda self, x: 1.0 / x},
        "`output` of `Tank` is not finite at the trim [0.0, 0.0].",
    ),
    "a trim that is no equilibrium": (
        {"trim": ((0.5, 0.5), (0.25,))},
        "the trim of `Tank` is no equilibrium: f(x*) + g(x*) u* is -0.25 in state `upper`, and "
        "must be within 1e-09 of zero; replace `trim`.",
    ),
}


@pytest.mark.parametrize("name", SENTENCES)
def test_each_fault_has_its_sentence(name):
    changes, sentence = SENTENCES[name]
    assert told(spoiled(**changes)) == sentence


def test_a_trim_within_the_tolerance_passes():
    assert checked(spoiled(trim=((0.5, 0.5), (0.5 + 5e-10,)))) == ()
    assert "no equilibrium" in told(spoiled(trim=((0.5, 0.5), (0.5 + 5e-9,))))


FAILING = {
    "numpy": (lambda self, x: np.sin(x[0]) * x, "TracerArrayConversionError"),
    "a branch": (lambda self, x: x if x[0] > 0 else -x, "TracerBoolConversionError"),
    "a wrong name": (lambda self, x: x * self.inflw, "AttributeError"),
    "a wrong index": (lambda self, x: {}["level"], "KeyError"),
}


@pytest.mark.parametrize("name", FAILING)
def test_errors_inside_an_agent_s_own_code_are_told_with_their_kind(name):
    drift, kind = FAILING[name]
    sentence = told(spoiled(drift=drift))
    assert sentence.startswith(f"`drift` of `Tank` fails with {kind}: ")
    assert sentence.endswith("; it must be written with `jax.numpy` and take one agent's state.")


def single(self, x):
    return jnp.asarray(x, jnp.float32) * jnp.asarray(1.0, x.dtype)


def drawn(self, x):
    return x * np.random.default_rng().uniform()


def watched(self, x):
    return jax.lax.cond(x[0] > 0.0, lambda y: y * time.time(), lambda y: y, x)


def limits(**changes):
    bounds = {"matrix": ((1.0,),), "low": (-1.0,), "high": (float("inf"),)} | changes
    return {"input_limits": Limits(**bounds)}


FALSE = {
    "a complex drift": (
        {"drift": lambda self, x: x * 1j},
        "`drift` of `Tank` has the type complex128, and must have that of its argument, float64; "
        "write `jnp.asarray(..., x.dtype)`.",
    ),
    "a drift of truth values": (
        {"drift": lambda self, x: x > 0.0},
        "`drift` of `Tank` has the type bool, and must have that of its argument, float64; write "
        "`jnp.asarray(..., x.dtype)`.",
    ),
    "a drift in single precision": (
        {"drift": single},
        "`drift` of `Tank` casts float64 numbers to fewer digits, and must keep the type of its "
        "argument, `x.dtype`.",
    ),
    "a drawn drift": (
        {"drift": drawn},
        "`drift` of `Tank` differs from one call to the next, as a clock or a random number makes "
        "it, and must be a function of its arguments alone.",
    ),
    "a drift by the clock": (
        {"drift": watched},
        "`drift` of `Tank` differs from one call to the next, as a clock or a random number makes "
        "it, and must be a function of its arguments alone.",
    ),
    "limits that do not say what is delivered": (
        limits(matrix=((1.0,), (2.0,)), low=(-1.0, -1.0), high=(1.0, 1.0)),
        "`input_limits` of `Tank` has 2 rows for 1 input, which does not define the input that "
        "is delivered beyond the limits; add the method `limit`.",
    ),
    "limits that nothing keeps to": (
        limits(high=(1.0,)) | {"limit": lambda self, u: u},
        "`limit` of `Tank` returns [-1.2] for [-1.2], which `input_limits` do not allow; make "
        "`limit` and `input_limits` agree.",
    ),
    "a limit that cuts what is allowed": (
        limits(high=(1.0,)) | {"limit": lambda self, u: jnp.clip(u, -0.2, 0.2)},
        "`limit` of `Tank` returns [0.2] for [0.4], which `input_limits` allow; make `limit` "
        "and `input_limits` agree.",
    ),
    "numbers for names": (
        {"state_names": (1, 2)},
        "`state_names` of `Tank` is (1, 2), and must be a tuple of names.",
    ),
    "one number for names": (
        {"input_names": 1},
        "`input_names` of `Tank` is 1, and must be a tuple of names.",
    ),
    "a number for a position": (
        {"position": 0.5},
        "`position` of `Tank` is 0.5, and must be a tuple of states' names; a parameter needs "
        "another name.",
    ),
    "a text for a position": (
        {"position": "level"},
        "`position` of `Tank` is 'level', and must be a tuple of states' names; a parameter needs "
        "another name.",
    ),
    "a number for groups": (
        {"state_groups": 2.0},
        "`state_groups` of `Tank` is 2.0, and must be a mapping of names to tuples of states' "
        "names; a parameter needs another name.",
    ),
    "a number for a chart": (
        {"chart": 0.1},
        "`chart` of `Tank` is 0.1, and must be a mapping of states' names to bounds; a parameter "
        "needs another name.",
    ),
    "a number for units": (
        {"input_units": 3.0},
        "`input_units` of `Tank` is 3.0, and must be a tuple of units; a parameter needs "
        "another name.",
    ),
    "a number for a difference": (
        {"difference": 1.0},
        "`difference` of `Tank` is 1.0, and must be a method; a parameter needs another name.",
    ),
    "limits that are no limits": (
        {"input_limits": (0.0, 1.0)},
        "`input_limits` of `Tank` is (0.0, 1.0), and must be a `Limits`.",
    ),
    "limits of two inputs": (
        limits(matrix=((1.0, 0.0),)),
        "`input_limits.matrix` of `Tank` has shape (1, 2), and must have shape (1, 1).",
    ),
    "limits of different lengths": (
        limits(low=(-1.0, -1.0)),
        "`input_limits.matrix` of `Tank` has shape (1, 1), and must have shape (2, 1).",
    ),
    "limits of no number": (
        limits(low=(NAN,)),
        "`input_limits.low` of `Tank` is (nan,), and must be numbers.",
    ),
    "limits that leave nothing": (
        limits(low=(1.0,), high=(-1.0,)),
        "`input_limits` of `Tank` must have each `low` below its `high`.",
    ),
}


@pytest.mark.parametrize("name", FALSE)
def test_what_would_run_and_mean_something_else_is_refused(name):
    changes, sentence = FALSE[name]
    assert told(spoiled(**changes)) == sentence


def test_constant_draws_and_open_limits_pass():
    def noisy(self, x):
        return x + jax.random.normal(jax.random.key(0), (2,))

    with numerics.precision("float64"):
        noise = np.asarray(jax.random.normal(jax.random.key(0), (2,)))
    still = {"trim": ((0.0, -noise[1]), (-noise[0],))}
    assert checked(spoiled(drift=noisy, **still)) == ()
    assert checked(spoiled(**limits())) == ()


def test_several_agents_for_one_are_refused():
    assert told([Tank(), Tank()]) == (
        "the model is a list of 2, and must be one model, which all agents share; agents that all "
        "differ from it are described by a `plant`."
    )


def test_an_agent_is_checked_in_double_precision_wherever_it_is_asked():
    assert check_model(Tank()) == ()


REFUSED = {
    "a trim input that is no number": ({"trim": ((0.0, 0.0), (NAN,))}, "`trim"),
    "a trim state that is no number": ({"trim": ((NAN, 0.0), (0.0,))}, "nan"),
    "a scale that is no number": ({"input_scale": ((NAN,),)}, "`input_scale`"),
    "weights that are no numbers": ({"weights": ((NAN, 1.0), (1.0,))}, "`weights[0]`"),
    "half a trim": ({"trim": ((0.0, 0.0),)}, "`trim`"),
    "half of the weights": ({"weights": ((1.0, 1.0),)}, "`weights`"),
    "a drift that is a list": ({"drift": lambda self, x: [-x[0], x[1]]}, "`drift`"),
    "an input map that is a list": ({"input_map": lambda self, x: [[1.0], [0.0]]}, "`input_map`"),
    "a forgotten comma": ({"input_names": ("inflow")}, "`input_names`"),
    "another forgotten comma": ({"state_names": ("ab")}, "`state_names`"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_work_is_refused_by_name(name):
    changes, fragment = REFUSED[name]
    assert fragment in told(spoiled(**changes))


def test_an_input_map_of_whole_numbers_works():
    model = spoiled(input_map=lambda self, x: jnp.array([[1], [0]]))
    assert checked(model) == ()


@pytest.mark.parametrize("thing", [Tank, "tank", None, 3.0], ids=str)
def test_what_is_no_agent_is_refused(thing):
    sentence = told(thing)
    assert (
        sentence == f"the model is {thing!r}, and must be an instance of a `ControlAffine` class."
    )


def test_both_verbs_check_the_agent_they_are_given():
    model = spoiled(trim=((0.5, 0.5), (0.25,)))
    graph = Graph.path(2)
    with pytest.raises(EchelonError, match="is no equilibrium"):
        synthesize(model, graph, FixedGain())
    with pytest.raises(EchelonError, match="is no equilibrium"):
        simulate(
            model,
            graph,
            Formation(np.zeros((2, 2))),
            leader=TrimInput(),
            follower=TrimInput(),
            horizon=1.0,
            dt=0.1,
        )


class Tuned(Tank):
    """An agent whose parameter may be an array."""

    outflow: np.ndarray | jnp.ndarray | float = 1.0


def test_parameters_that_jax_has_rounded_are_warned_of_and_others_are_not():
    (warning,) = checked(Tuned(outflow=jnp.asarray(0.1, jnp.float32)))
    assert warning == (
        "`outflow` of `Tuned` is a float32 array, so its values have only 7 digits; keep "
        "parameters as Python numbers or float64 NumPy arrays."
    )
    assert checked(Tuned(outflow=np.array(0.1))) == () == checked(Tuned(outflow=0.1))
    run = simulate(
        Tuned(outflow=jnp.asarray(0.1, jnp.float32)),
        Graph.path(2),
        Formation(np.zeros((2, 2))),
        leader=TrimInput(),
        follower=TrimInput(),
        horizon=0.1,
        dt=0.1,
    )
    assert warning in run.warnings


def test_names_of_states_and_groups_are_asked_for_by_name():
    model = spoiled(state_groups={"levels": ("upper", "lower")})
    assert model.states_called("levels") == (0, 1) and model.states_called("lower") == (1,)
    with pytest.raises(ModelError) as caught:
        model.states_called("uper")
    assert str(caught.value) == (
        "`uper` is no state or group of `Tank`, which has `levels`, `upper`, `lower` "
        "(did you mean `upper`?)."
    )


def test_an_agent_without_a_flat_map_says_how_to_go_on():
    with pytest.raises(ModelError) as caught:
        Tank().flat(jnp.zeros((1, 1)))
    assert str(caught.value) == (
        "model `Tank` cannot track a reference, since it defines no `flat`; use the law `passive` "
        "for its leader, or add `flat_outputs`, `flat_order` and `flat`."
    )


def test_a_sound_agent_needs_no_trim_of_its_own():
    assert checked(SingleIntegrator(2)) == ()
    assert checked(spoiled(trim=((0.0, 0.0), (0.0,)))) == ()


# ---- derivatives that are none, and bends ----


def scalar(drift, input_map=lambda x: jnp.ones((1, 1))):
    """A model of one state from two functions."""

    class Scalar(ControlAffine):
        state_names = ("x",)
        input_names = ("push",)

        def drift(self, x):
            return drift(x)

        def input_map(self, x):
            return input_map(x)

    return Scalar()


@jax.custom_jvp
def lying(x):
    return 5.0 * x


lying.defjvp(lambda primals, tangents: (lying(*primals), -tangents[0]))


@pytest.mark.parametrize(
    ("drift", "said", "seen"),
    [
        (lambda x: -x + 5 * jax.lax.stop_gradient(x), "-1", "4"),
        (lambda x: lying(x) - x, "-2", "4"),
    ],
)
def test_a_derivative_that_is_none_is_refused(drift, said, seen):
    with pytest.raises(ModelError) as caught:
        check_model(scalar(drift))
    assert "the derivative of `drift` for `x` of `Scalar` in `x` at the trim" in str(caught.value)
    assert f"is {said} by JAX and {seen} by its values;" in str(caught.value)


def test_so_is_one_of_the_input_map():
    with pytest.raises(ModelError, match="of `input_map` for `x` and `push`"):
        check_model(scalar(lambda x: -x, lambda x: 1.0 + jax.lax.stop_gradient(x)[:, None]))


def test_what_cannot_be_derived_is_one_sentence():
    def called_back(x):
        return jax.pure_callback(lambda v: -v, jax.ShapeDtypeStruct(x.shape, x.dtype), x)

    with pytest.raises(ModelError, match="`Scalar` has no derivative at its trim"):
        check_model(scalar(called_back))


@pytest.mark.parametrize(
    ("drift", "kinks"),
    [
        (lambda x: -x + 3 * jnp.abs(x), True),
        (lambda x: jnp.where(x > 0, -2 * x, -x), True),
        (lambda x: -x + 0.5 * jnp.sign(x), True),
        (lambda x: -x - jnp.abs(x) * x, False),
        (lambda x: -x - 1e3 * jnp.tanh(x), False),
        (lambda x: -1e6 * x + 1e5 * jnp.sin(30 * x), False),
        (lambda x: -x + jnp.where(x > 1e-3, 1.0, 0.0), False),
    ],
)
def test_a_bend_at_the_trim_is_seen_and_a_curve_is_none(drift, kinks):
    assert check_model(scalar(drift)) == ()
    assert at_trim(scalar(drift)).kinks.any() == kinks


def test_an_input_map_may_bend_and_not_jump():
    bent = scalar(lambda x: -x, lambda x: 1.0 + jnp.abs(x)[:, None])
    jumping = scalar(lambda x: -x, lambda x: jnp.where(x > 0, 1.0, 2.0)[:, None])
    assert not at_trim(bent).kinks.any() and at_trim(jumping).kinks.all()


@pytest.mark.parametrize("name", ["velocity", "normalized_drift", "normalized", "physical"])
def test_what_follows_from_the_equations_is_not_replaced(name):
    # A run would move by one of them, and a proof be of the other.
    assert told(spoiled(**{name: lambda self, *parts: parts[0]})) == (
        f"`Tank` replaces `{name}`, which follows from `drift`, `input_map`, `trim` and "
        "`input_scale`; change those."
    )
    model = Tank()
    object.__setattr__(model, name, lambda *parts: parts[0])
    assert name in told(model)
