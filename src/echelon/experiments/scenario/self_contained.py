"""A scenario together with all files that it names, so that its folder repeats the run."""

import copy
import hashlib
from pathlib import Path
from typing import Any

from echelon.core.files import INPUTS
from echelon.experiments.scenario.scenario import Scenario
from echelon.experiments.scenario.yaml import dump_yaml, named_files, rename_files


def self_contained(scenario: Scenario, place: str = INPUTS) -> tuple[str, dict[str, Path]]:
    """Return the YAML in which every named file is in the folder `place` next to it.

    The second value maps each name there to the file to copy. The text of a scenario that names no
    file is unchanged, comments included.
    """
    data = copy.deepcopy(scenario.data)
    files: dict[str, Path] = {}

    def copied(file: str) -> str:
        source = (scenario.folder / file).resolve()
        name = _free(f"{place}/{source.name}", source, files)
        files[name] = source
        return name

    rename_files(data, copied)
    return (dump_yaml(data) if files else scenario.text), files


def names_files(scenario: Scenario) -> bool:
    """Tell whether a scenario needs files besides its own."""
    return any(True for _ in named_files(scenario.data, ()))


def names_code(scenario: Scenario) -> bool:
    """Tell whether building a scenario executes code that it names."""
    return any(path[-1] == "python" for path, _, _ in named_files(scenario.data, ()))


def without_folders(data: Any) -> Any:
    """Return the data of a scenario in which files are named without their folders."""
    data = copy.deepcopy(data)
    rename_files(data, lambda file: Path(file).name)
    return data


def files_of(scenario: Scenario) -> list[Path]:
    """Return the file of a scenario and all files that it names."""
    return [scenario.file, *self_contained(scenario, "")[1].values()]


def content_of_files(scenario: Scenario) -> str:
    """Return a text that is equal for equal values and equal files that they name."""
    text, files = self_contained(scenario)
    digests = [hashlib.sha256(file.read_bytes()).hexdigest() for file in files.values()]
    return "\n".join([text, *digests])


def _free(name: str, source: Path, taken: dict[str, Path]) -> str:
    """Return a name that is free, such as `inputs/2/gain.json`."""
    folder, _, base = name.rpartition("/")
    count = 1
    while taken.get(name, source) != source:
        count += 1
        name = f"{folder}/{count}/{base}"
    return name
