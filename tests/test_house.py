"""The house itself: floors, sizes, kinds of classes, and what an import brings along."""

import ast
import graphlib
import importlib
import inspect
import itertools
import os
import re
import statistics
import subprocess
import sys
import tomllib
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "src" / "echelon"

# Which module stands on which floor, the lowest first: an import goes strictly down. Insert a floor
# where one is needed. Names are relative to echelon; `folder.*` is every module of the folder that
# is not named by itself, its `__init__` included, and the empty name is the package's own
# `__init__`, which loads lazily and so stands on top.
FLOORS = [
    ["_types", "_errors", "_registry", "_paper", "_provenance"],
    ["_yaml", "_numerics", "_drawing", "_hull_enclosure", "_exact", "_jaxpr"],
    ["_verify_file", "_verify_exact"],
    ["_scenario_values", "models.model", "references.reference", "_graph", "_hull_curves"],
    ["_verify_algebra", "_verify_model", "_modes"],
    ["_verify", "_lmi"],
    ["_scenario_checks", "_scenario_parts", "models.rigid_body", "models.rotors", "_hull_algebra"],
    ["_casadi", "_optimal_control"],
    ["_scenario", "models.*", "references.*", "_formation", "_linearization", "_hull_rules"],
    ["_disturbance", "_domain", "_plant", "models.quadrotor_euler", "_hull_trace"],
    ["_margins", "_demand", "_transcription", "_posing", "_horizon"],
    ["_hull", "_infeasible", "_certificates", "_disturbance_bounds"],
    ["_jacobians", "_plan"],
    ["gains.gain", "laws.law", "_planar_baseline", "_formation_plan"],
    ["_initial", "_result", "laws.consensus", "gains.riccati", "gains.regional"],
    ["_arguments", "_loop", "_finite_condition", "_basin", "_solver_figures"] + ["_recommend"],
    ["gains.*"],
    ["laws.*", "_simulate", "_synthesize", "_gain_file"],
    ["_build", "_metrics", "_lyapunov", "_drive"],
    ["_archive", "_check_loop", "_optimization"],
    ["_compare"],
    ["_explain", "_plots", "_check_paper", "_check_margins", "_check_region"]
    + ["_comparison_plots"],
    ["_report", "_doctor", "_tables", "_check", "_design", "_design_plots"],
    ["_output", "_comparison_report"],
    ["cli"],
    ["__main__", ""],
]
HEAVY = ["jax", "equinox", "scipy", "networkx", "cvxpy", "casadi", "matplotlib", "viser", "xarray"]

FILES = sorted(PACKAGE.rglob("*.py"))


def module_of(path: Path) -> str:
    """The module's name relative to echelon: `models.model`, `models` for its `__init__`."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


PATHS = {module_of(path): path for path in FILES}


@cache
def tree(module: str) -> ast.Module:
    return ast.parse(PATHS[module].read_text("utf-8"), str(PATHS[module]))


def is_folder(module: str) -> bool:
    return PATHS[module].name == "__init__.py"


def floor(module: str) -> int:
    """The floor of a module, by its own name or else by its folder's."""
    folder = module if is_folder(module) else module.rpartition(".")[0]
    for name in [module, f"{folder}.*"]:
        for number, names in enumerate(FLOORS):
            if name in names:
                return number
    raise AssertionError(
        f"`{module}` stands on no floor; add it to `FLOORS` in tests/test_house.py, as low as its"
        " imports allow."
    )


