"""The scenario file: loads and checks it, and reports its faults.

All faults of a file are reported at once, a line each: `file:line: field: got ..., allowed ...`.
"""

import copy
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, NoReturn, TypeAlias, final

from pydantic import Field, PrivateAttr, ValidationError
from pydantic_core import ErrorDetails

from echelon.core.errors import ScenarioError, did_you_mean, is_number, listing
from echelon.core.gone import VALUES, gone, gone_key
from echelon.core.limits import LARGEST
from echelon.experiments.scenario import registry, sections
from echelon.experiments.scenario.key_paths import key_paths, meant, sections_in
from echelon.experiments.scenario.values import (
    Finding,
    FolderName,
    Section,
    Seed,
    either,
    foreign_keys,
)
from echelon.experiments.scenario.yaml import (
    Document,
    KeyPath,
    ScenarioFault,
    apply_overrides,
    dump_yaml,
    inline_yaml,
    is_or_are,
    joined,
    part_at,
    plain,
    quoted,
    read_yaml,
    rename_files,
)

_BUNDLED = Path(__file__).parent / "bundled"
SCENARIO_FILE = "scenario.yaml"
"""The name of the scenario in the folder of a run."""


@final
class Scenario(Section, **either("model", "agents")):
    """One experiment, checked and with its defaults; `load_scenario` returns one."""

    name: FolderName
    """Name of its folder."""
    one_of: ClassVar = ("model", "agents")
    model: sections.ModelSpec | None = None
    agents: Annotated[tuple[sections.GroupSpec, ...] | None, Field(strict=False)] = None
    """Groups of unlike agents in place of `model`, as in `[{count: 1, model: double-integrator},
    {count: 3, model: quadrotor}]`; the law is `stopping-point`."""
    plant: sections.PlantSpec | None = None
    graph: sections.GraphSpec
    formation: sections.FormationSpec = Field(default_factory=sections.FormationSpec)
    reference: sections.ReferenceSpec | None = None
    leader: sections.LeaderSpec = Field(default_factory=sections.LeaderSpec)
    follower: sections.FollowerSpec = Field(default_factory=sections.FollowerSpec)
    safety: sections.SafetySpec | None = None
    initial: sections.InitialSpec = Field(default_factory=sections.InitialSpec)
    disturbance: sections.DisturbanceSpec | None = None
    actuator: sections.ActuatorSpec | None = None
    sensing: sections.SensingSpec | None = None
    network: sections.NetworkSpec | None = None
    parts: Annotated[tuple[sections.UserClass, ...], Field(strict=False)] = ()
    """Parts of the world of your own, as in `[{python: "slow.py:SlowSensor", every: 3}]`."""
    events: Annotated[tuple[sections.EventSpec, ...], Field(strict=False)] = ()
    """What happens during the run, as in `[{at: 8.0, lose: 3}, {at: 12.0, join: 3}]`: agents are
    lost or join, and links are cut, as in `[{at: 8.0, cut: [1, 2], for: 3.0}]`."""
    leadership: sections.LeadershipSpec | None = None
    simulation: sections.SimulationSpec
    report: sections.ReportSpec = Field(default_factory=sections.ReportSpec)
    live: Annotated[tuple[sections.LiveSpec, ...], Field(strict=False)] = ()
    """Changes made during `echelon live`, which repeats them; no other command can."""
    seed: Seed = 0
    """Seed of everything random in the run."""

    _document: Document = PrivateAttr(Document({}, {(): "scenario"}))
    _text: str = PrivateAttr("")
    _file: Path = PrivateAttr(Path())

    def faults(self) -> Iterator[Finding]:
        """Yield a leader's law that lacks its reference, and a reference that it does not take."""
        yield from super().faults()
        law, reference = self.leader.law, self.reference
        entry = registry.LEADER_LAWS.get(law) if isinstance(law, str) else None
        if entry is not None and entry.reference == "needed" and reference is None:
            yield ("leader", "law"), f"got `{law}` without a `reference`, this law needs one."
        if entry is not None and entry.reference == "none" and reference is not None:
            message = f"got a reference, but the leader's law `{law}` takes none"
            yield ("reference",), f"{message}; {listing(registry.TRACKING_LAWS)} take one."

    @property
    def text(self) -> str:
        """The effective YAML, overrides included."""
        return self._text

    @property
    def data(self) -> dict[Any, Any]:
        """The same as plain data; do not modify it."""
        return self._document.data

    @property
    def folder(self) -> Path:
        """The folder to which the paths in the file are relative."""
        return self._file.parent

    @property
    def file(self) -> Path:
        """The file that it was read from; of a mapping, a file that does not exist."""
        return self._file

    def with_(self, *changes: str, **values: Any) -> "Scenario":
        """Return the scenario with changed keys, as `--set` changes them.

        Args:
            *changes: texts such as `simulation.horizon=10`.
            **values: values by key, such as `seed=3`, or `simulation__horizon=10` with two
                underscores for the dot.

        Raises:
            ScenarioError: the changed scenario has faults, as in `load_scenario`.
        """
        named = (
            f"{key.replace('__', '.')}={inline_yaml(plain(value))}" for key, value in values.items()
        )
        try:
            return with_overrides(self, [*changes, *named])
        except ScenarioError as error:
            # `--set` is an option of commands.
            raise ScenarioError(re.sub("^--set ", "", str(error), flags=re.MULTILINE)) from None

    def place(self, *path: str | int) -> str:
        """Return the place of a key, as in `paper.yaml:4`; else its parent's."""
        return self._document.place(path)


