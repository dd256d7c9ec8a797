"""The scenario file: accepted input, defaults, and errors with their lines."""

import dataclasses
import itertools
import json
import re
from pathlib import Path

import numpy as np
import pytest
from sentences import LINES

import echelon.experiments.scenario.scenario
from echelon.agents.models import DoubleIntegrator
from echelon.core.errors import EchelonError, ScenarioError, listing
from echelon.experiments.scenario import key_paths, registry, sections
from echelon.experiments.scenario.named_class import accepted, resolve
from echelon.experiments.scenario.registry import FORMATIONS, GRAPHS, METHODS, MODELS
from echelon.experiments.scenario.scenario import (
    bundled_scenarios,
    json_schema,
    key_meanings,
    load_scenario,
    scenario_from_mapping,
)
from echelon.experiments.scenario.values import marked_keys
from echelon.experiments.scenario.yaml import ScenarioFault, read_yaml

FOLDER = Path(echelon.experiments.scenario.scenario.__file__).parent

FOLDER_NAME = "text of up to 100 letters, digits, `.`, `_` and `-`, first a letter or a digit"
NUMBER = {name: number for number, name in enumerate(LINES, start=1)}


@pytest.fixture
def load(tmp_path, monkeypatch):
    """Load the scenario above with some lines replaced; `None` drops one."""
    monkeypatch.chdir(tmp_path)

    def loader(*overrides, **changed):
        lines = [changed.get(name, line) for name, line in LINES.items()]
        Path("s.yaml").write_text("\n".join(line or "#" for line in lines), "utf-8")
        return load_scenario("s.yaml", overrides)

    return loader


@pytest.fixture
def refused(load):
    """The lines of the error that loading ends in."""

    def loader(*overrides, **changed):
        with pytest.raises(ScenarioError) as caught:
            load(*overrides, **changed)
        return str(caught.value).splitlines()

    return loader


def test_the_file_is_read_as_written(load):
    scenario = load()
    assert scenario.graph.edges == ((0, 1, 1.0), (1, 2, 1.0), (1, 3, 1.0))
    assert scenario.graph.leaders == (0,)
    assert scenario.formation.offsets == {1: (1, 0, 0), 2: (1, 0.8, 0), 3: (1, -0.8, 0)}
    assert scenario.reference.name == "lemniscate"
    numbers = {"center": (0.25, 0.25, 1.0), "amplitude": (1.25, 3.54), "rate": 0.646}
    assert scenario.reference.parameters == numbers
    assert scenario.leader.start_error == {"x": -1.344, "y": 0.53}
    assert scenario.initial.spread == {"position": 1.0, "attitude": 0.3}
    assert (scenario.simulation.horizon, scenario.simulation.dt) == (60.0, 0.005)
    assert scenario.report.steady_window == 10.0
    assert scenario.text == Path("s.yaml").read_text("utf-8") and scenario.folder == Path()
    # Places are there for later faults.
    assert scenario.place("graph", "edges", 2) == "s.yaml:3"
    assert scenario.place("follower", "gain", "coupling") == "s.yaml:7"
    assert scenario.place("nothing") == "s.yaml:1"
    with pytest.raises(ValueError, match="frozen"):
        scenario.seed = 3


def test_what_is_left_out_is_as_the_schema_says_but_for_the_steady_window():
    given = {
        "name": "least",
        "model": {"name": "pendulum"},
        "graph": {"name": "path", "agents": 4},
        "simulation": {"horizon": 30.0, "dt": 0.01},
    }
    scenario = scenario_from_mapping(given)
    window = {"report": {"steady_window": 6.0}}
    assert scenario.model_dump(exclude_defaults=True) == given | window
    assert (scenario.leader.law, scenario.follower.gain.method) == ("passive", "riccati")


def test_sections_that_are_empty_take_their_defaults(load):
    scenario = load(formation="formation:", report="report:", initial="initial:")
    assert scenario.formation.offsets is None and scenario.initial.spread is None
    assert scenario.report.steady_window == 12.0
    # A leader with a reference tracks it.
    for leader in ("leader: {reacts: true}", "leader:"):
        assert load(leader=leader).leader.law == "tracking"
    # A steady window that is not shorter than the run is a fifth of it.
    assert load("simulation.horizon=10").report.steady_window == 2.0
    assert load("simulation.horizon=10.5").report.steady_window == 10.0
    assert load("simulation.horizon=600", report="report: {}").report.steady_window == 120.0