def statements(node: ast.AST):
    """Yield the import statements that can run, those inside functions included."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test):
            for other in child.orelse:
                yield from statements(ast.Module([other], []))
        elif isinstance(child, ast.Import | ast.ImportFrom):
            yield child
        else:
            yield from statements(child)


def origin(module: str, node: ast.ImportFrom) -> str:
    """The absolute name of what a `from` statement imports from."""
    if not node.level:
        return node.module or ""
    here = ["echelon", *module.split(".")] if module else ["echelon"]
    package = here if is_folder(module) else here[:-1]
    base = package[: len(package) - node.level + 1]
    return ".".join([*base, node.module] if node.module else base)


def targets(module: str, node: ast.Import | ast.ImportFrom) -> list[str]:
    """The absolute names that an import statement may load: `from a import b` may load `a.b`."""
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    source = origin(module, node)
    return [f"{source}.{alias.name}" for alias in node.names]


def inside(name: str) -> str | None:
    """The module of echelon that an absolute name stands for or lies in, if any."""
    if name.split(".")[0] != "echelon":
        return None
    relative = name.removeprefix("echelon").removeprefix(".")
    return relative if relative in PATHS else inside(name.rpartition(".")[0])


@cache
def imports(module: str) -> dict[str, int]:
    """The modules of echelon that a module imports, each with the line where it does."""
    pairs = [
        (inside(name), node.lineno)
        for node in statements(tree(module))
        for name in targets(module, node)
    ]
    return {target: line for target, line in pairs if target is not None}


def loads(module: str) -> set[str]:
    """What a module imports, and the `__init__` of other folders, which Python runs on the way."""
    folders = {target.rpartition(".")[0] for target in imports(module)}
    own = module if is_folder(module) else module.rpartition(".")[0]
    return set(imports(module)) | (folders - {own, ""})


def own_member(module: str, target: str) -> bool:
    """A family's `__init__` names its members, which stand on its own floor."""
    return is_folder(module) and target.rpartition(".")[0] == module


def functions() -> list[tuple[str, int]]:
    """Every function with its number of lines, docstring aside."""
    return [
        (f"{PATHS[module].relative_to(ROOT)}:{node.lineno} {node.name}", lines(node))
        for module in PATHS
        for node in ast.walk(tree(module))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    ]