_ALLOWED = {
    "float_type": "is a number",
    "int_type": "is a whole number",
    "bool_type": "is `true` or `false`",
    "string_type": "is text",
    "dict_type": "is a mapping",
    "model_type": "is a mapping",
    "tuple_type": "is a list",
    "greater_than": "is a number above {gt:g}",
    "greater_than_equal": "is a number of at least {ge:g}",
    "less_than": "is a number below {lt}",
    "less_than_equal": "is a number of at most {le:g}",
    "too_short": "is a list of at least {min_length} number",
    "too_long": "is a list of {max_length} numbers",
}


def _section(path: KeyPath) -> type[Section] | None:
    part: Any = Scenario
    for key in path:
        # The place in a list of sections has the keys of any other.
        if isinstance(key, str):
            fields = {field.alias or name: field for name, field in part.model_fields.items()}
            part = next(sections_in(fields[key].annotation), None) if key in fields else None
        if part is None:
            return None
    return part


def _keys(path: KeyPath) -> list[str]:
    part = _section(path)
    return [] if part is None else [f.alias or key for key, f in part.model_fields.items()]


def _describe(error: ErrorDetails) -> tuple[KeyPath, str]:
    # Of a value that may also be a section, the path has the name of the section's class.
    path = tuple(k for k in error["loc"] if sections.ObserverSpec.__name__ not in str(k))
    kind, context = error["type"], error.get("ctx", {})
    if path and path[-1] == "[key]":
        kind = "the number of an agent" if kind == "int_type" else "a name"
        return path[:-1], f"got the key {quoted(path[-2])}, allowed is {kind}."
    if kind == "missing":
        return path, "got nothing, this key is required."
    if kind in ("extra_forbidden", "invalid_key"):
        if ended := gone_key(*path):
            return path, f"the key{ended}"
        keys = _keys(path[:-1])
        hint = meant(path, keys, Scenario)
        return path, f"got an unknown key, allowed {is_or_are(keys)}{hint}."
    if kind == "fault":
        return path, context["text"]
    got = context.get("got", error["input"])
    if path and (ended := gone(VALUES, f"{path[-1]}: {got}")):
        return path, f"the value `{got}`{ended}"
    allowed = _ALLOWED[kind].format(**context) if kind in _ALLOWED else error["msg"]
    close = did_you_mean(got, context.get("names", "").split()) or _like_key(path)
    return path, f"got {quoted(got)}, allowed {allowed}{close}."


def _like_key(path: KeyPath) -> str:
    """Return what a key that its section does not name, but its class may take, may mean."""
    keys = _keys(path[:-1])
    if not path or path[-1] in keys:
        return ""
    return did_you_mean(path[-1], keys).replace("mean ", "mean the key ")


def _with_defaults(data: Mapping[Any, Any]) -> dict[Any, Any]:
    """Return the data with the defaults that depend on another section, without empty sections."""
    filled = {key: value for key, value in data.items() if value is not None}
    leader, report = filled.get("leader", {}), filled.get("report", {})
    if isinstance(leader, dict):
        follower = part_at(data, ("follower", "law")) or registry.DEFAULT_FOLLOWER_LAW
        law = registry.default_leader_law(follower, "reference" in filled)
        filled["leader"] = {"law": law, **leader}
    horizon = part_at(data, ("simulation", "horizon"))
    if isinstance(report, dict) and is_number(horizon) and 0.0 < horizon <= LARGEST:
        window = report.get("steady_window", horizon)
        # A window as long as the run would count its transient as steady.
        if is_number(window) and window >= horizon:
            filled["report"] = {**report, "steady_window": horizon / 5}
    return filled