def test_a_list_of_numbers_is_a_diagonal(load):
    for matrix, rows in (
        ("[2, 0.5]", ((2.0, 0.0), (0.0, 0.5))),
        ("[[2, 1], [1, 2]]", ((2.0, 1.0), (1.0, 2.0))),
        ("identity", "identity"),
    ):
        follower = load(f"follower.gain={{method: given, P: {matrix}, R: [3], coupling: 2}}")
        gain = follower.follower.gain
        assert (gain.P, gain.R, gain.coupling) == (rows, ((3.0,),), 2.0)


@pytest.mark.parametrize(
    "override",
    [
        "graph={edges: [[0, 1, 0.5], [1, 2, 3]], agents: 4, leaders: [0, 3]}",
        "graph={name: grid, rows: 2, columns: 2}",
        "graph={name: grid, rows: 2, columns: 2, agents: 4}",
        "graph={name: geometric, agents: 4, radius: 0.5, seed: 3}",
        "graph={name: ring, agents: 4}",
        "graph={name: star, agents: 4}",
        "graph={name: complete, agents: 4, leaders: [3]}",
        "formation={name: wedge, spacing: 0.5}",
        "formation={name: grid, columns: 2}",
        "initial={states: {1: [1, 2, 3], 2: [0, 0, 1]}}",
        "model={python: 'my models/pendulum.py:Pendulum', parameters: {damping: 0.5}}",
        "model={name: quadrotor, parameters: paper, allow_unphysical: true}",
        "leader.gain={Q: [1, 2], R: [3]}",
        "reference={name: waypoints, times: [0, 1], points: [[0, 0, 1], [1, 0, 1]], yaw: 0}",
        "follower.law=passive",
        "simulation.precision=float32",
    ],
)
def test_sections_that_are_accepted(load, override):
    key = override.split("=")[0]
    assert load(override).place(*key.split(".")).startswith(f"--set {key}=")


def test_keys_belong_to_choices_that_exist():
    for section, choices in (
        (sections.GraphSpec, {"edges", *GRAPHS}),
        (sections.FormationSpec, {"offsets", *FORMATIONS}),
        (sections.GainSpec, {*METHODS}),
        (sections.LeaderSpec, {*registry.LEADER_LAWS}),
        (sections.FollowerSpec, {*registry.FOLLOWER_LAWS}),
    ):
        assert {name for mark in marked_keys(section).values() for name in mark.choices} <= choices


@pytest.mark.parametrize("name", METHODS)
def test_a_method_takes_the_keys_that_its_class_takes(name):
    method, marks = resolve(METHODS[name]), marked_keys(sections.GainSpec)
    arguments = [field.name for field in dataclasses.fields(method)]
    assert sorted(key for key, mark in marks.items() if name in mark.choices) == sorted(arguments)
    assert {key for key, mark in marks.items() if name in mark.needed_by} == {*method.needs}
    assert method.name == name and {*method.defaults} <= {*method.needs}


def test_a_law_takes_the_keys_that_its_class_takes():
    leads, follows = sections.LeaderSpec, sections.FollowerSpec
    for section, laws in ((leads, registry.LEADER_LAWS), (follows, registry.FOLLOWER_LAWS)):
        for name, entry in laws.items():
            taken = {key for key, mark in marked_keys(section).items() if name in mark.choices}
            arguments = set(accepted(resolve(entry)))
            assert taken == arguments & marked_keys(section).keys(), name
            tracks = section is leads and name in registry.TRACKING_LAWS
            assert section is follows or ("reference" in arguments) == tracks, name


