"""Change the code in small ways, one at a time, and report the changes that no test notices.

Run `python3 dev.py mutate verifier` for a package, `verifier/algebra.py` for a file, nothing for
all packages of the table below. The tree is copied, and each change is tried in a process of its
own that forks after the heavy libraries are loaded and before echelon is. A first run without a
change records which functions each test calls; a change is tried on the tests that call its
function, the quickest first, and if it survives, on all tests of its package. A change after which
the tests exceed `LIMIT` counts as noticed.

It prints every change that survived, with file and line, and how many were killed. See
docs/testing.md for how to read that.
"""

import argparse
import ast
import collections
import copy
import os
import pickle
import random
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
# The tests of a package, or of a file that has tests of its own.
TESTS = {
    "core": ["linearization", "lyapunov", "bad_input", "limits", "gains", "doctor"],
    "packages/ranges/src/echelon_ranges": [
        "interval",
        "hull",
        "taylor",
        "jaxpr",
        "exact",
        "regional",
    ],
    "packages/ranges/src/echelon_ranges/interval.py": ["interval", "hull"],
    "agents/network": ["graph", "formation", "limits"],
    "synthesis/certificates": ["exact", "regional", "lmi", "lyapunov", "margins", "gains"],
    "synthesis/certificates/exact_proofs.py": ["exact"],
    "synthesis/certificates/jacobians.py": ["regional", "exact"],
    "synthesis/gains": ["gains", "gain_rules", "inner_loop", "regional", "paper", "sentences"],
    "laws": ["laws", "feedforward", "inner_loop", "sentences", "paper", "attack", "prepared"],
    "laws/safety.py": ["safety"],
    "laws/safety_check.py": ["safety"],
    "laws/path_leader.py": ["lqr", "prepared", "laws", "feedforward", "paper"],
    "simulation/step": ["simulate", "feedforward", "disturbance", "metrics"],
    "simulation/engine": ["simulate", "metrics", "plans", "agent", "gradient", "native", "traffic"],
    "simulation/engine/agent.py": ["agent", "bad_input"],
    "simulation/engine/batch.py": ["native", "channel", "sweep"],
    "simulation/engine/gradient.py": ["gradient"],
    "simulation/engine/jax_stepper.py": ["simulate", "sweep"],
    "simulation/engine/law_drive.py": ["simulate", "prepared", "bad_input", "sentences"],
    "simulation/engine/prepare.py": ["simulate", "bad_input", "sentences", "part_warnings"],
    "simulation/engine/record.py": ["simulate", "chart", "plans"],
    "simulation/engine/traffic.py": ["traffic"],
    "simulation/native": ["native"],
    "simulation/codegen": ["codegen", "native"],
    "simulation/optimal/drives.py": ["mpc"],
    "guarantees/messages": ["late_messages", "late_promises"],
    "guarantees/promises": ["promises", "check", "frozen_laws", "heading"],
    "guarantees/stopping": ["stopping_point", "borders", "motors", "separation"],
    "guarantees/stopping/separation.py": ["separation"],
    "guarantees/verifier": ["verify", "false_claims"],
}
LIMIT = 4.0, 30.0
"""How many times as long the tests may take after a change, and how many seconds longer."""
HEAVY = ["jax.numpy", "equinox", "scipy.linalg", "scipy.optimize", "networkx", "hypothesis.extra"]
HEAVY += ["hypothesis.extra.numpy", "xarray", "cvxpy", "yaml", "beartype", "jaxtyping", "pytest"]

COMPARED = {ast.Lt: [ast.LtE, ast.GtE], ast.LtE: [ast.Lt, ast.Gt], ast.Gt: [ast.GtE, ast.LtE]}
COMPARED |= {ast.GtE: [ast.Gt, ast.Lt], ast.Eq: [ast.NotEq], ast.NotEq: [ast.Eq]}
COMPARED |= {ast.Is: [ast.IsNot], ast.IsNot: [ast.Is], ast.In: [ast.NotIn], ast.NotIn: [ast.In]}
COMPUTED = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult}
COMPUTED |= {ast.Pow: ast.Mult, ast.FloorDiv: ast.Mult, ast.Mod: ast.Add, ast.BitAnd: ast.BitOr}
COMPUTED |= {ast.BitOr: ast.BitAnd}
NAMES = {"min": "max", "any": "all", "minimum": "maximum", "ceil": "floor", "argmin": "argmax"}
NAMES |= {"lower": "upper", "floor": "ceil", "nextafter": "maximum", "zeros": "ones"}
NAMES |= {there: here for here, there in NAMES.items() if here not in ("floor", "nextafter")}


