"""A user's own sensor, medium, motors and event, of which echelon knows what they say."""

import dataclasses
import json
import pathlib

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from carts import carts
from in_words import in_words

import echelon as ech
from echelon.agents.network.channel import Channel
from echelon.agents.world.sensing import SensorStage
from echelon.core.errors import EchelonError
from echelon.core.statement import Hypothesis
from echelon.core.words import Verdict
from echelon.guarantees.promises.hypotheses import limits_act, other_limits, trim_line
from echelon.output.archive.flight_folder import flight_files
from echelon.simulation.step.motion import IdealMotors

DT, STEPS = 0.02, 60
PLANT = ech.models.SingleIntegrator(dimension=1)


class SlowSensor(SensorStage):
    """Measures every third step, and holds in between."""

    every: int = eqx.field(default=3, static=True)

    def begin(self, model, x):
        return x

    def read(self, model, memory, x, clock, number):
        held = jnp.where(clock.step % self.every == 0, x, memory)
        return held, held


class WeakeningMotors(IdealMotors):
    """Lose a part of their input in every step."""

    left: float = 0.98

    def begin(self, trim):
        return jnp.ones(())

    def integrate(self, field, memory, x, u, plant):
        x, _ = super().integrate(field, (), x, memory * u, plant)
        return x, memory * self.left


class JammedMedium(Channel):
    """Nothing leaves from one step to another."""

    silent: jax.Array
    speaks: jax.Array

    def post(self, posts, step, content, sends, receivers, senders):
        quiet = (step >= self.silent) & (step < self.speaks)
        return super().post(posts, step, content, sends & ~quiet, receivers, senders)


class MeanSensor(SensorStage):
    """The mean of two measurements."""

    def begin(self, model, x):
        return x

    def read(self, model, memory, x, clock, number):
        return 0.5 * (memory + x), x


class GrowingSensor(SensorStage):
    """Remembers more in every step, which no loop can."""

    def begin(self, model, x):
        return x

    def read(self, model, memory, x, clock, number):
        return x, jnp.append(memory, 0.0)


@dataclasses.dataclass(frozen=True)
class Sensed(ech.WorldPart):
    """One more stage of sensing."""

    stage: object

    def member(self, loop):
        return loop.with_sensor(self.stage)


@dataclasses.dataclass(frozen=True)
class Driven(ech.WorldPart):
    """Other motors."""

    motors: object

    def member(self, loop):
        return loop.with_motors(self.motors)


@dataclasses.dataclass(frozen=True)
class Jammed(ech.WorldPart):
    """Another medium."""

    begins: int
    ends: int

    def member(self, loop):
        medium = loop.network.medium
        rows = jnp.asarray(self.begins), jnp.asarray(self.ends)
        return loop.with_medium(JammedMedium(**vars(medium), silent=rows[0], speaks=rows[1]))


class Returning(ech.WorldPart):
    """Returns no loop."""

    def member(self, loop):
        return None


def agreeing(**world):
    graph = ech.Graph.path(3)
    formation = ech.Formation.from_offsets(PLANT, graph, {0: (0.0,), 1: (1.0,), 2: (2.0,)})
    laws = ech.Laws(ech.laws.TrimInput(), ech.laws.Agreement())
    initial = np.array([[0.0], [3.0], [-1.0]])
    return ech.Parts(PLANT, graph, formation, laws, initial=initial, world=ech.World(**world))


def flown(parts):
    settings = ech.Settings(horizon=DT * STEPS, dt=DT, integrator="euler")
    return ech.simulate(parts, settings)


def by_hand(sensed, strength):
    """u = -z of three agents on a path, whose leader stays, in plain Python."""
    x, held, rows, places = np.array([0.0, 3.0, -1.0]), None, [], np.array([0.0, 1.0, 2.0])
    for k in range(STEPS + 1):
        rows.append(x)
        held = x if sensed(k) else held
        e = held - places
        u = -np.array([0.0, 2 * e[1] - e[0] - e[2], e[2] - e[1]])
        x = x + DT * strength(k) * u
    return np.array(rows)


