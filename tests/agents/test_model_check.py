"""Errors for malformed models, raised once, when a model enters `synthesize` or `simulate`."""

import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model_family import MODELS
from runs import simulate

from echelon import ControlAffine, Formation, Graph, synthesize
from echelon.agents.models.linearization import at_trim
from echelon.agents.models.model import Limits
from echelon.agents.models.model_check import check_model
from echelon.core import numerics
from echelon.core.errors import EchelonError, ModelError
from echelon.laws import TrimInput
from echelon.synthesis.gains import FixedGain

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


def test_a_trim_within_the_tolerance_passes():
    assert checked(spoiled(trim=((0.5, 0.5), (0.5 + 5e-10,)))) == ()
    assert "no equilibrium" in told(spoiled(trim=((0.5, 0.5), (0.5 + 5e-9,))))


FAILING = {
    "TracerArrayConversionError": lambda self, x: np.sin(x[0]) * x,
    "TracerBoolConversionError": lambda self, x: x if x[0] > 0 else -x,
    "AttributeError": lambda self, x: x * self.inflw,
    "KeyError": lambda self, x: {}["level"],
}


@pytest.mark.parametrize("kind", FAILING)
def test_errors_inside_an_agent_s_own_code_are_told_with_their_kind(kind):
    sentence = told(spoiled(drift=FAILING[kind]))
    assert sentence.startswith(f"`drift` of `Tank` fails with {kind}: ")
    assert sentence.endswith("; it must be written with `jax.numpy` and take one agent's state.")


def watched(self, x):
    return jax.lax.cond(x[0] > 0.0, lambda y: y * time.time(), lambda y: y, x)


def limits(**changes):
    bounds = {"matrix": ((1.0,),), "low": (-1.0,), "high": (float("inf"),)} | changes
    return {"input_limits": Limits(**bounds)}


def of(name, said):
    return f"`{name}` of `Tank` {said}."


def shape(name, found, wanted):
    return of(name, f"has shape {found}, and must have shape {wanted}")


def entries(name, found, wanted):
    return of(name, f"has {found} entries, and must have {wanted}")


def infinite(name):
    return of(name, "is not finite at the trim [0.0, 0.0]")


def typed(kind):
    return of(
        "drift",
        f"has the type {kind}, and must have that of its argument, float64; write "
        "`jnp.asarray(..., x.dtype)`",
    )


def wanted(name, value, kind, other="; a parameter needs another name"):
    return of(name, f"is {value}, and must be {kind}{other}")