class Change(NamedTuple):
    """A change of one file: where, the old text and the new, and the file with it."""

    file: Path
    line: int
    function: str
    old: str
    new: str
    source: str


# ---- what can be changed ----


def variants(node: ast.AST) -> Iterator[ast.AST]:
    """Yield what may stand in a node's place."""
    if isinstance(node, ast.Compare):
        for k, op in enumerate(node.ops):
            for other in COMPARED[type(op)]:
                ops = node.ops[:k] + [other()] + node.ops[k + 1 :]
                yield ast.Compare(node.left, ops, node.comparators)
    elif isinstance(node, ast.BinOp | ast.AugAssign) and type(node.op) in COMPUTED:
        other = copy.copy(node)
        other.op = COMPUTED[type(node.op)]()
        yield other
    elif isinstance(node, ast.BoolOp):
        yield ast.BoolOp(ast.Or() if isinstance(node.op, ast.And) else ast.And(), node.values)
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.Not):
        yield node.operand
    elif isinstance(node, ast.Constant):
        yield from map(ast.Constant, constants(node.value))
    elif isinstance(node, ast.Call):
        yield from calls(node)
    elif isinstance(node, ast.If | ast.While | ast.IfExp):
        other = copy.copy(node)
        other.test = ast.UnaryOp(ast.Not(), node.test)
        yield other
    if isinstance(node, ast.Return) and getattr(node.value, "value", node.value) is not None:
        yield ast.Return(ast.Constant(None))
    if is_droppable(node):
        yield ast.Pass()


def constants(value: object) -> list[object]:
    """Return other values of a constant; texts are for people."""
    if isinstance(value, bool):
        return [not value]
    if isinstance(value, int):
        return [value + 1]
    # A tolerance is changed by what would matter, a factor by little.
    if isinstance(value, float):
        return [1.0 if value == 0.0 else 10.0 * value if abs(value) < 1e-2 else 1.25 * value]
    return []


def calls(node: ast.Call) -> Iterator[ast.AST]:
    """Yield a call of the opposite function, or the argument that is no longer made positive."""
    function = node.func
    name = getattr(function, "attr", getattr(function, "id", ""))
    if name in NAMES:
        other = copy.copy(function)
        setattr(other, "attr" if isinstance(function, ast.Attribute) else "id", NAMES[name])
        yield ast.Call(other, node.args, node.keywords)
    if name in ("abs", "sorted", "sqrt") and node.args:
        yield node.args[0]


def is_droppable(node: ast.AST) -> bool:
    """Tell whether a statement can be left out without a name going missing."""
    if isinstance(node, ast.Expr):
        return not isinstance(node.value, ast.Constant)
    if isinstance(node, ast.Assign):
        return all(isinstance(target, ast.Subscript | ast.Attribute) for target in node.targets)
    return isinstance(node, ast.AugAssign | ast.Raise | ast.Continue | ast.Break)


Put = Callable[[ast.AST], None]
"""What puts another node in a node's place."""


def places(node: ast.AST, function: str = "") -> Iterator[tuple[ast.AST, Put, str]]:
    """Yield every node that runs and is no message, what replaces it, and its function."""
    for field, value in ast.iter_fields(node):
        if field in ("annotation", "returns", "decorator_list", "bases"):
            continue
        puts = partial(setattr, node, field)
        each = enumerate(value) if isinstance(value, list) else [(None, value)]
        for index, child in each:
            if not isinstance(child, ast.AST) or isinstance(child, ast.JoinedStr):
                continue
            yield child, puts if index is None else partial(value.__setitem__, index), function
            name = child.name if isinstance(child, ast.FunctionDef | ast.ClassDef) else ""
            inner = ".".join(filter(None, (function, name)))
            # What an error says is compared where it matters; `strict` only finds our own faults.
            if not isinstance(child, ast.Raise) and getattr(child, "arg", "") != "strict":
                yield from places(child, inner)


