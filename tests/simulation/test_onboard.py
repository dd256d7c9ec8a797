"""Exported laws, in Python and in C, compute what `Agent` computes."""

import ctypes
import functools
import math
import re
import shutil
import subprocess

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from carts import carts
from plain_agents import Draws, PlainAgent, as_python, compare

import echelon as ech
from echelon.agents.world.sensing import SensorStage
from echelon.simulation.engine.prepare import prepare
from echelon.simulation.onboard.agent_functions import agent_functions, move_function
from echelon.simulation.onboard.source_code import LawFunction, c_text, header_text
from echelon.simulation.scalars import ScalarGraph, Unsupported, lower, nodes
from echelon.simulation.scalars.scalar_graph import OPERATIONS
from echelon.simulation.step.loop import IdealNetwork

COMPILER = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang") or "cc"
"""Of the studies; the other tests read the text of C, which needs none."""
FLAGS = ("-std=c99", "-pedantic", "-Wall", "-Wextra", "-Wdouble-promotion", "-Werror")


def as_read_c(functions, folder, bits=64):
    """Evaluate the assignments of the C text one by one, with NumPy's functions as helpers."""
    both = (functions, ()) if bits == 64 else ((), functions)
    text, scope = c_text(*both, "A law."), twins(np.float64 if bits == 64 else np.float32)
    for _, name, arguments, body in re.findall(
        r"^(void|int) law_(\w+)\(([^)]*)\)\n\{\n(.*?)^\}", text, re.M | re.S
    ):
        names = [argument.split()[-1].lstrip("*") for argument in arguments.split(", ")]
        lines = [f"def {name}({', '.join(names)}):", *map(read, body.splitlines())]
        exec("\n".join(lines), scope)
    return {f.name: with_outputs(f, scope[f.name], scope["array"]) for f in functions}


def read(line):
    """Return a line of C as one of Python."""
    line = re.sub(r"^( *)(const )?(law_real|int) ", r"\1", line.rstrip(";"))
    line = re.sub(r"^( *)for \(;;\) \{", r"\1while True:", line)
    line = re.sub(r"^( *)\}$", "", line)
    line = re.sub(r"\(void\)\w+", "pass", line)
    line = re.sub(r"if \((.*)\)$", r"if \1:", line)
    line = re.sub(r" = (\S+) \? (.+) : (.+)$", r" = \2 if \1 else \3", line)
    line = re.sub(r"(?<![\w.])(\d[\d.]*(?:e[+-]?\d+)?)f\b", r"real(\1)", line)
    line = re.sub(r" = (\S+) / (\S+)$", r" = divide(\1, \2)", line)
    line = line.replace("&&", "and").replace("||", "or")
    line = re.sub(r"!(?!=)", "not ", line)
    return line.replace("(law_real)INFINITY", "inf").replace("(law_real)NAN", "nan")


def frexp(a):
    half, exponent = np.frexp(abs(a))
    return (2.0 * half, exponent - 1) if half < math.sqrt(0.5) else (half, exponent)


def twins(real):
    """Return the helpers of the C text by NumPy's functions, in its precision."""
    bits, guess = np.uint64, 0x5FE6EB50C7B537A9
    if real is np.float32:
        bits, guess = np.uint32, 0x5F375A86
    number = float if real is np.float64 else real
    plain = {name: getattr(np, name) for name in ("floor", "ceil", "rint", "copysign")}
    plain |= {"min": np.minimum, "max": np.maximum}
    return {
        "inf": number(math.inf),
        "nan": number(math.nan),
        "real": number,
        "array": lambda values: [number(x) for x in values],
        "divide": lambda a, b: number(np.divide(a, b)),
        "sqrt": lambda a: number(np.sqrt(a)),
        "sqrtf": lambda a: number(np.sqrt(a)),
        "law_abs": abs,
        "law_bit": lambda a, place: (int(real(a).view(bits)) >> place) % 2 == 1,
        "law_exponent": lambda a: number(frexp(a)[1]),
        "law_mantissa": lambda a: number(frexp(a)[0]),
        "law_single": lambda a: float(np.float32(a)),
        "law_pow2": lambda a: number(np.ldexp(real(1.0), int(a))),
        "law_root_guess": lambda a: number(
            (bits(guess) - (real(a).view(bits) >> bits(1))).view(real)
        ),
        **{f"law_{name}": lambda *a, of=of: number(of(*a)) for name, of in plain.items()},
    }