def _too_large(value: object, path: KeyPath = ()) -> Iterator[Finding]:
    if isinstance(value, dict | list):
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _too_large(item, (*path, key))
    elif is_number(value) and not abs(value) <= LARGEST:
        yield path, f"got {quoted(value)}, allowed is a number from -{LARGEST:g} to {LARGEST:g}."


def _by_line(fault: ScenarioFault) -> tuple[bool, int]:
    """Return a sort key: the line, with faults of the command line last."""
    line = fault.place.rpartition(":")[2]
    overridden = fault.place.startswith("--set ")
    return overridden, int(line) if line.isdigit() and not overridden else 0


def refuse(faults: Iterable[ScenarioFault]) -> NoReturn:
    """Raise all faults as one error, a line each in the order of the file.

    Raises:
        ScenarioError: always; its `faults` are the single ones.
    """
    ordered = sorted(faults, key=_by_line)
    error = ScenarioError("\n".join(map(str, ordered)))
    setattr(error, "faults", tuple(ordered))
    raise error


def _scenario(document: Document, text: str, file: Path) -> Scenario:
    data = {} if document.data is None else document.data
    if not isinstance(data, dict):
        text = f"got {quoted(data)}, allowed is a mapping with the keys {listing(_keys(()))}."
        refuse([ScenarioFault(document.place(()), "", text)])
    document = document._replace(data=data)
    scenario, errors = None, list[ErrorDetails]()
    try:
        scenario = Scenario.model_validate(_with_defaults(data))
    except ValidationError as error:
        errors = error.errors(include_url=False)
    # One for each path.
    sentences: dict[KeyPath, str] = {}
    for path, sentence in (*_too_large(data), *map(_describe, errors)):
        sentences.setdefault(path, sentence)
    if sentences and () not in sentences and not {*Scenario.one_of} & {*data}:
        # Sections are looked at as a whole only where their keys are without fault.
        sentences["model",] = "got nothing, this key or `agents` is required."
    faults = [ScenarioFault(document.place(path), joined(path), s) for path, s in sentences.items()]
    if scenario is None or faults or document.faults:
        refuse([*document.faults, *faults])
    scenario._document, scenario._text, scenario._file = document, text, file
    return scenario


def bundled_scenarios() -> dict[str, str]:
    """Return the names of the bundled scenarios, each with its summary."""
    names = sorted(file.stem for file in _BUNDLED.glob("*.yaml"))
    texts = {name: (_BUNDLED / f"{name}.yaml").read_text("utf-8") for name in names}
    return {name: text.partition("\n")[0].lstrip("# ") for name, text in texts.items()}


def _locate(source: str | Path) -> tuple[Path, str]:
    names = list(bundled_scenarios())
    if str(source) in names:
        return _BUNDLED / f"{source}.yaml", f"{source}.yaml"
    # The folder of a run contains its scenario.
    file = Path(source) / SCENARIO_FILE if Path(source).is_dir() else Path(source)
    if file.is_file():
        return file, str(file)
    what = "no such file exists"
    if file != Path(source):
        what = f"it is a folder without `{SCENARIO_FILE}`"
    allowed = f"allowed is a file, the folder of a run or a bundled scenario: {listing(names)}"
    beside = [x for x in map(file.with_suffix, (".yaml", ".yml")) if x.is_file()]
    close = f" (did you mean `{beside[0]}`?)" if beside else did_you_mean(file.stem, names)
    raise ScenarioError(f"got the scenario `{source}`, {what}, {allowed}{close}.")