def test_all_faults_of_a_file_are_told_at_once_by_line(refused):
    lines = refused(
        model="model: {name: quadroto}",
        graph="graph: {edges: [[0, 1], [1, 1], [1, 3]], agents: 4}",
        formation="formation: {offsets: {1: [1, 0, .nan]}}",
        follower="follower: {feedforward: rely}",
        simulation="simulation:\n  horizon: 60\n  dt: 0\nseed: 1",
    )
    assert lines == [
        f"s.yaml:2: model.name: got `quadroto`, allowed are {listing(MODELS)} (did you mean"
        " `quadrotor`?).",
        "s.yaml:3: graph.edges.1: got `[1, 1]`, allowed is an edge between two different agents.",
        "s.yaml:4: formation.offsets.1.2: got `.nan`, allowed is a number from -1e+75 to 1e+75.",
        "s.yaml:7: follower.feedforward: got `rely`, allowed are `none`, `relay`,"
        " `relay-velocity`, `parent` (did you mean `relay`?).",
        "s.yaml:11: simulation.dt: got `0`, allowed is a number above 0.",
        "s.yaml:14: seed: got this key twice, the first is at s.yaml:12.",
    ]
    # An edge that cannot be read leaves the number of agents open, so offsets are not blamed.
    [line] = refused(graph="graph: {edges: [[0, 1], [1, 2], [1, x]]}")
    assert line.startswith("s.yaml:3: graph.edges.2.1: got `x`")


def test_the_error_carries_its_faults(load):
    with pytest.raises(ScenarioError) as caught:
        load(seed="seed: -1", name="name: 3")
    assert caught.value.faults == (
        ScenarioFault("s.yaml:1", "name", f"got `3`, allowed is {FOLDER_NAME}."),
        ScenarioFault("s.yaml:11", "seed", "got `-1`, allowed is a number of at least 0."),
    )
    assert str(caught.value) == "\n".join(map(str, caught.value.faults))
    assert caught.value.exit_code == 2


def test_overrides_meet_the_same_rules_and_come_last(refused):
    assert refused("simulation.dt=0", "graph.edges.1=[1, 1]", "graph.agents=4", name="name: 3") == [
        f"s.yaml:1: name: got `3`, allowed is {FOLDER_NAME}.",
        "--set graph.edges.1=[1, 1]: got `[1, 1]`, allowed is an edge between two"
        " different agents.",
        "--set simulation.dt=0: got `0`, allowed is a number above 0.",
    ]


def test_overrides_are_part_of_the_text_that_is_kept(load):
    scenario = load("seed=7", "formation.offsets.3=[0, 1, 0]", "seed=8")
    assert scenario.seed == 8 and scenario.formation.offsets[3] == (0.0, 1.0, 0.0)
    assert scenario.place("formation", "offsets", 3, 1) == "--set formation.offsets.3=[0, 1, 0]"
    assert scenario.place("formation", "offsets", 2) == "s.yaml:4"
    again = scenario_from_mapping(read_yaml(scenario.text, "kept").data)
    assert again.model_dump() == scenario.model_dump()


@pytest.fixture
def fault_of(tmp_path):
    """The error of a file with this content."""

    def loader(content):
        file = tmp_path / "s.yaml"
        file.write_bytes(content if isinstance(content, bytes) else content.encode())
        with pytest.raises(ScenarioError) as caught:
            load_scenario(file)
        return caught.value

    return loader


def test_a_file_that_is_no_mapping_is_refused(fault_of, tmp_path):
    for text, got in (("- 1\n", "`[1]`"), ("just text", '`"just text"`'), ("3", "`3`")):
        assert str(fault_of(text)) == (
            f"{tmp_path / 's.yaml'}:1: got {got}, allowed is a mapping with the keys `name`,"
            " `model`, `agents`, `plant`, `graph`, `formation`, `reference`, `leader`, `follower`,"
            " `safety`, `initial`, `disturbance`, `actuator`, `sensing`, `network`, `parts`,"
            " `events`, `leadership`, `simulation`, `report`, `live`, `seed`."
        )


def test_a_file_that_is_no_text_or_empty_is_refused(fault_of, tmp_path):
    said = str(fault_of(b"name: \xff"))
    assert said.startswith(f"{tmp_path}/s.yaml: this file cannot be read as UTF-8 text: ")
    lines = str(fault_of("# nothing yet\n")).splitlines()
    assert lines == [
        f"{tmp_path}/s.yaml:1: {key}: got nothing, this key{more} is required."
        for key in ("name", "graph", "simulation", "model")
        for more in (" or `agents`" if key == "model" else "",)
    ]


