"""The documentation: its code prints what the page shows; names, links and numbers are right."""

import contextlib
import importlib.util
import io
import json
import operator
import os
import re
import shlex
import shutil
import subprocess
import sys
import types
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import matplotlib
import pytest
from ruamel.yaml import YAML

import echelon as ech
from echelon.apps.cli.app import main
from echelon.experiments.results.table_two import PRINTED
from echelon.experiments.scenario.registry import METHODS

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]


# What is read one after the other, in one folder; all but the first page takes long.
FIRST = ("start", "agents", "graphs", "formations", "promises", "laws", "runs", "datasets")
LONG = [
    ("models", "own_law", "extending"),
    (*FIRST, "ground_robots", "troubleshooting"),
    ("recipes", "sweeps", "comparing"),
    *((name,) for name in ("networks", "events", "learning", "crazyflie", "autopilots")),
    *((name,) for name in ("matlab", "onboard", "at_speed")),
]
JOURNEYS = [
    pytest.param(("README",), id="README"),
    *(pytest.param(pages, marks=pytest.mark.slow, id=pages[0]) for pages in LONG),
]


FENCE = re.compile(
    r"^(?P<mark><!-- (?:not executed|needs (?P<needs>\w+)) -->\s+)?"
    r"^```(?P<language>\w+)(?: title=\"(?P<title>[^\"]+)\")?\n"
    r"(?P<code>.*?)^```$",
    re.MULTILINE | re.DOTALL,
)
LINK = re.compile(r"\]\((?P<target>[^)\s]+)\)")
NUMBER = re.compile(r"(?<![\w.^-])-?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?![\w.]*\w)")


class Block(NamedTuple):
    language: str
    title: str | None
    code: str
    line: int
    executed: bool
    needs: str | None


def page(name):
    return next(path for path in PAGES if path.name == name)


def blocks(path):
    text = path.read_text("utf-8")
    return [
        Block(
            found["language"],
            found["title"],
            found["code"],
            text.count("\n", 0, found.start("code")) + 1,
            found["mark"] is None or bool(found["needs"] and find_spec(found["needs"])),
            found["needs"],
        )
        for found in FENCE.finditer(text)
    ]


def prose(path):
    return FENCE.sub("", path.read_text("utf-8"))


def anchors(path):
    titles = re.findall(r"^#+ (.+)$", prose(path), re.MULTILINE)
    plain = [re.sub(r"[^\w\s-]", "", title.replace("`", "")).strip().lower() for title in titles]
    return {re.sub(r"[-\s]+", "-", title) for title in plain}


def squeezed(text):
    """The lines of a text that say something, with runs of spaces as one."""
    return [" ".join(line.split()) for line in text.splitlines() if line.strip()]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with matplotlib.rc_context({"savefig.dpi": 40}):
        yield tmp_path


class Reader:
    """Someone who types the blocks of pages one after the other."""

    def __init__(self, name, monkeypatch):
        self.name, self.monkeypatch = name, monkeypatch
        self.module = types.ModuleType(f"page_{name}")
        monkeypatch.setitem(sys.modules, self.module.__name__, self.module)
        self.printed, self.code = "", 0

    def types(self, block):
        if block.title:
            Path(block.title).write_text(block.code, "utf-8")
        if block.language == "python":
            self.python(block)
        elif block.language == "console":
            self.console(block)
        elif block.language == "text":
            assert squeezed(self.printed) == squeezed(block.code), self.where(block)

    def where(self, block):
        return f"{self.name}:{block.line}"

    def python(self, block):
        with contextlib.redirect_stdout(io.StringIO()) as out:
            exec(compile(block.code, self.where(block), "exec"), self.module.__dict__)
        self.printed = out.getvalue()

    def console(self, block):
        """Run each command, and find the lines that stand below it in what it prints, in order."""
        printed = iter(())
        for line in squeezed(block.code):
            if line == "$ echo $?":
                printed = iter([str(self.code)])
            elif line.startswith("$ "):
                printed = iter(squeezed(self.command(line[2:])))
            elif line != "...":
                assert line in printed, f"{self.where(block)} does not print: {line}"

    def command(self, line):
        arguments = shlex.split(line)
        assert arguments[0] == "echelon", line
        self.monkeypatch.setattr(sys, "argv", arguments)
        out = io.StringIO()
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out):
            with pytest.raises(SystemExit) as left:
                main()
        self.code = left.value.code or 0
        return out.getvalue()


@pytest.mark.parametrize("names", JOURNEYS)
def test_every_block_runs_and_prints_what_stands_below_it(names, folder, monkeypatch):
    reader = Reader(names[0], monkeypatch)
    for name in names:
        reader.name, done = f"{name}.md", 0
        for block in blocks(page(reader.name)):
            if block.executed:
                reader.types(block)
                done += block.language in ("python", "console")
        assert done, name