def changes(file: Path) -> Iterator[Change]:
    """Yield every change of a file."""
    tree = ast.parse(file.read_text("utf-8"))
    for node, put, function in list(places(tree)):
        for other in variants(node):
            put(ast.copy_location(other, node))
            source = ast.unparse(ast.fix_missing_locations(tree))
            put(node)
            old, new = (ast.unparse(each).splitlines()[0][:70] for each in (node, other))
            yield Change(file, getattr(node, "lineno", 0), function, old, new, source)


# ---- trying one ----


class Watch:
    """A pytest plugin that records which functions of the package each test calls."""

    def __init__(self, package: str) -> None:
        self.package, self.calls, self.seconds = package, collections.defaultdict(set), {}
        self.of_module = collections.defaultdict(set)

    def collector(self, into: set[str]) -> Callable[..., None]:
        """Return what `sys.setprofile` takes."""

        def called(frame: object, event: str, argument: object) -> None:
            code = frame.f_code
            if event == "call" and code.co_filename.startswith(self.package):
                into.add(f"{code.co_filename}:{code.co_qualname.replace('<locals>.', '')}")

        return called

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        """Begin to record."""
        sys.setprofile(self.collector(self.calls[nodeid]))

    def pytest_fixture_setup(self, fixturedef: object, request: object) -> None:
        """Record apart what is shared by the tests of a file."""
        if fixturedef.scope != "function":
            sys.setprofile(self.collector(self.of_module[request.node.nodeid.split("::")[0]]))

    def pytest_runtest_call(self, item: object) -> None:
        """Go on with what the test itself calls."""
        sys.setprofile(self.collector(self.calls[item.nodeid]))

    def pytest_runtest_logreport(self, report: object) -> None:
        """Add up seconds."""
        sys.setprofile(None)
        self.seconds[report.nodeid] = self.seconds.get(report.nodeid, 0.0) + report.duration

    def calling(self, file: Path, function: str) -> list[str]:
        """Return the tests that call a function, the quickest first."""
        name = f"{file}:{function}"
        shared = {module for module, called in self.of_module.items() if name in called}
        found = [t for t in self.seconds if name in self.calls[t] or t.split("::")[0] in shared]
        return sorted(found, key=self.seconds.__getitem__)


def forked(
    tests: list[str], limit: float, watch: Watch | None = None, out: Path | None = None
) -> int:
    """Run tests in a fork of this process and return how it ended: 0 where all passed."""
    child = os.fork()
    if child:
        return os.waitpid(child, 0)[1]
    signal.alarm(int(limit) + 1)
    silent = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silent, 1), os.dup2(silent, 2)
    code = 70
    try:
        import pytest

        options = ["-x", "-q", "-p", "no:xdist", "-p", "no:cacheprovider", "-p", "no:randomly"]
        code = int(pytest.main([*options, *tests], plugins=[watch] if watch else []))
        if watch and out:
            sys.setprofile(None)
            out.write_bytes(pickle.dumps((watch.calls, watch.of_module, watch.seconds)))
    finally:
        os._exit(code)


def write(file: Path, source: bytes) -> None:
    """Replace a file, and forget what was compiled of it: its time may be that of the old one."""
    file.write_bytes(source)
    for compiled in (file.parent / "__pycache__").glob(f"{file.stem}.*"):
        compiled.unlink()


def listed_for(package: str, file: str, paths: dict[str, str]) -> list[str]:
    """Return the paths of the tests of a file: its own ones, or those of its package."""
    listed = TESTS.get(f"{package}/{file}", TESTS[package])
    return [paths[f"test_{name}"] for name in listed]