def as_compiled_c(functions, folder, bits=64):
    both = (functions, ()) if bits == 64 else ((), functions)
    real, place = (np.float64, ctypes.c_double) if bits == 64 else (np.float32, ctypes.c_float)
    (folder / "law.c").write_text(c_text(*both, "A law."))
    (folder / "law.h").write_text(header_text(functions, "A law.", {}))
    single = ["-DLAW_SINGLE"] if bits == 32 else []
    options = [*FLAGS, *single, "-ffp-contract=off", "-O2", "-shared", "-fPIC", "-o", "law.so"]
    subprocess.run([COMPILER, *options, "law.c", "-lm"], cwd=folder, check=True)
    library = ctypes.CDLL(str(folder / "law.so"))
    result = {}
    for f in functions:
        function = getattr(library, f"law_{f.name}")
        both = {**f.inputs, **{name: len(part) for name, part in f.outputs.items()}}
        pointer = np.ctypeslib.ndpointer(real)
        function.argtypes = [place if n is None else pointer for n in both.values()]
        result[f.name] = with_outputs(f, function, functools.partial(np.array, dtype=real))
    return result


def with_outputs(function, call, array):
    """Return a function with outputs as arguments as one that returns them."""

    def run(*inputs):
        both = {
            name: value if size is None else array(value)
            for (name, size), value in zip(function.inputs.items(), inputs, strict=True)
        }
        for name, part in function.outputs.items():
            both.setdefault(name, array([math.nan] * len(part)))
        with np.errstate(all="ignore"):
            valid = call(*both.values())
        results = [list(map(float, both[name])) for name in function.outputs]
        if function.valid is None:
            return results[0] if len(results) == 1 else results
        return *results, bool(valid)

    return run


WAYS = [as_python, as_read_c]
COMPILED = pytest.mark.study, pytest.mark.outside  # with a C compiler, and fails without
each_way = pytest.mark.parametrize("way", [*WAYS, pytest.param(as_compiled_c, marks=COMPILED)])
all_ways = pytest.mark.parametrize(
    "ways",
    [pytest.param(WAYS, id="read"), pytest.param([*WAYS, as_compiled_c], id="all", marks=COMPILED)],
)


SPECIAL = [0.0, -0.0, 0.5, -0.5, 1.5, 2.5, -2.5, 0.3, -7.7, 1e300, -1e300, 2.0**52 + 1.0]
SPECIAL += [math.inf, -math.inf, math.nan]
WHOLE = [-500.0, -1.0, 0.0, 1.0, 7.0, 512.0]
SHIFTED = [1.5 * 2.0**52 + k for k in range(-5, 6)]
POSITIVE = [1e-300, 0.3, 0.5, math.sqrt(0.5), 0.999, 1.0, 2.0, 1.414, 1.4143, 3e200]
DOMAINS = {"pow2": WHOLE, "bit0": SHIFTED, "bit1": SHIFTED}
DOMAINS |= dict.fromkeys(("exponent", "mantissa", "root_guess"), POSITIVE)
DOMAINS["single"] = [x for x in SPECIAL if not abs(x) > 1e39 or math.isinf(x)]
LOGICAL = {"and": 2, "or": 2, "xor": 2, "not": 1, "unlikely": 1, "rare": 1}
ARITY = {"copysign": 2, "min": 2, "max": 2, "fma": 3, "fms": 3, "fnma": 3, "select": 3}
UNARY = {"neg", "abs", "sqrt", "floor", "ceil", "rint", *DOMAINS}


def operations(values):
    """Return one function that applies each operation to a, b and c."""
    graph = ScalarGraph()
    a, b, c = (graph.leaf("x", k) for k in range(3))
    truths = [graph.make("lt", 0.0, x) for x in (a, b, c)]
    results = {}
    for op in values:
        if op == "select":
            results[op] = graph.make(op, truths[0], b, c)
            continue
        operands = truths if op in LOGICAL else (a, b, c)
        arity = LOGICAL.get(op, 1 if op in UNARY else ARITY.get(op, 2))
        node = graph.make(op, *operands[:arity])
        results[op] = graph.make("select", node, 1.0, 0.0) if node.truth else node
    return LawFunction("each", "all of them", {"x": 3}, {op: [n] for op, n in results.items()})


@each_way
def test_each_operation_is_the_graphs_own_to_the_bit(way, tmp_path):
    plain = [op for op in OPERATIONS if op not in DOMAINS]
    for domain, ops in [(SPECIAL, plain), *((d, [op]) for op, d in DOMAINS.items())]:
        folder = tmp_path / ops[0]
        folder.mkdir()
        function = operations(ops)._replace(
            outputs={"y": sum(operations(ops).outputs.values(), [])}
        )
        each = way([function], folder)["each"]
        for a in domain:
            for b, c in [(b, c) for b in SPECIAL for c in (0.25, -0.0, math.nan)]:
                expected = [expectation(op, a, b, c) for op in ops]
                for op, got, value in zip(ops, each([a, b, c]), expected, strict=True):
                    check = np.testing.assert_array_equal
                    if op == "root_guess":
                        np.testing.assert_allclose(got, value, rtol=0.035)
                        continue
                    check(got, value, err_msg=f"{op} {a} {b} {c}")
                    if value == 0.0 and op not in ("min", "max"):
                        assert math.copysign(1.0, got) == math.copysign(1.0, value), (op, a, b, c)
                if domain is not SPECIAL:
                    break