PENDULUM = """name: pushed
model: {name: pendulum}
graph: {name: path, agents: 5}
follower: {gain: {method: decay, weight: 2.0}}
simulation: {horizon: 1.0, dt: 0.01}
"""
DESIGNS = """
import contextlib, io, json, sys
from echelon.apps.cli.app import main

said = []
for words in ["--json"], ["--set", "follower.gain.Q=[1, 1]"], ["--set", "follower.gain.wait=1"]:
    sys.argv = ["echelon", "design", "pushed.yaml", *words]
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main()
        except SystemExit as end:
            said.append([end.code or 0, out.getvalue(), err.getvalue()])
json.dump(said, sys.stdout)
"""


@pytest.mark.slow
def test_the_gain_method_of_extending_is_at_home_in_three_places(tmp_path):
    """Its class becomes a file, and what its section adds to two others is added."""
    package = tmp_path / "echelon"
    shutil.copytree(ROOT / "src" / "echelon", package, ignore=shutil.ignore_patterns("__pycache__"))
    section = page("extending.md").read_text("utf-8").partition("## A gain method")[2]
    code = re.search(r"class Decay.*?\n\n\n", section, re.DOTALL)[0]
    head = "import numpy as np\nimport scipy.linalg\n\nimport echelon as ech\n\n\n"
    (package / "synthesis/gains/decay.py").write_text(head + code, "utf-8")
    added = re.findall(r"^ (.+)\n\+(.+)$", section.partition("## A reference")[0], re.MULTILINE)
    scenario = "experiments/scenario"
    files = (
        "synthesis/gains/__init__.py",
        f"{scenario}/registry.py",
        f"{scenario}/sections.py",
    )
    for file, (above, line) in zip(files, added, strict=True):
        text = (package / file).read_text("utf-8")
        assert text.count(f"{above}\n") == 1
        (package / file).write_text(text.replace(above, f"{above}\n{line}"), "utf-8")
    (tmp_path / "pushed.yaml").write_text(PENDULUM)

    path = os.pathsep.join([str(tmp_path), *sys.path])
    given = {"cwd": tmp_path, "env": os.environ | {"PYTHONPATH": path}}
    command = [sys.executable, "-c", DESIGNS]
    done = subprocess.run(command, capture_output=True, text=True, **given)
    assert done.returncode == 0, done.stderr
    (code, designs, _), taken, unknown = json.loads(done.stdout)
    rows = {row["method"]: row for row in json.loads(designs)["methods"]}
    assert code == 0 and {*rows} == {*METHODS, "decay"} - {"given", "printed-lmi"}
    assert (rows["decay"]["coupling"], rows["decay"]["edge"]) == (1.0, 0.0)
    assert rows["decay"]["slowest_mode"] < 0.0
    assert rows["contraction"]["reason"] == (
        "set `follower.gain={method: contraction, domain: {angle: HALF_WIDTH, ...}}` to try it"
    )
    said = "got a key that `decay` does not take, allowed are `coupling`, `weight`.\n"
    assert taken[0] == 2 and taken[2].endswith(f"--set follower.gain.Q=[1, 1]: {said}")
    assert "follower.gain.wait=1: got an unknown key" in unknown[2]
    assert unknown[2].endswith("(did you mean `weight`?).\n")


def test_few_blocks_are_left_out():
    left_out = [
        f"{path.name}:{b.line}"
        for path in PAGES
        for b in blocks(path)
        if not (b.executed or b.needs)
    ]
    assert len(left_out) <= 2, left_out


def test_every_scenario_on_the_pages_is_one(folder):
    """All but `bad.yaml`, whose faults its page shows."""
    seen = 0
    for path in PAGES:
        for block in blocks(path):
            if block.language == "yaml" and re.search("^name:", block.code, re.MULTILINE):
                Path("shown.yaml").write_text(block.code, "utf-8")
                scenario = ech.load_scenario("shown.yaml")
                assert re.search(f"^name: {scenario.name}$", block.code, re.MULTILINE)
                seen += 1
    assert seen >= 3


def test_relative_links_and_images_lead_somewhere():
    dead = []
    for path in PAGES:
        for target in LINK.findall(prose(path)):
            if "://" in target or target.startswith("mailto:"):
                continue
            place, _, anchor = target.partition("#")
            goal = (path.parent / place).resolve() if place else path
            if not goal.exists() or (anchor and anchor not in anchors(goal)):
                dead.append((path.name, target))
    assert dead == []


def test_the_first_page_quotes_the_measured_numbers():
    """Rows that both pages have say the same, and no number stands on the first page alone."""
    text = page("index.md").read_text("utf-8")
    part = text.partition("<!-- numbers -->")[2].partition("<!-- /numbers -->")[0]
    measured = {row[0]: row[1] for row in rows(page("results.md").read_text("utf-8"))}
    quoted = {row[0]: row[1] for row in rows(part) if len(row) == 2 and row[0] != "what"}
    assert len(quoted) >= 5
    assert quoted == {name: measured.get(name) for name in quoted}
    known = numbers("\n".join(" ".join(row) for row in measured.items()))
    known |= {abs(value) for values in PRINTED.values() for value in values}
    cells = "\n".join(" ".join(row[1:]) for row in rows(part) if row[0][:6] in ("leader", "follow"))
    assert numbers(cells) - known - {10.0} == set()  # "over the first 10 s"


