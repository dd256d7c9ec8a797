"""Structure of the code: imports between packages, sizes, kinds of classes, loaded modules."""

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
from collections import Counter
from functools import cache
from pathlib import Path
from typing import Any

from echelon.apps.cli.fly_command import CONTAINED
from echelon.experiments.scenario import registry
from echelon.experiments.scenario.named_class import resolve

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "src" / "echelon"
LIBRARIES = {path.name: path for path in (ROOT / "packages").glob("*/src/echelon_*")}

HEAVY = ["jax", "equinox", "scipy", "networkx", "cvxpy", "casadi", "matplotlib", "xarray"]

FILES = sorted(PACKAGE.rglob("*.py"))


def module_of(path: Path) -> str:
    """The module's name relative to echelon: `models.model`, `models` for its `__init__`.

    Those of other packages are absolute: `echelon_flight.wire`.
    """
    homes = [PACKAGE, *(library.parent for library in LIBRARIES.values())]
    [base] = [home for home in homes if path.is_relative_to(home)]
    parts = path.relative_to(base).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


INNER = [path for library in LIBRARIES.values() for path in library.rglob("*.py")]
PATHS = {module_of(path): path for path in [*FILES, *INNER]}


def package_of(module: str) -> str:
    """The package that holds a module: `echelon`, or a library of its own."""
    first = module.split(".")[0]
    return first if first in LIBRARIES else "echelon"


@cache
def tree(module: str) -> ast.Module:
    return ast.parse(PATHS[module].read_text("utf-8"), str(PATHS[module]))


def is_folder(module: str) -> bool:
    return PATHS[module].name == "__init__.py"


def statements(node: ast.AST):
    """Yield the import statements that can run, those inside functions included."""
    # Those under TYPE_CHECKING are for annotations alone.
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test):
            for other in child.orelse:
                yield from statements(ast.Module([other], []))
        elif isinstance(child, ast.Import | ast.ImportFrom):
            yield child
        else:
            yield from statements(child)


def origin(module: str, node: ast.ImportFrom) -> str:
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
    """The module of `PATHS` that an absolute name is or belongs to, if any."""
    if name.split(".")[0] in LIBRARIES:
        return name if name in PATHS else inside(name.rpartition(".")[0])
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


@cache
def mentions(module: str) -> set[str]:
    """The modules of echelon that a module imports at all, for annotations alone too."""
    nodes = [n for n in ast.walk(tree(module)) if isinstance(n, ast.Import | ast.ImportFrom)]
    found = {inside(name) for node in nodes for name in targets(module, node)}
    return {target for target in found if target is not None} - {module}


def loads(module: str) -> set[str]:
    """What a module imports, and the `__init__` of other folders, which Python runs on the way."""
    folders = {target.rpartition(".")[0] for target in imports(module)}
    own = module if is_folder(module) else module.rpartition(".")[0]
    return set(imports(module)) | (folders - {own, ""})