def expectation(op, *values):
    with np.errstate(all="ignore"):
        if op in ("exponent", "mantissa"):
            return float(frexp(values[0])[op == "exponent"])
        if op == "select":
            values = values[0] > 0.0, *values[1:]
        elif op in LOGICAL:
            values = [x > 0.0 for x in values]
        arity = LOGICAL.get(op, 1 if op in UNARY else ARITY.get(op, 2))
        numbers = [x if isinstance(x, bool) else np.float64(x) for x in values[:arity]]
        return float(OPERATIONS[op](*numbers))


OBSERVED = ["leader.observer={push: 16, scale: 2}", "follower.observer={push: 16, scale: 2}"]
AGENTS = {"consensus": ("paper", [], 2), "stopping-point": ("paper-far", OBSERVED, 2)}
AGENTS["its-leader"] = ("paper-far", OBSERVED, 0)


@pytest.fixture(scope="module", params=AGENTS)
def agent(request):
    name, changes, number = AGENTS[request.param]
    parts, settings = ech.build(ech.load_scenario(name, changes))
    return ech.Agent(parts, number, settings.dt, settings.limits)


@all_ways
def test_a_law_by_itself_steps_as_the_agent_does(agent, ways, tmp_path):
    functions = agent_functions(agent.own_law).values()
    laws = [way(functions, tmp_path) for way in ways]
    memories = compare(agent, laws, 200, agent.own_law.loop.motion.dt)
    # Python and C agree to the bit.
    assert all(memory == memories[0] for memory in memories)


@each_way
def test_what_is_not_finite_is_not_valid(agent, way, tmp_path):
    own, functions = agent.own_law, agent_functions(agent.own_law).values()
    trim = list(map(float, own.loop.model.trim[0]))
    plain = PlainAgent(own, way(functions, tmp_path))
    assert plain.step(0.0, trim)[-1]
    for bad in (math.nan, math.inf, -math.inf):
        assert not plain.step(0.0, [*trim[:2], bad, *trim[3:]])[-1], bad


def test_single_precision_is_that_of_its_own_trace(agent, tmp_path):
    """The text in single precision, evaluated by NumPy's own, against double precision."""
    own, draws = agent.own_law, Draws(agent, seed=2)
    single = as_read_c(agent_functions(own, 32).values(), tmp_path, 32)
    exact = PlainAgent(own, as_python(agent_functions(own).values()))
    for k in range(40):
        t, x = k * own.loop.motion.dt, draws.state(k + 1).tolist()
        for message in draws.messages(k, t):
            exact.receive(message)
        *ours, fine = single["step"](*exact.inputs(t, x))
        *results, valid = exact.law["step"](*exact.inputs(t, x))
        assert valid and fine
        for got, value in zip(ours, results, strict=True):
            size = max(1.0, np.nanmax(np.abs(value), initial=0.0))
            np.testing.assert_allclose(got, value, rtol=0, atol=3e-5 * size)
        exact.memory = results[1]


# ---- loops, and what cannot be exported ----------------------------------------------------------


def newton(x):
    """The root of x[0], and in how many steps; the inner loop only spends rounds."""

    def better(now):
        count, y, _ = now
        spent = jax.lax.while_loop(lambda k: k < x[1], lambda k: k + 1.0, 0.0 * y)
        return count + 1, 0.5 * (y + x[0] / y), spent

    def off(now):
        return (jnp.abs(now[1] * now[1] - x[0]) > 1e-9) & (now[0] < 50)

    count, y, spent = jax.lax.while_loop(off, better, (jnp.zeros((), jnp.int32), x[0], x[0]))
    return jnp.stack([y, count.astype(x.dtype), spent])