def test_measured_numbers_are_of_this_version(tmp_path):
    """The build refuses others: a number that nobody measured again says nothing of this code."""
    spec = importlib.util.spec_from_file_location("dev", ROOT / "dev.py")
    dev = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(dev)
    assert dev.outdated() == []
    for name in dev.MEASURED:
        text = (
            page(name).read_text("utf-8").replace(f"echelon {ech.__version__},", "echelon 0.0.1,")
        )
        (tmp_path / name).write_text(text, "utf-8")
    faults = dev.outdated(tmp_path)
    assert len(faults) == 2 and all("has numbers of echelon 0.0.1, and this" in x for x in faults)
    with pytest.raises(dev.SetupError, match="measures them again"):
        dev.outdated = lambda: faults
        dev.documentation([])


def rows(text):
    lines = (line for line in text.splitlines() if line.startswith("|"))
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def numbers(text):
    return {abs(float(number)) for number in NUMBER.findall(text)}


def test_the_reference_has_every_public_name_once():
    """Those of a family too; beyond them it may have what public functions return."""
    texts = "\n".join(path.read_text("utf-8") for path in (DOCS / "api").glob("*.md"))
    named = re.findall(r"^::: (echelon\.\S+)$", texts, re.MULTILINE)
    shown = [id(operator.attrgetter(name.removeprefix("echelon."))(ech)) for name in named]
    values = {f"echelon.{name}": getattr(ech, name) for name in ech.__all__}
    families = [value for value in values.values() if isinstance(value, types.ModuleType)]
    for family in families:
        values |= {
            f"{family.__name__}.{x}": getattr(family, x) for x in getattr(family, "__all__", [])
        }
    assert len(shown) == len(set(shown))
    listed = re.findall(r"`(\w+)`", page("api.md").read_text("utf-8").partition("| page |")[2])
    assert sorted(listed) == sorted(name.rpartition(".")[2] for name in named)
    missing = [name for name, value in values.items() if id(value) not in shown]
    assert [name for name in missing if not isinstance(values[name], types.ModuleType)] == []


def test_every_page_is_in_the_navigation_and_is_there():
    """The build overlooks a page of the navigation that does not exist."""
    text = (ROOT / "mkdocs.yml").read_text("utf-8")
    entries = re.findall(r"^ +- [^:]+: (\S+\.md)$", text, re.MULTILINE)
    assert sorted(entries) == sorted(str(path.relative_to(DOCS)) for path in PAGES[1:])


def test_what_pages_quote_of_the_readme_has_no_relative_link():
    """It would lead nowhere from one of the two places, which the build overlooks."""
    text, quoted = page("README.md").read_text("utf-8"), 0
    for path in PAGES:
        for name in re.findall(r'--8<-- "README\.md:(\w+)"', path.read_text("utf-8")):
            part = text.partition(f"[start:{name}]")[2].partition(f"[end:{name}]")[0]
            assert part and [t for t in LINK.findall(part) if "://" not in t] == [], name
            quoted += 1
    assert quoted >= 4


def test_every_anchor_of_earlier_documentation_leads_somewhere():
    """Who followed or stored a link to a part finds where it went, in docs/moved.yml."""
    told = YAML(typ="safe").load(DOCS / "moved.yml")
    kept = {f"{name}#{anchor}" for name, names in told["kept"].items() for anchor in names}
    dead = []
    for target in {*kept, *told["moved"].values()}:
        name, _, anchor = target.partition("#")
        goal = DOCS / name
        if not goal.exists() or anchor not in anchors(goal):
            dead.append(target)
    assert dead == []
    assert len(kept) + len(told["moved"]) >= 275
    assert not kept & {*told["moved"]}


def test_the_theory_page_has_every_numbered_statement_of_the_paper():
    text = page("paper.md").read_text("utf-8")
    table = text.partition("## Statements")[2].partition("\n### ")[0]
    last = {"Definition": 3, "Assumption": 6, "Lemma": 4, "Theorem": 3, "Algorithm": 1}
    statements = [(kind, str(k + 1)) for kind, count in last.items() for k in range(count)]
    for kind, number in [*statements, ("Table", "I"), ("Table", "II")]:
        assert re.search(rf"\b{kind}s? (\d, )?{number}\b", table), f"{kind} {number}"


def test_tests_that_pages_name_exist():
    tests = [*(ROOT / "tests").rglob("*.py"), *(ROOT / "packages").rglob("tests/*.py")]
    of_theory = 0
    for one in PAGES:
        named = re.findall(r"`(test_\w+\.py)::(test_\w+)", one.read_text("utf-8"))
        of_theory += len(named) if one.parent.name == "theory" else 0
        for file, name in named:
            [path] = [path for path in tests if path.name == file]
            assert f"def {name}(" in path.read_text("utf-8"), (one.name, name)
    assert of_theory >= 150