def test_a_sensor_that_measures_every_third_step():
    run = flown(agreeing(parts=[Sensed(SlowSensor())]))
    expected = by_hand(lambda k: k % 3 == 0, lambda k: 1.0)
    np.testing.assert_allclose(run.states[:, :, 0], expected, atol=1e-12)


def test_motors_that_weaken():
    run = flown(agreeing(parts=[Driven(WeakeningMotors())]))
    expected = by_hand(lambda k: True, lambda k: 0.98**k)
    np.testing.assert_allclose(run.states[:, :, 0], expected, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("ends", [20, 60])
def test_a_medium_that_is_jammed_for_a_time(ends):
    """While it is jammed no message leaves, and what arrives grows old; before, nothing differs."""
    radio = ech.Network(rate=50.0, messages="state", hears="leaderward")
    parts, settings = (
        carts("stopping-point", radio),
        ech.Settings(horizon=STEPS * DT, dt=DT, engine="jax"),
    )
    free = ech.simulate(parts, settings)
    world = dataclasses.replace(parts.world, parts=[Jammed(20, ends)])
    run = ech.simulate(parts.replace(world=world), settings)
    same = np.array_equal(run.states, free.states)
    assert same == (ends == 20) and np.array_equal(run.states[:21], free.states[:21])
    assert run.traffic.lost == (ends - 20) * free.traffic.sent // STEPS
    age = np.nanmax(run.traffic.ages[min(ends, 59)])
    assert age == pytest.approx(DT if ends == 20 else DT * (ends - 20), abs=1.5 * DT)


def test_of_a_member_that_counts_steps_nothing_is_guaranteed_and_machine_code_has_it():
    parts = agreeing(parts=[Sensed(SlowSensor())])
    settings = ech.Settings(horizon=1.0, dt=DT)
    promised = ech.guarantee(parts, settings)
    assert str(promised.verdict) == "none"
    assert "`SlowSensor` depends on time" in in_words(promised)
    ours, theirs = (ech.simulate(parts, settings._replace(engine=e)) for e in ("native", "jax"))
    np.testing.assert_allclose(ours.states, theirs.states, rtol=1e-13, atol=1e-13)


def test_of_motors_that_die_nothing_is_guaranteed():
    """A double integrator whose inputs fade keeps what is left of its errors for ever."""
    model, graph = ech.models.DoubleIntegrator(dimension=2), ech.Graph.path(3)
    gain = ech.synthesize(model, graph, ech.gains.Riccati())
    laws = ech.Laws(ech.laws.TrimInput(), ech.laws.Consensus(gain, feedforward="relay"))
    goals, fading = ech.Formation.line(model, graph), WeakeningMotors(left=0.999)
    world = ech.World(parts=[Driven(fading)])
    parts = ech.Parts(model, graph, goals, laws, initial={"position": 1.0}, world=world)
    found = ech.guarantee(parts, ech.Settings(horizon=20.0, dt=DT))
    assert str(found.verdict) == "none", in_words(found)
    errors = ech.simulate(parts, ech.Settings(horizon=800.0, dt=DT)).errors[:, 1:]
    half, last = (np.abs(errors[k]).max() for k in (len(errors) // 2, -1))
    assert 0.0 < 0.99 * half < last


def test_a_member_whose_memory_changes_its_form_is_told_with_its_line():
    line = 1 + pathlib.Path(__file__).read_text().split("class GrowingSensor")[0].count("\n")
    where = rf"test_own_members.py:{line}: the memory of `GrowingSensor` is .*\(3, 1\) at first"
    with pytest.raises(EchelonError, match=where):
        flown(agreeing(parts=[Sensed(GrowingSensor())]))
    with pytest.raises(EchelonError, match=r"test_own_members.py:\d+: `member` .* a `NoneType`"):
        flown(agreeing(parts=[Returning()]))
    broken = r"test_own_members.py:\d+: `member` of `Driven` fails, or its loop cannot take a step"
    with pytest.raises(EchelonError, match=broken):
        flown(agreeing(parts=[Driven(None)]))
    with pytest.raises(EchelonError, match=r"`parts\[0\]` is a `int`, and must be a `WorldPart`"):
        flown(agreeing(parts=[3]))
    with pytest.raises(EchelonError, match="`parts` is a `int`, and must be a list"):
        flown(agreeing(parts=3))


def test_motors_that_weaken_are_not_judged_by_the_flow_of_others():
    parts = carts("consensus").replace(world=ech.World(parts=[Driven(WeakeningMotors())]))
    found = ech.guarantee(parts, ech.Settings(horizon=1.0, dt=DT))
    assert str(found.verdict) == "none" and "move exactly" not in in_words(found)


@pytest.mark.slow
def test_over_a_radio_the_certificate_is_of_a_sensor_that_counts_nothing():
    """Echelon's own network counts steps, and a mean of two measurements does not."""
    world = ech.World(network=ech.Network(rate=50.0), parts=[Sensed(MeanSensor())])
    parts, settings = carts("stopping-point").replace(world=world), ech.Settings(1.0, DT)
    found = ech.guarantee(parts, settings)
    assert str(found.verdict) == "guaranteed" and str(found.kind) == "linearization"
    slow = dataclasses.replace(world, parts=[Sensed(SlowSensor())])
    found = ech.guarantee(parts.replace(world=slow), settings)
    assert str(found.verdict) == "none" and "`SlowSensor` depends on time" in in_words(found)


class DeadBand(SensorStage):
    """Sees nothing near 0, and says that it is noise."""

    random = True

    def read(self, model, memory, x, clock, number):
        return jnp.where(jnp.abs(x) < 0.3, 0.0, x), memory


class Distrusted(ech.Network):
    """A network that says it is another, which it is not."""

    def prepared(self, *given):
        medium = super().prepared(*given)
        return JammedMedium(**vars(medium), silent=jnp.asarray(0), speaks=jnp.asarray(10**6))


@pytest.mark.parametrize("network", [None, pytest.param("radio", marks=pytest.mark.slow)])
def test_of_a_part_that_says_nothing_nothing_is_proved(network):
    """What is dropped where agents rest, such as noise, is not dropped of a user's own."""
    radio = network and ech.Network(rate=50.0)
    world = ech.World(network=radio, parts=[Sensed(DeadBand())])
    parts, settings = carts("stopping-point"), ech.Settings(1.0, DT)
    assert (
        str(ech.guarantee(parts.replace(world=ech.World(network=radio)), settings).kind) == "proof"
    )
    assert str(ech.guarantee(parts.replace(world=world), settings).verdict) == "none"


def test_a_flight_refuses_what_its_vehicles_lack():
    radio = ech.Network(rate=50.0)
    for part, name in ((Sensed(SlowSensor()), "Sensed"), (Jammed(0, 9), "Jammed")):
        world = ech.World(network=radio, parts=[part])
        with pytest.raises(EchelonError, match=f"`{name}` is not in a flight; leave it out"):
            flight_files(carts("stopping-point").replace(world=world), ech.Settings(1.0, DT), "")


def test_a_part_of_your_own_is_no_subclass_of_echelons():
    said = "`network` is a `Distrusted`, and must be a `Network` itself, not a subclass."
    with pytest.raises(EchelonError) as caught:
        flown(carts("stopping-point").replace(world=ech.World(network=Distrusted(rate=50.0))))
    assert str(caught.value) == said


class Choosy(Sensed):
    """A sensor that suits no law."""

    def check_laws(self, laws, graph, dt):
        raise EchelonError(f"`{type(laws.follower).__name__}` needs more than this sensor.")


def test_a_part_of_your_own_may_refuse_laws():
    with pytest.raises(EchelonError, match="`Agreement` needs more than this sensor"):
        flown(agreeing(parts=[Choosy(MeanSensor())]))


class SearchingSensor(SensorStage):
    """Halves what it reads until it is small: a loop whose end depends on numbers."""

    def read(self, model, memory, x, clock, number):
        small = jax.lax.while_loop(lambda y: jnp.abs(y).max() > 1e3, lambda y: 0.5 * y, x)
        return small, memory


def test_solvers_that_would_not_read_a_sensor_of_your_own_refuse_it():
    drive, settings = ech.optimal.RecedingHorizon(), ech.Settings(0.1, DT)
    parts = agreeing(parts=[Sensed(SlowSensor())]).replace(drive=drive)
    with pytest.raises(EchelonError, match="got `Sensed`, but `RecedingHorizon` optimizes inputs"):
        ech.simulate(parts, settings)


def test_a_part_of_your_own_without_a_derivative_is_named():
    sensed = agreeing(parts=[Sensed(MeanSensor()), Sensed(SearchingSensor())])
    with pytest.raises(EchelonError, match="`Sensed` .*SearchingSensor.* has a loop whose end"):
        ech.gradient(sensed, ech.Settings(0.1, DT), lambda sums: sums.errors[0].sum(), ["initial"])


@dataclasses.dataclass(frozen=True)
class Noisy(Sensed):
    """A sensor of the vehicles themselves, which flies, and says all of itself."""

    def unflown(self):
        return ""

    def simulated(self, plant, dt):
        return {"noise": plant.per_state({"position": 0.25}).tolist()}

    def received(self, ideal):
        return (*ideal, "echoes")

    def effects(self):
        return ech.Effects(limits="the motors stick", rounded=True)

    def off_trim(self, plant, trim):
        return "the motors stick", "oil them"


WIND = ech.Disturbance(rms={"velocity": 0.5}, time=1.0)
VEHICLES = ech.World(disturbance=WIND, network=ech.Network(rate=50.0), parts=[Noisy(MeanSensor())])


def test_what_a_part_of_your_own_says_of_limits_and_information_is_asked():
    parts, settings = carts("stopping-point").replace(world=VEHICLES), ech.Settings(1.0, DT)
    assert parts.information.follower[-1] == "echoes"
    line = trim_line(parts, settings)
    assert line.fails and (line.text, line.remedy) == ("the motors stick", "oil them")
    assert limits_act(parts, settings) and other_limits(parts)


@pytest.mark.slow
def test_simulated_vehicles_have_what_a_part_of_your_own_says_of_them():
    parts, settings = carts("stopping-point").replace(world=VEHICLES), ech.Settings(1.0, DT)
    vehicles = json.loads(flight_files(parts, settings, "")["flight.json"])["vehicles"]
    assert vehicles["noise"] == [0.25, 0.25, 0.0, 0.0]
    assert vehicles["rms"] == [0.0, 0.0, 0.5, 0.5] and vehicles["constant"] == [0.0] * 4
    assert vehicles["fade"] == pytest.approx(np.exp(-0.5 * DT))


def test_noise_on_inputs_is_not_left_out_of_a_flight_in_silence():
    wind = ech.Disturbance(input_rms={"ax": 0.5})
    world = ech.World(disturbance=wind, network=ech.Network(rate=50.0))
    with pytest.raises(EchelonError, match="`disturbance.input_rms` has no counterpart"):
        flight_files(carts("stopping-point").replace(world=world), ech.Settings(1.0, DT), "")


# ---- events --------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Fading(ech.network.Event):
    """Edges of an agent carry less for a while."""

    at: float
    agent: int
    left: float = 0.25
    end: float = 0.8

    @property
    def agents(self):
        return (self.agent,)

    def carried(self, graph, weights):
        return np.where((graph.edges == self.agent).any(axis=1), self.left * weights, weights)


@dataclasses.dataclass(frozen=True)
class Known(Fading):
    """The same, and it says that it is of a graph that switches."""

    def uncovered(self, graph):
        return ""


FADED = [
    (0.0, [(0, 1, 1.0), (1, 2, 1.0)]),
    (0.4, [(0, 1, 1.0), (1, 2, 0.25)]),
    (0.8, [(0, 1, 1.0), (1, 2, 1.0)]),
]


@pytest.mark.parametrize("engine", ["jax", "native"])
def test_an_event_of_your_own_is_a_graph_that_switches(engine):
    parts, settings = agreeing(), ech.Settings(STEPS * DT, DT, engine=engine)
    turns = parts.replace(graph=ech.Graph.switching(FADED))
    faded = parts.replace(events=[Fading(0.4, 2)])
    ours, theirs = (ech.simulate(each, settings) for each in (faded, turns))
    assert np.array_equal(ours.states, theirs.states) and ours.engine == engine
    [event] = ech.summary(ours)["events"]
    assert (event["what"], event["agents"], event["until"]) == ("fading", [2], 0.8)
    assert (
        event["guarantee"]["against"] == "`Fading` happens at 0.4 s, and no theorem is about that"
    )


def test_an_event_that_says_nothing_is_covered_by_no_guarantee():
    parts, settings = agreeing(), ech.Settings(STEPS * DT, DT)
    verdicts = [
        ech.guarantee(parts.replace(**change), settings).verdict
        for change in (
            {"events": [Fading(0.4, 2)]},
            {"events": [Known(0.4, 2)]},
            {"graph": ech.Graph.switching(FADED)},
        )
    ]
    assert [*map(str, verdicts)] == ["none", "guaranteed", "guaranteed"]
    until = ech.guarantee(parts.replace(events=[Fading(0.4, 2)]), settings).prefix
    assert until is not None and until.at == 0.4


class Broken(Fading):
    """Returns what are no weights."""

    def carried(self, graph, weights):
        return {1: -weights, 2: weights[:1]}[self.agent]


@pytest.mark.parametrize(
    "event, fault",
    [
        (Broken(0.4, 1), "its `carried` must return the weights of all edges"),
        (Broken(0.4, 2), "its `carried` must return the weights of all edges"),
        (Broken(0.4, 0), "its `carried` fails with"),
        (Fading(0.9, 1), "times must be positive and finite"),
        (Fading(0.4, 7), "agents are numbered from 0 to 2"),
        (3, r"`events\[0\]` is a `int`, and must be a `Event`"),
    ],
)
def test_what_is_no_event_is_refused(event, fault):
    with pytest.raises(EchelonError, match=fault):
        agreeing().replace(events=[event])


class OffSensor(SensorStage):
    """It reads half a metre too much."""

    def read(self, model, memory, x, clock, number):
        return x.at[0].add(0.5), memory


class HalfMotors(IdealMotors):
    """They deliver half of what is asked."""

    def integrate(self, field, memory, x, u, plant):
        return super().integrate(field, memory, x, 0.5 * u, plant)


@pytest.mark.parametrize("part", [Sensed(OffSensor()), Driven(HalfMotors())])
def test_of_silent_parts_no_line_says_that_states_are_exact_or_that_the_trim_is_delivered(part):
    model, graph = ech.models.DoubleIntegrator(), ech.Graph([(0, 1), (1, 2)])
    gain = ech.synthesize(model, graph, ech.gains.Riccati())
    circle = ech.references.Circle(radius=2.0, rate=0.3)
    drive = ech.Laws(ech.laws.Tracking(circle), ech.laws.Consensus(gain))
    places = ech.Formation.from_offsets(model, graph, {1: [1.0, 0.0], 2: [2.0, 0.0]})
    world = ech.World(parts=(part,))
    parts = ech.Parts(model, graph, places, drive, initial={"position": 0.1}, world=world)
    found = ech.guarantee(parts, ech.Settings(horizon=5.0, dt=0.02))
    for name in (Hypothesis.EXACT_STATES, Hypothesis.TRIM_WITHIN_LIMITS):
        assert found.hypotheses[name].verdict is not Verdict.HOLDS
    assert type(part).__name__ in found.hypotheses[Hypothesis.EXACT_STATES].text


def test_beside_a_part_of_your_own_a_trim_that_actuators_lack_is_still_told():
    parts, settings = ech.build(ech.load_scenario("paper", ["plant={scale: {mass: 3.0}}"]))
    own = parts.replace(world=dataclasses.replace(parts.world, parts=(Sensed(OffSensor()),)))
    assert trim_line(parts, settings).fails
    assert trim_line(own, settings).fails