@each_way
def test_a_loop_ends_where_its_numbers_say(way, tmp_path):
    graph = ScalarGraph(loops=True)
    x = np.array([graph.leaf("x", 0), graph.leaf("x", 1)])
    [y] = lower(newton, graph, [x])
    function = LawFunction("root", "a root", {"x": 2}, {"y": nodes(graph, y)})
    root = way([function], tmp_path)["root"]
    for square in (1.0, 2.0, 10.0, 1e6):
        y, count, spent = root([square, 3.0])
        assert y == pytest.approx(math.sqrt(square), abs=1e-9)
        assert spent == (3.0 if count else square)
        expected, steps = square, 0
        while abs(expected * expected - square) > 1e-9 and steps < 50:
            expected, steps = 0.5 * (expected + square / expected), steps + 1
        assert (y, count) == (expected, steps)
    # A graph of many agents, who would leave at different times, has no such loop.
    with pytest.raises(Unsupported, match="a `while` loop whose end depends on the agent"):
        lower(newton, ScalarGraph(), [np.array([ScalarGraph().leaf("x", k) for k in (0, 1)])])


class MeanSensor(SensorStage):
    """The mean of two measurements, computed on board or by the sensor itself."""

    on_board: bool = eqx.field(default=True, static=True)

    def begin(self, model, x):
        return x

    def read(self, model, memory, x, clock, number):
        return 0.5 * (memory + x), x


class DeafNetwork(IdealNetwork):
    """Nobody hears anybody."""

    def receive(self, loop, memory, known):
        return super().receive(loop, memory, known._replace(said=0.0 * known.said))


class Averaging(ech.WorldPart):
    """A sensor on board."""

    def member(self, loop):
        return loop.with_sensor(MeanSensor())


class Deaf(ech.WorldPart):
    """A network of its own."""

    def member(self, loop):
        return loop.replace(network=DeafNetwork(loop.network.leadership))


def test_a_sensor_of_your_own_that_is_on_board_is_in_the_law():
    world = ech.World(parts=[Averaging()])
    agents = [ech.Agent(carts("consensus").replace(world=w), 1, 0.01) for w in (world, ech.World())]
    sensed, exact = (
        PlainAgent(one.own_law, as_python(agent_functions(one.own_law).values())) for one in agents
    )
    before, now = [0.1, 0.2, 0.0, 0.0], [0.3, -0.2, 0.4, 0.0]
    sensed.step(0.0, before)
    mean = [0.5 * (a + b) for a, b in zip(before, now, strict=True)]
    said = sensed.step(0.01, now)[1]
    assert said == exact.step(0.01, mean)[1] != exact.step(0.01, now)[1]
    compare(agents[0], [sensed.law], 20, 0.01)


def test_a_member_of_your_own_that_an_agent_alone_does_not_have_is_refused():
    parts = carts("consensus").replace(world=ech.World(parts=[Deaf()]))
    own = ech.Agent(parts, 1, 0.01).own_law
    with pytest.raises(
        Unsupported, match=r"the member `DeafNetwork` of your own .*test_onboard.py"
    ):
        agent_functions(own)


# ---- a flight ------------------------------------------------------------------------------------


def fly(agents, bits, moves, starts, steps, folder):
    """Places (T, N, 3) of vehicles in double precision under laws in a precision."""
    plain, x = [], [list(map(float, start)) for start in starts]
    for agent in agents:
        own = folder / f"{bits}-{agent.number}"
        own.mkdir()
        law = as_compiled_c(agent_functions(agent.own_law, bits).values(), own, bits)
        plain.append(PlainAgent(agent.own_law, law))
    places = []

    def tell(sender, row):
        for one in plain:
            if sender in one.rows:
                one.rows[sender] = row

    for k in range(steps):
        t = k * agents[0].own_law.loop.motion.dt
        rows = [one.speak(t, state) for one, state in zip(plain, x, strict=True)]
        for sender, row in enumerate(rows):
            tell(sender, row)
        # The leader is the first one, and acts before the others.
        for i, one in enumerate(plain):
            u, row, valid = one.step(t, x[i])
            assert valid
            tell(i, row)
            x[i], _ = moves(x[i], u, [], [0.0] * len(x[i]))
        places.append([state[:3] for state in x])
    return np.array(places)


@pytest.mark.study
@pytest.mark.outside
def test_a_flight_in_single_precision_is_that_in_double_to_ten_micrometres(tmp_path):
    parts, settings = ech.build(ech.load_scenario("paper-global", OBSERVED))
    agents = [ech.Agent(parts, k, settings.dt) for k in range(4)]
    problem = prepare(parts, settings).problem
    move = as_compiled_c([move_function(problem.motion)], tmp_path)["move"]
    flights = [
        fly(agents, bits, move, problem.states, round(10.0 / settings.dt), tmp_path)
        for bits in (64, 32)
    ]
    apart = np.linalg.norm(flights[0] - flights[1], axis=2).max()
    print(f"single precision is {1e6 * apart:.2f} micrometres from double")
    assert 0.0 < apart <= 1e-5