def lines(node: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    total = node.end_lineno - node.lineno + 1
    if ast.get_docstring(node) is None:
        return total
    return total - (node.body[0].end_lineno - node.body[0].lineno + 1)


@cache
def classes() -> list[type]:
    """Every class that a module of echelon defines."""
    members = [vars(importlib.import_module(f"echelon.{m}".rstrip("."))) for m in PATHS]
    found = [value for values in members for value in values.values() if inspect.isclass(value)]
    return list({cls: None for cls in found if cls.__module__.split(".")[0] == "echelon"})


def is_abstract(cls: type) -> bool:
    """Abstract by a method, by a field, by saying so, or as a protocol."""
    return (
        inspect.isabstract(cls)
        or any(getattr(cls, name, None) for name in ("__abstractvars__", "__abstractclassvars__"))
        or any(base.__name__ in ("ABC", "Protocol") for base in cls.__bases__)
    )


def fresh(code: str) -> str:
    """What a new Python process prints that runs the code without the settings of this one."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith("JAX_")}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout


def loaded_after(code: str) -> set[str]:
    """Which of the heavy libraries a new process holds after running the code."""
    printed = fresh(f"import sys\n{code}\nprint('loaded:', *sys.modules)")
    names = printed.rpartition("loaded:")[2].split()
    return set(HEAVY) & set(names)


@pytest.mark.parametrize("module", PATHS)
def test_imports_go_strictly_down(module):
    faults = [
        f"{module}:{line} (floor {floor(module)}) imports {target!r} (floor {floor(target)})"
        for target, line in imports(module).items()
        if floor(target) >= floor(module) and not own_member(module, target)
    ]
    assert not faults, "\n".join(faults)


def test_the_table_of_floors_names_only_what_exists_and_names_it_once():
    names = list(itertools.chain.from_iterable(FLOORS))
    gone = [name for name in names if name.removesuffix(".*") not in PATHS and name != "__main__"]
    assert not gone, f"take {gone} out of `FLOORS`"
    assert len(names) == len(set(names))


def test_no_import_cycle():
    sorter = graphlib.TopologicalSorter({module: loads(module) for module in PATHS})
    assert set(sorter.static_order()) == set(PATHS)


def test_folders_are_one_deep():
    assert max(len(path.relative_to(PACKAGE).parts) for path in FILES) <= 2


@pytest.mark.parametrize("module", PATHS)
def test_files_are_short(module):
    assert len(PATHS[module].read_text("utf-8").splitlines()) <= 400


def test_functions_are_short():
    sizes = sorted(size for _, size in functions())
    assert not [name for name, size in functions() if size > 70]
    assert statistics.median(sizes) <= 10
    assert sizes[int(len(sizes) * 0.95)] <= 40


def test_every_class_is_abstract_or_final():
    faults = {
        f"{cls.__module__}.{cls.__name__} inherits from {base.__name__}, which is concrete"
        for cls in classes()
        for base in cls.__bases__
        if base in classes() and not issubclass(base, BaseException) and not is_abstract(base)
    }
    assert not faults, "\n".join(sorted(faults))


def test_importing_echelon_loads_nothing_heavy():
    assert loaded_after("import echelon") == set()


def test_the_texts_and_the_schema_load_no_jax():
    assert "jax" not in loaded_after(
        "import echelon.scenario.registry, echelon.scenario.scenario, echelon.scenario.yaml"
    )


def test_using_the_library_loads_no_optional_part():
    every_name = "import echelon\nfor name in echelon.__all__: getattr(echelon, name)"
    assert not {"cvxpy", "casadi", "viser"} & loaded_after(every_name)


def test_help_loads_no_jax():
    code = "import sys\nfrom echelon.cli.app import main\nsys.argv = ['echelon', '--help']\n"
    call = "try:\n    main()\nexcept SystemExit as end:\n    assert not end.code, end.code"
    assert not {"jax", "equinox", "scipy", "matplotlib", "xarray"} & loaded_after(code + call)


def test_echelon_leaves_the_precision_of_jax_alone():
    code = "import jax, echelon\nfor name in echelon.__all__: getattr(echelon, name)\n"
    assert fresh(code + "print(jax.config.jax_enable_x64)").split() == ["False"]


def test_every_public_name_is_there_and_listed():
    echelon = importlib.import_module("echelon")
    assert [name for name in echelon.__all__ if not hasattr(echelon, name)] == []
    assert set(echelon.__all__) <= set(dir(echelon))
    assert not hasattr(echelon, "no_such_name")


def test_every_dependency_is_pinned_and_no_index_is_named():
    text = (ROOT / "constraints.txt").read_text("utf-8")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    extras = project["optional-dependencies"].values()
    asked = {plain(name) for name in itertools.chain(project["dependencies"], *extras)}
    pinned = {plain(line) for line in text.splitlines() if "==" in line}
    assert asked - pinned == {"echelon"}
    assert "://" not in text and "\n-" not in text


def test_the_version_is_the_same_wherever_it_stands():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    citation = (ROOT / "CITATION.cff").read_text("utf-8")
    assert importlib.import_module("echelon").__version__ == project["version"]
    assert f"\nversion: {project['version']}\n" in citation


def plain(requirement: str) -> str:
    """The name of a requirement as installers compare it."""
    return re.sub(r"[-_.]+", "-", re.match(r"[\w.-]+", requirement)[0]).lower()


def test_dev_needs_the_standard_library_alone():
    nodes = statements(ast.parse((ROOT / "dev.py").read_text("utf-8")))
    names = {name.split(".")[0] for node in nodes for name in targets("", node)}
    assert names <= sys.stdlib_module_names


def test_dev_refuses_a_verb_it_does_not_have():
    command = [sys.executable, str(ROOT / "dev.py"), "dmeo"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert done.stderr.startswith("dev.py: `dmeo` is no verb.")
