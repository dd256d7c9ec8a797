"""The scenario file: how it is read, and how its faults are told.

Every fault of a file is reported at once, a line each: `file:line: field: what was got, what is
allowed`.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NoReturn, final, get_args

from pydantic import BaseModel, Field, PrivateAttr, ValidationError
from pydantic_core import ErrorDetails

from echelon.core.errors import ScenarioError, did_you_mean, listing
from echelon.experiments.scenario import law_sections, sections
from echelon.experiments.scenario.checks import cross_faults, law_of, number_of, section
from echelon.experiments.scenario.override import settle_overrides
from echelon.experiments.scenario.values import STRICT, FolderName, Seed
from echelon.experiments.scenario.yaml import (
    Document,
    Fault,
    KeyPath,
    apply_overrides,
    are,
    dump_yaml,
    joined,
    read_yaml,
    shown,
)

_BUNDLED = Path(__file__).parent / "bundled"
KEPT = "scenario.yaml"
"""The name of the scenario in the folder of a run."""


@final
class Scenario(BaseModel, **STRICT):
    """One experiment, checked and with its defaults filled in; made by `load_scenario`."""

    name: FolderName
    """Name of its folder."""
    model: sections.ModelSpec
    plant: sections.PlantSpec | None = None
    graph: sections.GraphSpec
    formation: sections.FormationSpec = Field(default_factory=sections.FormationSpec)
    reference: sections.ReferenceSpec | None = None
    leader: law_sections.LeaderSpec = Field(default_factory=law_sections.LeaderSpec)
    follower: law_sections.FollowerSpec = Field(default_factory=law_sections.FollowerSpec)
    initial: sections.InitialSpec = Field(default_factory=sections.InitialSpec)
    disturbance: sections.DisturbanceSpec | None = None
    simulation: sections.SimulationSpec
    report: sections.ReportSpec = Field(default_factory=sections.ReportSpec)
    live: Annotated[tuple[sections.LiveSpec, ...], Field(strict=False)] = ()
    """What `echelon live` does at its time, as it saved what a person did; no other command can."""
    seed: Seed = 0
    """Seed of everything random in the run."""

    _document: Document = PrivateAttr(Document({}, {(): "scenario"}))
    _text: str = PrivateAttr("")
    _file: Path = PrivateAttr(Path())

    @property
    def text(self) -> str:
        """The effective YAML, overrides included."""
        return self._text

    @property
    def data(self) -> dict[Any, Any]:
        """The same as plain data; not to be changed."""
        return self._document.data

    @property
    def folder(self) -> Path:
        """The folder to which the paths in the file are relative."""
        return self._file.parent

    @property
    def file(self) -> Path:
        """The file that it was read from; one that is not there for a mapping."""
        return self._file

    def place(self, *path: str | int) -> str:
        """Return where a key stands, as in `paper.yaml:4`; else its parent's place."""
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
    "greater_than_equal": "is a number from {ge:g} on",
    "less_than": "is a number below {lt}",
    "too_short": "is a list of at least {min_length} number",
}


def _keys(path: KeyPath) -> list[str]:
    """Return the keys that the section at `path` takes."""
    part: type[BaseModel] = Scenario
    for key in path:
        annotation = part.model_fields[str(key)].annotation
        kinds = (annotation, *get_args(annotation))
        part = next(k for k in kinds if isinstance(k, type) and issubclass(k, BaseModel))
    return list(part.model_fields)


def _describe(error: ErrorDetails) -> tuple[KeyPath, str]:
    """Return the path of a fault that the schema found, and its sentence."""
    path, kind, context = error["loc"], error["type"], error.get("ctx", {})
    if path and path[-1] == "[key]":
        kind = "a whole number, an agent's" if kind == "int_type" else "a name"
        return path[:-1], f"got the key {shown(path[-2])}, allowed is {kind}."
    if kind == "missing":
        return path, "got nothing, this key is required."
    if kind in ("extra_forbidden", "invalid_key"):
        keys = _keys(path[:-1])
        return path, f"got an unknown key, allowed {are(keys)}{did_you_mean(path[-1], keys)}."
    got = context.get("got", error["input"])
    allowed = _ALLOWED[kind].format(**context) if kind in _ALLOWED else error["msg"]
    close = did_you_mean(got, context.get("names", "").split())
    return path, f"got {shown(got)}, allowed {allowed}{close}."


def _filled(data: Mapping[Any, Any]) -> dict[Any, Any]:
    """Return the data with the defaults that hang on another section; an empty section is none."""
    filled = {key: value for key, value in data.items() if value is not None}
    leader, report = filled.get("leader", {}), filled.get("report", {})
    if isinstance(leader, dict):
        filled["leader"] = {**leader, "law": law_of(filled, "leader")}
    horizon = number_of(section(data, "simulation").get("horizon")) or 0.0
    window = number_of(section(data, "report").get("steady_window", math.inf))
    # A window as long as the run would count its transient as steady.
    if isinstance(report, dict) and window is not None and window >= horizon > 0:
        filled["report"] = {**report, "steady_window": horizon / 5}
    return filled