def load_scenario(source: str | Path, overrides: Sequence[str] = ()) -> Scenario:
    """Read and check a scenario.

    Args:
        source: Path to a YAML file, the folder of a run, or the name of a bundled scenario (which
            wins over a file).
        overrides: Texts such as `simulation.horizon=10` that replace keys of the file before it is
            checked. A path among them is relative to the working folder, one in the file to the
            file.

    Raises:
        ScenarioError: There is no such scenario, or it has faults: one line for each of them; the
            error's `faults` are the same as `ScenarioFault` records.
    """
    file, name = _locate(source)
    try:
        # Some editors write a byte order mark, which does not belong to the first key.
        text = file.read_text("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise ScenarioError(f"{name}: this file cannot be read as UTF-8 text: {error}.") from error
    document = read_yaml(text, name)
    if overrides:
        document = _settled(apply_overrides(document, overrides))
        text = dump_yaml(document.data)
    return _scenario(document, text, file)


def _settled(document: Document) -> Document:
    """A path on the command line is relative to the working folder, and becomes absolute."""
    # The document that was read is not changed.
    data = copy.deepcopy(document.data)
    set_ = [path for path, _ in document.overrides]
    for path in set_:
        rename_files(data, lambda name: str(Path(name).resolve()), path)
        part = part_at(data, path[:-1])
        for rival in _rivals(path, part):
            other = (*path[:-1], rival)
            # Two overrides that exclude each other are refused by the checks.
            if not any(path[: len(other)] == other for path in set_):
                del part[rival]
    return document._replace(data=data)


def _rivals(path: KeyPath, part: Any) -> list[Any]:
    """Return the keys of the same section that the one at `path` excludes."""
    section, key = _section(path[:-1]), path[-1]
    if section is None or not isinstance(part, dict) or part.get(key) is None:
        return []
    if key == "law":
        law = part[key]
        known = isinstance(law, str) and law in {*registry.FOLLOWER_LAWS, *registry.LEADER_LAWS}
        return [other for other in foreign_keys(section, law) if other in part] if known else []
    if key not in section.one_of:
        return []
    excluded = {*section.one_of}
    if key == "file":
        # It contains what the other keys would say, and arguments of a class of the user.
        names = {field.alias or name for name, field in section.model_fields.items()}
        excluded |= {*foreign_keys(section, key)} | ({*part} - names)
    return [other for other in part if other in excluded and other != key]


def scenario_from_text(text: str, file: Path) -> Scenario:
    """Check a scenario given as YAML; paths in it are relative to the folder of `file`.

    Raises:
        ScenarioError: It has faults, as in `load_scenario`.
    """
    return _scenario(read_yaml(text, str(file)), text, file)


def with_overrides(scenario: Scenario, overrides: Sequence[str]) -> Scenario:
    """Return a scenario in which texts such as `simulation.horizon=10` replace keys.

    Raises:
        ScenarioError: It has faults, as in `load_scenario`.
    """
    document = _settled(apply_overrides(scenario._document, overrides))
    return _scenario(document, dump_yaml(document.data), scenario.file)


def scenario_from_mapping(data: Mapping[str, Any], folder: str | Path = ".") -> Scenario:
    """Check a scenario given as a mapping, with the keys of the file.

    Args:
        data: The scenario; tuples and NumPy arrays count as lists.
        folder: The folder to which paths are relative.

    Raises:
        ScenarioError: The scenario has faults, as in `load_scenario`.
    """
    data = plain(data)
    return _scenario(Document(data, {(): "mapping"}), dump_yaml(data), Path(folder) / "mapping")


ScenarioLike: TypeAlias = Scenario | str | Path | Mapping[str, Any]
"""A scenario, its name, its file, the folder of a run, or a mapping with the keys of the file."""


def as_scenario(source: ScenarioLike) -> Scenario:
    """Return a scenario, loaded if it is given by its name, its file or its keys.

    Raises:
        ScenarioError: it is none of these, or has faults, as in `load_scenario`.
    """
    if isinstance(source, Scenario):
        return source
    if isinstance(source, Mapping):
        return scenario_from_mapping(source)
    if isinstance(source, str | Path):
        return load_scenario(source)
    raise ScenarioError(
        f"the scenario is {source!r}, and must be a `Scenario`, a name, a file, or a mapping."
    )


def json_schema() -> dict[str, Any]:
    """Return the JSON schema of the scenario file, for checks and completion in editors."""
    draft = {"$schema": "https://json-schema.org/draft/2020-12/schema"}
    return draft | Scenario.model_json_schema()


def key_label(path: str) -> tuple[str, str]:
    """Return a key in a few words, and its unit; the last parts of its path if it has no text."""
    for place, text, unit in key_paths(Scenario):
        words = re.split(r"[;,.:]", text)[0].strip()
        if place == path and words:
            return words[0].lower() + words[1:], "" if unit == "1" else unit
    return " ".join(path.split(".")[-2:]).replace("_", " "), ""


def key_meanings() -> dict[str, str]:
    """Return what every key of the file means, by its path, such as `network.delay`."""
    return {place: text for place, text, _ in key_paths(Scenario)}