def test_a_byte_order_mark_and_windows_lines_are_read(tmp_path):
    file = tmp_path / "s.yaml"
    file.write_bytes(b"\xef\xbb\xbf" + "\r\n".join(LINES.values()).encode())
    assert load_scenario(file).place("seed") == f"{file}:11"


def test_a_scenario_without_its_ending_is_named(tmp_path):
    (tmp_path / "blimps.yaml").touch()
    for ending in ("", ".yml"):
        with pytest.raises(ScenarioError) as caught:
            load_scenario(tmp_path / f"blimps{ending}")
        assert str(caught.value).endswith(f" (did you mean `{tmp_path / 'blimps.yaml'}`?).")


def test_a_mapping_is_checked_like_a_file():
    data = read_yaml("\n".join(LINES.values()), "s.yaml").data
    given = data | {
        "formation": {"offsets": {1: (1, 0, 0), np.int64(2): np.array([1, 0.8, 0])}},
        "seed": np.int64(3),
    }
    scenario = scenario_from_mapping(given, folder="here")
    assert scenario.formation.offsets == {1: (1.0, 0.0, 0.0), 2: (1.0, 0.8, 0.0)}
    assert (scenario.seed, scenario.folder, scenario.place("seed")) == (3, Path("here"), "mapping")
    with pytest.raises(ScenarioError) as caught:
        scenario_from_mapping(given | {"seed": -1})
    assert str(caught.value) == "mapping: seed: got `-1`, allowed is a number of at least 0."


MEANT = {
    "radio={delay: 1}": "`network`",
    "graph.delay=1": "`network.delay` or `sensing.delay`",
    "disturbance.loss=0.1": "`network.loss`",
    "network.latency=1": "`network.delay`",
    "graph.offsets={}": "`formation.offsets`",
    "wind=1": "`disturbance`",
    "formation.shape=line": "`formation.name`",
    "shape=line": "`formation.name`",
    "graph.edge=[[0, 1]]": "`edges`",
    "graph.links=[[0, 1]]": "`graph.edges`",
    "follower.control=consensus": "`follower.law`",
    "simulation.duration=1": "`simulation.horizon`",
    "simulation.hroizon=1": "`horizon`",
}


def test_a_key_of_another_section_is_named():
    for change, meant in MEANT.items():
        with pytest.raises(ScenarioError, match=re.escape(f"(did you mean {meant}?).")):
            load_scenario("paper", [change])
    assert set(key_paths._COMMON_NAMES) <= set(key_meanings())


@pytest.mark.parametrize("name", bundled_scenarios())
def test_bundled_scenarios_load_introduce_themselves_and_fit_the_schema(name):
    scenario, summary, schema = load_scenario(name), bundled_scenarios()[name], json_schema()
    assert scenario.name == name and scenario.folder == FOLDER / "bundled"
    assert scenario.place("name").startswith(f"{name}.yaml:")
    assert summary.endswith(".") and len(summary) < 100
    data = read_yaml(scenario.text, name).data
    assert conforms(data, schema, schema)
    for wrong in (
        {"sed": 0},
        {"simulation": {"horizon": 1}},
        {"graph": {"edges": [[0]]}},
        {"model": {"name": "quadroto"}},
    ):
        assert not conforms(data | wrong, schema, schema)


def test_the_bundled_scenarios_are_the_promised_ones():
    names = ["paper", "paper-line", "paper-fast", "paper-literal"]
    paper, line, fast, literal = map(load_scenario, names)
    given = read_yaml("\n".join(LINES.values()), "s.yaml").data
    assert paper.model_dump() == scenario_from_mapping(given).model_dump()
    same = {"model", "formation", "reference", "initial", "seed"}
    for other in (line, fast):
        assert other.model_dump(include=same) == paper.model_dump(include=same)
    assert line.graph.edges == ((0, 1, 1.0), (1, 2, 1.0), (2, 3, 1.0))
    assert fast.leader.gain == fast.follower.gain
    assert np.diag(fast.follower.gain.Q).tolist() == [12] * 3 + [0.8] * 3 + [2.5] * 3 + [0.03] * 3
    assert np.diag(fast.follower.gain.R).tolist() == [0.04, 0.001, 0.001, 0.005]
    assert (literal.follower.gain.P, literal.follower.gain.coupling) == ("identity", 1.0)
    assert literal.follower.feedforward == "none" and not literal.follower.trim
    assert (literal.model.name, literal.simulation.integrator) == ("quadrotor-printed", "printed")
    assert (literal.graph, literal.formation) == (paper.graph, paper.formation)