def study(tree: Path, package: str, only: str, count: int, seed: int) -> tuple[int, list[Change]]:
    """Try changes of a package; return how many were killed, and those that survived."""
    home = tree if package.startswith("packages/") else tree / "src" / "echelon"
    files = sorted((home / package).glob(only or "*.py"))
    every = [change for file in files for change in changes(file)]
    drawn = random.Random(seed).sample(every, min(count, len(every)))
    paths = {path.stem: str(path.relative_to(tree)) for path in tree.glob("**/test_*.py")}
    tests_of = {file: listed_for(package, file.name, paths) for file in files}
    tests = sorted({test for change in drawn for test in tests_of[change.file]})
    watch, recorded, begun = Watch(str(home)), tree / "calls", time.monotonic()
    if forked(tests, 3600.0, watch, recorded):
        raise SystemExit(f"the tests of `{package}` fail without any change: {' '.join(tests)}")
    watch.calls, watch.of_module, watch.seconds = pickle.loads(recorded.read_bytes())
    whole = time.monotonic() - begun
    print(
        f"{package}: {len(drawn)} of {len(every)} changes; all tests take {whole:.0f} s", flush=True
    )
    survived = []
    for k, change in enumerate(sorted(drawn, key=lambda each: (each.file, each.line)), 1):
        some = watch.calling(change.file, change.function)
        own = tests_of[change.file]
        rest = [t for t in watch.seconds if t not in some and t.split("::")[0] in own]
        original = change.file.read_bytes()
        write(change.file, change.source.encode())
        # First those that are likely to notice, then all, since what is kept is called once only.
        limits = (LIMIT[0] * sum(map(watch.seconds.get, each)) + LIMIT[1] for each in (some, rest))
        parts = zip((some, rest), limits, strict=True)
        killed = any(each and forked(each, limit) for each, limit in parts)
        write(change.file, original)
        name = f"{change.file.relative_to(tree)}:{change.line}"
        word = "killed  " if killed else "SURVIVED"
        print(f"{k:4d} {word} {name}: {change.old}  ->  {change.new}", flush=True)
        survived += [] if killed else [change]
    return len(drawn) - len(survived), survived


def parted(name: str) -> tuple[str, str]:
    """Return the package and the file of a name; the last part of a package's name is enough."""
    package, _, file = name.rpartition("/") if name.endswith(".py") else (name, "", "")
    return next((full for full in TESTS if full.split("/")[-1] == package), package), file


def main() -> None:
    """Copy the tree, load what is heavy, and try."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("package", nargs="*", help=f"of {', '.join(TESTS)}; or PACKAGE/FILE.py")
    parser.add_argument("--count", type=int, default=50, help="changes of each package (50)")
    parser.add_argument("--seed", type=int, default=0, help="which ones are drawn (0)")
    arguments = parser.parse_args()
    everything = [name for name in TESTS if not name.endswith(".py")]
    packages = [parted(name) for name in arguments.package or everything]
    unknown = [package for package, _ in packages if package not in TESTS]
    if unknown:
        parser.error(f"`{unknown[0]}` has no tests listed; there are {', '.join(TESTS)}")
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder).resolve() / "echelon"
        shutil.copytree(
            ROOT, tree, ignore=shutil.ignore_patterns(".*", "__pycache__", "site", "build")
        )
        os.chdir(tree)
        # A test's own processes look here too; with `CI`, hypothesis draws the same every time.
        sources = [str(tree / "src"), *map(str, (tree / "packages").glob("*/src"))]
        os.environ |= {"PYTHONPATH": os.pathsep.join(sources), "CI": "1"}
        os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        os.environ["JAX_COMPILATION_CACHE_DIR"] = str(tree / "compiled")
        os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
        sys.path[:0] = sources
        for name in HEAVY:
            __import__(name)
        killed, survived = 0, []
        for package, only in packages:
            some, left = study(tree, package, only, arguments.count, arguments.seed)
            killed, survived = killed + some, survived + left
        print(f"\n{killed} killed, {len(survived)} survived (seed {arguments.seed})")
        for change in survived:
            print(f"{change.file.relative_to(tree)}:{change.line}: {change.old}  ->  {change.new}")


if __name__ == "__main__":
    main()