STATES = "which is no state; the states are `upper`, `lower`"
VARIES = of(
    "drift",
    "differs from one call to the next, as a clock or a random number makes it, and must be a "
    "function of its arguments alone",
)
NONE_AT_ALL = " input names, and needs at least one of each."
FAULTS = [
    ({"input_names": ()}, "`Tank` has 2 state names and 0" + NONE_AT_ALL),
    ({"state_names": ()}, "`Tank` has 0 state names and 1" + NONE_AT_ALL),
    ({"state_names": ("level",) * 2}, of("state_names", "repeats a name: `level`, `level`")),
    (
        {"position": ("uper",)},
        of("position", f"names `uper`, {STATES} (did you mean `upper`?)"),
    ),
    (
        {"state_groups": {"levels": ("upper", "x")}},
        of("state_groups['levels']", f"names `x`, {STATES}"),
    ),
    ({"state_units": ("m",)}, entries("state_units", 1, 2)),
    ({"input_units": ("l/s", "l/s")}, entries("input_units", 2, 1)),
    ({"trim": ((0.0,), (0.0,))}, shape("trim[0]", (1,), (2,))),
    ({"trim": ((0.0, 0.0), (0.0, 0.0))}, shape("trim[1]", (2,), (1,))),
    ({"input_scale": ((1.0, 0.0), (0.0, 1.0))}, shape("input_scale", (2, 2), (1, 1))),
    ({"input_scale": ((0.0,),)}, of("input_scale", "is singular, and must be invertible")),
    ({"weights": ((1.0,), (1.0,))}, shape("weights[0]", (1,), (2,))),
    ({"weights": ((1.0, 1.0), (1.0, 2.0))}, shape("weights[1]", (2,), (1,))),
    ({"drift": lambda self, x: x[:1]}, shape("drift", (1,), (2,))),
    ({"drift": lambda self, x: x[0]}, shape("drift", (), (2,))),
    ({"input_map": lambda self, x: jnp.array([1.0, 0.0])}, shape("input_map", (2,), (2, 1))),
    ({"input_map": lambda self, x: jnp.array([[1.0, 0.0]])}, shape("input_map", (1, 2), (2, 1))),
    ({"output": lambda self, x: x[:1]}, shape("output", (1,), (2,))),
    ({"limit": lambda self, u: jnp.zeros(3)}, shape("limit", (3,), (1,))),
    ({"drift": lambda self, x: jnp.log(x)}, infinite("drift")),
    ({"drift": lambda self, x: jnp.sqrt(x)}, "the Jacobian of " + infinite("drift")),
    (
        {"input_map": lambda self, x: jnp.sqrt(x)[:, None]},
        "the Jacobian of " + infinite("input_map"),
    ),
    ({"output": lambda self, x: 1.0 / x}, infinite("output")),
    (
        {"trim": ((0.5, 0.5), (0.25,))},
        "the trim of `Tank` is no equilibrium: f(x*) + g(x*) u* is -0.25 in state `upper`, and "
        "must be within 1e-09 of zero; replace `trim`.",
    ),
    # What would run and mean something else.
    ({"drift": lambda self, x: x * 1j}, typed("complex128")),
    ({"drift": lambda self, x: x > 0.0}, typed("bool")),
    (
        {"drift": lambda self, x: jnp.asarray(x, jnp.float32) * jnp.asarray(1.0, x.dtype)},
        of(
            "drift",
            "casts float64 numbers to fewer digits, and must keep the type of its argument, "
            "`x.dtype`",
        ),
    ),
    ({"drift": lambda self, x: x * np.random.default_rng().uniform()}, VARIES),
    ({"drift": watched}, VARIES),
    (
        limits(matrix=((1.0,), (2.0,)), low=(-1.0, -1.0), high=(1.0, 1.0)),
        of(
            "input_limits",
            "has 2 rows for 1 input, which does not define the input that is delivered beyond "
            "the limits; add the method `limit`",
        ),
    ),
    (
        limits(high=(1.0,)) | {"limit": lambda self, u: u},
        of(
            "limit",
            "returns [-1.2] for [-1.2], which `input_limits` do not allow; make `limit` and "
            "`input_limits` agree",
        ),
    ),
    (
        limits(high=(1.0,)) | {"limit": lambda self, u: jnp.clip(u, -0.2, 0.2)},
        of(
            "limit",
            "returns [0.2] for [0.4], which `input_limits` allow; make `limit` and "
            "`input_limits` agree",
        ),
    ),
    ({"state_names": (1, 2)}, wanted("state_names", (1, 2), "a tuple of names", "")),
    ({"input_names": 1}, wanted("input_names", 1, "a tuple of names", "")),
    ({"position": 0.5}, wanted("position", 0.5, "a tuple of states' names")),
    ({"position": "level"}, wanted("position", "'level'", "a tuple of states' names")),
    (
        {"state_groups": 2.0},
        wanted("state_groups", 2.0, "a mapping of names to tuples of states' names"),
    ),
    ({"chart": 0.1}, wanted("chart", 0.1, "a mapping of states' names to bounds")),
    ({"input_units": 3.0}, wanted("input_units", 3.0, "a tuple of units")),
    ({"difference": 1.0}, wanted("difference", 1.0, "a method")),
    ({"input_limits": (0.0, 1.0)}, wanted("input_limits", (0.0, 1.0), "a `Limits`", "")),
    (limits(matrix=((1.0, 0.0),)), shape("input_limits.matrix", (1, 2), (1, 1))),
    (limits(low=(-1.0, -1.0)), shape("input_limits.matrix", (1, 1), (2, 1))),
    (limits(low=(NAN,)), wanted("input_limits.low", "(nan,)", "numbers", "")),
    (
        limits(low=(1.0,), high=(-1.0,)),
        of("input_limits", "must have each `low` below its `high`"),
    ),
]


@pytest.mark.parametrize(("changes", "sentence"), FAULTS)
def test_each_fault_has_its_sentence(changes, sentence):
    assert told(spoiled(**changes)) == sentence


def test_constant_draws_open_limits_and_whole_numbers_pass():
    def noisy(self, x):
        return x + jax.random.normal(jax.random.key(0), (2,))

    with numerics.precision("float64"):
        noise = np.asarray(jax.random.normal(jax.random.key(0), (2,)))
    still = {"trim": ((0.0, -noise[1]), (-noise[0],))}
    assert checked(spoiled(drift=noisy, **still)) == ()
    assert checked(spoiled(**limits())) == ()
    assert checked(spoiled(input_map=lambda self, x: jnp.array([[1], [0]]))) == ()
    # In double precision wherever it is asked.
    assert check_model(Tank()) == ()


def test_several_agents_for_one_are_refused():
    assert told([Tank(), Tank()]) == (
        "the model is a list of 2, and must be one model, which all agents share; agents that all "
        "differ from it are described by a `plant`."
    )