def test_the_shipped_schema_is_the_one_of_the_code_and_describes_every_key():
    shipped = json.loads((FOLDER / "scenario.schema.json").read_text("utf-8"))
    assert shipped == json_schema(), "write json_schema() to scenario.schema.json"
    fields = [field for part in shipped["$defs"].values() for field in part["properties"].items()]
    assert [key for key, field in fields if "description" not in field] == []


KINDS = {
    "object": dict,
    "array": list,
    "string": str,
    "boolean": bool,
    "integer": int,
    "number": int | float,
    "null": None.__class__,
}


def is_kind(value, name):
    return isinstance(value, KINDS[name]) and (name == "boolean" or not isinstance(value, bool))


def conforms(value, schema, whole):
    """Tell whether a value conforms to a JSON schema, for the keywords that ours uses."""
    if "$ref" in schema:
        return conforms(value, whole["$defs"][schema["$ref"].rpartition("/")[2]], whole)
    kinds = schema.get("type", [])
    kinds = [kinds] if isinstance(kinds, str) else kinds
    checks = [
        not kinds or any(is_kind(value, kind) for kind in kinds),
        value in schema.get("enum", [value]) and value == schema.get("const", value),
        "pattern" not in schema or bool(re.search(schema["pattern"], value)),
    ]
    for keyword, wanted in (("anyOf", any), ("oneOf", lambda found: sum(found) == 1)):
        if keyword in schema:
            checks.append(wanted([conforms(value, one, whole) for one in schema[keyword]]))
    return all(checks) and contents_conform(value, schema, whole)


def contents_conform(value, schema, whole):
    if isinstance(value, dict):
        fields, other = schema.get("properties", {}), schema.get("additionalProperties", {})
        missing = set(schema.get("required", [])) - {*map(str, value)}
        parts = [(item, fields.get(str(key), other)) for key, item in value.items()]
    elif isinstance(value, list):
        first, rest = schema.get("prefixItems", []), schema.get("items", {})
        missing = len(value) < schema.get("minItems", 0)
        parts = itertools.zip_longest(value, first[: len(value)], fillvalue=rest)
    elif is_kind(value, "number"):
        above = value > schema.get("exclusiveMinimum", -float("inf"))
        return above and value >= schema.get("minimum", value)
    else:
        return True
    return not missing and all(
        one is True or one is not False and conforms(item, one, whole) for item, one in parts
    )


def test_a_named_set_of_parameters_may_be_changed(load):
    model = "model={name: quadrotor, parameters: {set: crazyflie-2.1+, mass: 0.03}}"
    made = echelon.build(load(model)).parts.model
    assert (made.mass, made.motor_thrust) == (0.03, 0.12)
    for name, parameters, said in (
        ("quadrotor", "set: crazyfly", "the parameters of `Quadrotor` are `crazyfly`"),
        ("quadrotor", "set: [1]", "the parameters of `Quadrotor` are `[1]`"),
        ("quadrotor", "set: crazyflie, weight: 1", "got the parameter `weight` of `quadrotor`"),
        ("pendulum", "set: small", "got the parameter set `small`, but `pendulum` has none"),
    ):
        with pytest.raises(EchelonError, match=re.escape(said)):
            echelon.build(load(f"model={{name: {name}, parameters: {{{parameters}}}}}"))


def test_a_misspelt_key_of_a_value_that_may_be_a_section_is_told_at_its_place(refused):
    follower = "follower={law: stopping-point, observer: {x: 1}}"
    text = "\n".join(refused(follower, "leader={law: stopping-point}"))
    assert "follower.observer.x: got an unknown key, allowed are `push`, `scale`" in text
    # Text of several lines is told in one.
    with pytest.raises(EchelonError, match="is 'a.nb', and must be a whole number"):
        DoubleIntegrator("a\nb")