def _validated(data: Mapping[Any, Any]) -> tuple[Scenario | None, list[tuple[KeyPath, str]]]:
    """Return the scenario, or the faults that the schema finds."""
    try:
        return Scenario.model_validate(_filled(data)), []
    except ValidationError as error:
        return None, list(map(_describe, error.errors(include_url=False)))


def _by_line(fault: Fault) -> tuple[bool, int]:
    """Sort by line, what the command line set last."""
    line = fault.place.rpartition(":")[2]
    overridden = fault.place.startswith("--set ")
    return overridden, int(line) if line.isdigit() and not overridden else 0


def refuse(faults: Iterable[Fault]) -> NoReturn:
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
        said = f"got {shown(data)}, allowed is a mapping with the keys {listing(_keys(()))}."
        refuse([Fault(document.place(()), "", said)])
    document = document._replace(data=data)
    scenario, refused = _validated(data)
    # One for each path: what a check says of it goes before what the schema says.
    found: dict[KeyPath, str] = {}
    for path, said in (*cross_faults(document), *refused):
        found.setdefault(path, said)
    faults = [Fault(document.place(path), joined(path), said) for path, said in found.items()]
    if scenario is None or faults or document.faults:
        refuse([*document.faults, *faults])
    scenario._document, scenario._text, scenario._file = document, text, file
    return scenario


def bundled_scenarios() -> dict[str, str]:
    """Return the bundled scenarios: each name with the line that says what it is."""
    names = sorted(file.stem for file in _BUNDLED.glob("*.yaml"))
    texts = {name: (_BUNDLED / f"{name}.yaml").read_text("utf-8") for name in names}
    return {name: text.partition("\n")[0].lstrip("# ") for name, text in texts.items()}


def _found(source: str | Path) -> tuple[Path, str]:
    """Return the file that `source` means and the name under which messages show it."""
    names = list(bundled_scenarios())
    if str(source) in names:
        return _BUNDLED / f"{source}.yaml", f"{source}.yaml"
    # The folder of a run holds the scenario that was run.
    file = Path(source) / KEPT if Path(source).is_dir() else Path(source)
    if file.is_file():
        return file, str(file)
    what = f"it is a folder without `{KEPT}`" if file != Path(source) else "no such file exists"
    said = f"{what}, allowed is a file, the folder of a run or a bundled scenario: {listing(names)}"
    close = did_you_mean(Path(source).stem, names)
    raise ScenarioError(f"got the scenario `{source}`, {said}{close}.")


def load_scenario(source: str | Path, overrides: Sequence[str] = ()) -> Scenario:
    """Read and check a scenario.

    Args:
        source: Path to a YAML file, the folder of a run, or the name of a bundled scenario (which
            wins over a file).
        overrides: Texts such as `simulation.horizon=10`, laid over the file before it is checked.
            A path among them is relative to the working folder, one in the file to the file.

    Raises:
        ScenarioError: There is no such scenario, or it has faults: one line for each of them, which
            the error's `faults` holds as `Fault` records too.
    """
    file, name = _found(source)
    try:
        # Some editors begin a file with a byte order mark, which is no part of its first key.
        text = file.read_text("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise ScenarioError(f"{name}: this file cannot be read as UTF-8 text: {error}.") from error
    document = read_yaml(text, name)
    if overrides:
        document = settle_overrides(apply_overrides(document, overrides))
        text = dump_yaml(document.data)
    return _scenario(document, text, file)


def varied(scenario: Scenario, overrides: Sequence[str]) -> Scenario:
    """Return a scenario with texts such as `simulation.horizon=10` laid over it.

    Raises:
        ScenarioError: It has faults, as in `load_scenario`.
    """
    document = settle_overrides(apply_overrides(scenario._document, overrides))
    return _scenario(document, dump_yaml(document.data), scenario.file)


def _plain(value: object) -> object:
    """Return lists for tuples and arrays, and Python's own numbers for NumPy's."""
    to_list: Callable[[], object] | None = getattr(value, "tolist", None)
    value = value if to_list is None else to_list()
    if isinstance(value, Mapping):
        return {_plain(key): _plain(item) for key, item in value.items()}
    return list(map(_plain, value)) if isinstance(value, list | tuple) else value


def scenario_from_mapping(data: Mapping[str, Any], folder: str | Path = ".") -> Scenario:
    """Check a scenario given as a mapping, with the keys of the file.

    Args:
        data: The scenario; tuples and NumPy arrays stand for lists.
        folder: The folder to which `model.python` is relative.

    Raises:
        ScenarioError: The scenario has faults, as in `load_scenario`.
    """
    plain = _plain(data)
    return _scenario(Document(plain, {(): "mapping"}), dump_yaml(plain), Path(folder) / "mapping")


def json_schema() -> dict[str, Any]:
    """Return the JSON schema of the scenario file, which editors can check and complete with."""
    draft = {"$schema": "https://json-schema.org/draft/2020-12/schema"}
    return draft | Scenario.model_json_schema()