REFUSED = [
    ({"trim": ((0.0, 0.0), (NAN,))}, "`trim"),
    ({"trim": ((NAN, 0.0), (0.0,))}, "nan"),
    ({"input_scale": ((NAN,),)}, "`input_scale`"),
    ({"weights": ((NAN, 1.0), (1.0,))}, "`weights[0]`"),
    ({"trim": ((0.0, 0.0),)}, "`trim`"),
    ({"weights": ((1.0, 1.0),)}, "`weights`"),
    ({"drift": lambda self, x: [-x[0], x[1]]}, "`drift`"),
    ({"input_map": lambda self, x: [[1.0], [0.0]]}, "`input_map`"),
    # Forgotten commas.
    ({"input_names": ("inflow")}, "`input_names`"),
    ({"state_names": ("ab")}, "`state_names`"),
]


@pytest.mark.parametrize(("changes", "fragment"), REFUSED)
def test_what_cannot_work_is_refused_by_name(changes, fragment):
    assert fragment in told(spoiled(**changes))


@pytest.mark.parametrize("thing", [Tank, "tank", None, 3.0], ids=str)
def test_what_is_no_agent_is_refused(thing):
    must = "and must be an instance of a `ControlAffine` class."
    assert told(thing) == f"the model is {thing!r}, {must}"


def fly(model):
    laws = {"leader": TrimInput(), "follower": TrimInput()}
    return simulate(model, Graph.path(2), Formation(np.zeros((2, 2))), **laws, horizon=0.1, dt=0.1)


def test_both_verbs_check_the_agent_they_are_given():
    model = spoiled(trim=((0.5, 0.5), (0.25,)))
    for verb in (lambda: synthesize(model, Graph.path(2), FixedGain()), lambda: fly(model)):
        with pytest.raises(EchelonError, match="is no equilibrium"):
            verb()


class Tuned(Tank):
    """An agent whose parameter may be an array."""

    outflow: np.ndarray | jnp.ndarray | float = 1.0


def test_parameters_that_jax_has_rounded_are_warned_of_and_others_are_not():
    rounded = Tuned(outflow=jnp.asarray(0.1, jnp.float32))
    (warning,) = checked(rounded)
    assert warning == (
        "`outflow` of `Tuned` is a float32 array, so its values have only 7 digits; keep "
        "parameters as Python numbers or float64 NumPy arrays."
    )
    assert checked(Tuned(outflow=np.array(0.1))) == () == checked(Tuned(outflow=0.1))
    assert warning in fly(rounded).warnings


def test_names_of_states_and_groups_are_asked_for_by_name():
    model = spoiled(state_groups={"levels": ("upper", "lower")})
    assert model.states_called("levels") == (0, 1) and model.states_called("lower") == (1,)
    with pytest.raises(ModelError) as caught:
        model.states_called("uper")
    assert str(caught.value) == (
        "`uper` is no state or group of `Tank`, which has `levels`, `upper`, `lower` "
        "(did you mean `upper`?)."
    )


def test_an_agent_of_ones_own_is_two_methods_and_two_tuples_of_names():
    model = Tank()
    with numerics.precision("float64"):
        x, u = jnp.array([0.5, 0.25]), jnp.array([3.0])
        assert model.velocity(x, u).tolist() == [2.5, 0.25] and (model.output(x) == x).all()
    assert model.output_names == model.state_names
    assert model.state_units == ("", "") and model.input_units == ("",)
    assert model.trim == ((0.0, 0.0), (0.0,))
    assert model.weights == ((1.0, 1.0), (1.0,))
    assert model.input_scale == ((1.0,),)
    assert (model.position, model.flat_outputs, dict(model.state_groups)) == ((), (), {})


def test_an_agent_without_a_flat_map_says_how_to_go_on():
    with pytest.raises(ModelError) as caught:
        Tank().flat(jnp.zeros((1, 1)))
    assert str(caught.value) == (
        "model `Tank` cannot track a reference, since it defines no `flat`; use the law `passive` "
        "for its leader, or add `flat_outputs`, `flat_order` and `flat`."
    )


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
    ("model", "of", "said", "seen"),
    [
        (scalar(lambda x: -x + 5 * jax.lax.stop_gradient(x)), "`drift` for `x`", "-1", "4"),
        (scalar(lambda x: lying(x) - x), "`drift` for `x`", "-2", "4"),
        (
            scalar(lambda x: -x, lambda x: 1.0 + jax.lax.stop_gradient(x)[:, None]),
            "`input_map` for `x` and `push`",
            "0",
            "1",
        ),
    ],
)
def test_a_derivative_that_is_none_is_refused(model, of, said, seen):
    with pytest.raises(ModelError) as caught:
        check_model(model)
    assert f"the derivative of {of} of `Scalar` in `x` at the trim" in str(caught.value)
    assert f"is {said} by JAX and {seen} by its values;" in str(caught.value)


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