def functions() -> list[tuple[str, int]]:
    """Every function with its number of lines, docstring aside."""
    found = []
    for module, path in PATHS.items():
        for node in ast.walk(tree(module)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                text = node.body[0] if ast.get_docstring(node) is not None else None
                size = node.end_lineno - node.lineno + 1
                size -= text.end_lineno - text.lineno + 1 if text else 0
                found.append((f"{path.relative_to(ROOT)}:{node.lineno} {node.name}", size))
    return found


def imported(package: str = "echelon") -> set[tuple[str, str]]:
    """Each module of echelon, or of another package, with each absolute name that it may load."""
    return {
        (module, name)
        for module in PATHS
        if package_of(module) == package
        for node in statements(tree(module))
        for name in targets(module, node)
    }


@cache
def classes() -> list[type]:
    names = [m if package_of(m) == m.split(".")[0] else f"echelon.{m}".rstrip(".") for m in PATHS]
    members = [vars(importlib.import_module(name)) for name in names]
    found = [value for values in members for value in values.values() if inspect.isclass(value)]
    own = ("echelon", *LIBRARIES)
    return list({cls: None for cls in found if cls.__module__.split(".")[0] in own})


def is_abstract(cls: type) -> bool:
    """Abstract by a method, by a field, by saying so, or as a protocol."""
    return (
        inspect.isabstract(cls)
        or any(getattr(cls, name, None) for name in ("__abstractvars__", "__abstractclassvars__"))
        or any(base.__name__ in ("ABC", "Protocol", "Enum") for base in cls.__bases__)
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


def test_packages_keep_their_import_contracts():
    """The contracts are in pyproject.toml; `lint-imports` reads every import."""
    command = [sys.executable, "-c", "from importlinter.cli import lint_imports_command as c; c()"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=120)
    assert done.returncode == 0, done.stdout


def test_no_import_cycle_not_even_among_imports_for_annotations():
    for edges in (loads, mentions):
        sorter = graphlib.TopologicalSorter({module: edges(module) for module in PATHS})
        assert set(sorter.static_order()) == set(PATHS)


def test_no_import_goes_up_not_even_for_annotations():
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["importlinter"]
    [layers] = [c["layers"] for c in contracts["contracts"] if c.get("containers") == ["echelon"]]
    rank = {layer: -number for number, layer in enumerate(layers)}
    edges = [(module, target) for module in PATHS for target in mentions(module)]
    ranks = [(rank.get(module.split(".")[0]), rank.get(t.split(".")[0])) for module, t in edges]
    up = [e for e, (a, b) in zip(edges, ranks, strict=True) if None not in (a, b) and a < b]
    assert len(rank) > 8 and not up


def test_flight_needs_the_standard_library_alone():
    """Import contracts name libraries; here all others count too, but for those of links."""
    flight = imported("echelon_flight")
    pairs = {(m.rpartition(".")[2], name.split(".")[0]) for m, name in flight}
    own = {"echelon_flight", *sys.stdlib_module_names}
    found = {each for each in pairs if each[1] not in own}
    dds = {(module, "cyclonedds") for module in ("ros2", "ros2_messages")}
    assert found == {("crazyflie", "cflib"), ("px4", "pymavlink"), *dds}


def test_echelon_knows_few_names_of_flight_and_its_version():
    flight = importlib.import_module("echelon_flight")
    names = {name for _, name in imported() if package_of(name) == flight.__name__}
    found = {name.removeprefix(f"{flight.__name__}.") for name in names}
    assert found == {
        *("FlightError", "__version__"),
        *("mission.check_options", "page_server.Handler", "parameters.DEFAULTS"),
        *("flight_log.LogFile", "flight_log.Tick", "flight_log.find_logs", "flight_log.read_log"),
        "supervisor.Fault",
    }
    assert flight.__version__ == CONTAINED


def test_ranges_need_jax_and_numpy_alone_and_echelon_uses_their_border():
    ranges = importlib.import_module("echelon_ranges")
    needed = {name.split(".")[0] for _, name in imported(ranges.__name__)}
    assert needed - {ranges.__name__, *sys.stdlib_module_names} == {"jax", "numpy"}
    names = {name for _, name in imported() if package_of(name) == ranges.__name__}
    border = {f"{ranges.__name__}.{name}" for name in ranges.__all__}
    assert border == {name for name in names if not name.startswith(f"{ranges.__name__}.jaxpr.")}
    assert len(border) <= 13 and len(names - border) <= 13


def test_folders_are_layers_and_packages_and_the_top_holds_the_entry_points_alone():
    assert max(len(path.relative_to(PACKAGE).parts) for path in FILES) <= 3
    depths = [
        len(path.relative_to(home).parts)
        for home in LIBRARIES.values()
        for path in INNER
        if path.is_relative_to(home)
    ]
    assert max(depths) <= 2
    files = {path.name for path in PACKAGE.iterdir() if path.is_file()}
    assert files == {"__init__.py", "__init__.pyi", "__main__.py", "py.typed"}


def test_the_names_of_files_and_classes_are_unique():
    names = Counter(
        (package_of(module), name)
        for module in PATHS
        for name in [
            PATHS[module].stem,
            *(node.name for node in ast.walk(tree(module)) if isinstance(node, ast.ClassDef)),
        ]
        if not name.startswith("__")
    )
    assert [name for name, count in names.items() if count > 1] == []


def test_functions_are_short():
    sizes = sorted(size for _, size in functions())
    assert not [name for name, size in functions() if size > 56]
    assert statistics.median(sizes) <= 6
    # A number, since a share would grow with every one-line helper that is inlined.
    assert sum(size > 22 for size in sizes) <= 247


IDEAL = (
    "echelon.simulation.step.",
    "echelon.agents.network.inbox",
    "echelon.simulation.engine.agent",
    "echelon.laws.law",
    "echelon.agents.part",
)


def is_final(cls):
    return cls.__dict__.get("__final__", False)


def test_every_class_is_abstract_or_final():
    faults = {
        f"{cls.__module__}.{cls.__name__} inherits from {base.__name__}, which is concrete"
        for cls in classes()
        for base in cls.__bases__
        if base in classes()
        and not issubclass(base, BaseException)
        and not is_abstract(base)
        # Members of a component of the step extend its ideal member, as does what one agent has.
        and not (base.__module__.startswith(IDEAL) and not is_final(base))
    }
    assert not faults, "\n".join(sorted(faults))


def test_only_the_tables_and_the_verifier_name_laws_and_methods():
    """So that a new one needs its class, its entry in the registry and its keys, and no more."""
    tables = ("experiments.scenario.registry", "experiments.scenario.sections")
    names = {*registry.METHODS, *registry.FOLLOWER_LAWS, *registry.LEADER_LAWS}
    # These words have another meaning: a number of a run, and a column of the paper's table.
    others = {("tracking", ""), ("consensus", "results.table_two")}
    found = {
        (node.value, module)
        for module in PATHS
        if module not in tables and not module.startswith("guarantees.verifier")
        for node in ast.walk(tree(module))
        if isinstance(node, ast.Constant) and node.value in names
        if not any(node.value == word and part in module for word, part in others)
    }
    # A method says its own name, which gain files hold.
    methods = map(resolve, registry.METHODS.values())
    assert found == {(each.name, each.__module__.removeprefix("echelon.")) for each in methods}


def test_numbers_of_guarantees_are_rounded_by_the_three_functions_for_it():
    """`core/digits.py` has them; a format such as `:.3g` may state more than is known."""
    faults = [
        module
        for module, path in PATHS.items()
        if module.startswith(("guarantees.", "experiments.studies."))
        if re.search(r":\.\d[efg]\}", path.read_text("utf-8"))
    ]
    assert faults == ["experiments.studies.doctor"]


EVERY_NAME = "import echelon\nfor name in echelon.__all__: getattr(echelon, name)\n"
HELP = """import sys
from echelon.apps.cli.app import main
sys.argv = ["echelon", "--help"]
try:
    main()
except SystemExit as end:
    assert not end.code, end.code"""
UNLOADED = {
    "import echelon": {*HEAVY},
    "from echelon.experiments.scenario import registry, scenario, yaml": {"jax"},
    EVERY_NAME: {"cvxpy", "casadi"},
    HELP: {"jax", "equinox", "scipy", "matplotlib", "xarray"},
}
"""Code, and the libraries that it does not load."""


def test_what_needs_no_heavy_library_loads_none():
    faults = {code: loaded_after(code) & names for code, names in UNLOADED.items()}
    assert faults == dict.fromkeys(UNLOADED, set())


def test_echelon_leaves_the_precision_of_jax_alone():
    code = f"import jax\n{EVERY_NAME}print(jax.config.jax_enable_x64)"
    assert fresh(code).split() == ["False"]


def test_every_public_name_is_there_and_listed():
    echelon = importlib.import_module("echelon")
    assert [name for name in echelon.__all__ if not hasattr(echelon, name)] == []
    assert set(echelon.__all__) <= set(dir(echelon))
    assert not hasattr(echelon, "no_such_name")


def test_every_dependency_is_pinned_imported_or_has_its_reason():
    text = (ROOT / "constraints.txt").read_text("utf-8")
    extras = project()["optional-dependencies"]
    required = {
        plain(name) for name in itertools.chain(project()["dependencies"], *extras.values())
    }
    pinned = {plain(line) for line in text.splitlines() if "==" in line}
    assert required - pinned == {project()["name"]}
    assert "://" not in text and "\n-" not in text
    optional = (
        *("bags", "certify", "cluster", "control", "crazyflie", "fast"),
        *("optimal", "parquet", "px4", "ros2", "video"),
    )
    names = [*project()["dependencies"], *itertools.chain(*(extras[name] for name in optional))]
    used = {name.split(".")[0] for _, name in imported() | imported("echelon_flight")}
    # What pandas writes Parquet with.
    required = {re.match(r"[\w-]+", name)[0].replace("-", "_") for name in names}
    assert required - used == {"pyarrow"}
    # What shows notebooks is a program of its own.
    assert set(extras) == {*optional, "notebook", "all", "dev"}


def test_every_advice_to_install_names_this_distribution():
    """echelon is installed from its clone: the distribution is on no index."""
    files = [*FILES, ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")]
    advice = re.compile(r"pip install (?:-\S+ )*['\"]?([\w.-]+)(?:\[([\w,-]+)\])?")
    named = {found for path in files for found in advice.findall(path.read_text("utf-8"))}
    extras, declared = {extra for _, extra in named if extra}, project()["optional-dependencies"]
    assert {name for name, _ in named} == {"."}
    assert extras and extras <= set(declared)
    # Whoever reads how to install sees every extra.
    start = (ROOT / "docs" / "start.md").read_text("utf-8")
    assert all(f"`{extra}`" in start for extra in {*declared} - {"dev"})
    everything = f"{project()['name']}[certify,cluster,fast,optimal]"
    assert everything in project()["optional-dependencies"]["all"]


def test_the_version_is_the_same_everywhere():
    version, citation = project()["version"], (ROOT / "CITATION.cff").read_text("utf-8")
    assert importlib.import_module("echelon").__version__ == version
    assert f"\nversion: {version}\n" in citation
    # Every page of the documentation shows it.
    assert f"site_name: echelon {version} #" in (ROOT / "mkdocs.yml").read_text("utf-8")


def project() -> dict[str, Any]:
    return tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]


def plain(requirement: str) -> str:
    return re.sub(r"[-_.]+", "-", re.match(r"[\w.-]+", requirement)[0]).lower()


def test_the_table_of_mutate_names_packages_and_tests_that_exist():
    code = ast.parse((ROOT / "benchmarks" / "mutate.py").read_text("utf-8"))
    named = {node.targets[0].id: node.value for node in code.body if isinstance(node, ast.Assign)}
    found = [path for name in ("tests", "packages") for path in (ROOT / name).rglob("test_*.py")]
    tests = {path.stem.removeprefix("test_") for path in found}
    for place, names in ast.literal_eval(named["TESTS"]).items():
        assert (PACKAGE / place).exists() or (ROOT / place).exists(), place
        assert set(names) <= tests, place


def test_set_up_names_no_host():
    """Packages come from where the user's own pip, npm and apt are set to look."""
    files = [*ROOT.glob("*.*"), *(ROOT / ".ci").iterdir(), *(ROOT / "web").glob("*.*")]
    files += [*(ROOT / ".github").rglob("*.*"), *(ROOT / "packages").glob("*/*.toml")]
    texts = {path.name: path.read_text("utf-8") for path in files if path.is_file()}
    texts.pop("CHANGELOG.md")  # links to conventions
    assert [name for name, text in texts.items() if "://" in text] == []


def test_dev_needs_the_standard_library_alone_and_refuses_a_verb_it_does_not_have():
    nodes = statements(ast.parse((ROOT / "dev.py").read_text("utf-8")))
    names = {name.split(".")[0] for node in nodes for name in targets("", node)}
    assert names <= sys.stdlib_module_names
    command = [sys.executable, str(ROOT / "dev.py"), "dmeo"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert done.stderr.startswith("dev.py: `dmeo` is not a command.")
