"""Settings of every test: no silent broadcasting, checked shapes, repeatable draws, time limits."""

import gc
import hashlib
import os
import subprocess
import sys
from pathlib import Path

# Most of what the tests take is compiling. The workers, the processes that they start, and the next
# run of the tests share what was compiled; JAX reads the environment when it is imported.
COMPILED = Path(__file__).resolve().parents[1] / ".pytest_cache" / "compiled"
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(COMPILED))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")

import jax  # noqa: E402
import pytest  # noqa: E402
from hypothesis import settings  # noqa: E402
from processes import without_status  # noqa: E402
from shapes import check_shapes  # noqa: E402

# The command line's own cache is another matter, which its own tests turn on.
os.environ["ECHELON_CACHE"] = "off"

jax.config.update("jax_numpy_rank_promotion", "raise")

# Tracing makes millions of small objects that live; looking through them all, again and again, for
# those that died in a circle takes a fifth of the time. What a file of tests leaves is set aside.
gc.set_threshold(100_000, 20, 20)

QUICKLY_COMPILED = " ".join(
    (
        "--xla_backend_optimization_level=0",
        "--xla_cpu_use_fusion_emitters=false",
        "--xla_cpu_parallel_codegen_split_count=1",
        "--xla_disable_hlo_passes=simplification,post_scatter_expansion_simplification",
    )
)

MAPPINGS = 30_000
"""Memory mappings from which on compiled programs are let go of between files."""

DURATIONS = Path(__file__).resolve().parents[1] / "build" / "durations.csv"
"""What each test took when it last ran: an artefact of a whole run, to cut from its top."""

LIMIT = 10.0
"""Seconds of a processor from which on a test that is not `slow` or `study` is named at the end."""


def pytest_addoption(parser):
    told = (
        "run the tests in an order that the commit chooses, until SECONDS of a processor are used"
    )
    parser.addoption("--until", type=float, metavar="SECONDS", help=told)


def pytest_configure(config):
    """Let XLA compile quickly where studies are left out.

    Most of the time of the tests is that of compiling programs which run for a millisecond. XLA
    does so without its optimizer and its rounds of simplification, in one piece, and by the older
    of its two emitters, which saves about 9 % of the time of the tests. With another selection
    (`-m study`, `-m ""`) it compiles as for users.
    """
    if "not study" in config.option.markexpr:
        os.environ.setdefault("XLA_FLAGS", QUICKLY_COMPILED)  # which JAX reads when it first runs


def pytest_collection_modifyitems(config, items):
    """Mark what needs a browser, and keep in one process what shares fixtures or compiled code."""
    if config.option.until:
        told = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True)
        items.sort(key=lambda item: hashlib.sha256((told.stdout + item.nodeid).encode()).digest())
    for item in items:
        if "browser" in item.fixturenames:
            item.add_marker("page")
        if not is_long(item) or shares_fixtures(item):
            item.add_marker(pytest.mark.xdist_group(item.path.stem))


def is_long(item):
    return bool(item.get_closest_marker("slow") or item.get_closest_marker("study"))


OWN = {
    "here",
    "echelon",
    "tmp_path",
    "tmp_path_factory",
    "monkeypatch",
    "capsys",
    "recwarn",
    "request",
}
"""Fixtures that every test makes for itself."""


def shares_fixtures(item):
    parameters = getattr(item, "callspec", None)
    return bool(set(item.fixturenames) - OWN - set(parameters.params if parameters else ()))


def processor_time():
    """Seconds of processors that this process and the ended ones that it started have taken."""
    spent = os.times()
    return spent.user + spent.system + spent.children_user + spent.children_system


BEGAN = processor_time()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item):
    """Leave a test out where the time that was given is used up."""
    until = item.config.option.until
    return True if until and processor_time() - BEGAN > until else None


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item):
    begin = processor_time()
    result = yield
    spent = processor_time() - begin
    item.user_properties += [("processor_time", spent), ("long", is_long(item))]
    return result


def pytest_terminal_summary(terminalreporter):
    reports = terminalreporter.getreports("passed")
    facts = [(report.nodeid, dict(report.user_properties)) for report in reports]
    keep_durations({name: x["processor_time"] for name, x in facts if x})
    slow = [(x["processor_time"], name) for name, x in facts if x and not x["long"]]
    slow = sorted(pair for pair in slow if pair[0] > LIMIT)
    for spent, name in slow[::-1]:
        terminalreporter.write_line(f"{spent:.0f} s of a processor, and not marked `slow`: {name}")


def keep_durations(spent):
    """Write the seconds of a processor of each test, the longest first; others' stay."""
    known = dict(line.rsplit(",", 1) for line in lines_of(DURATIONS))
    known |= {name: f"{seconds:.2f}" for name, seconds in spent.items()}
    DURATIONS.parent.mkdir(exist_ok=True)
    longest = sorted(known.items(), key=lambda pair: -float(pair[1]))
    DURATIONS.write_text("".join(f"{name},{seconds}\n" for name, seconds in longest), "utf-8")


def lines_of(file):
    return file.read_text("utf-8").splitlines() if file.exists() else []


check_shapes()

# The first example compiles, so none has a deadline.
settings.register_profile("echelon", deadline=None, derandomize="CI" in os.environ)
settings.load_profile("echelon")


@pytest.fixture
def here(tmp_path, monkeypatch):
    """An empty folder, in which the test works."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def echelon(here, monkeypatch, capsys):
    """Run the command line in this process: exit code, standard output, standard error."""
    from echelon.apps.cli.app import main

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["echelon", *map(str, arguments)])
        with pytest.raises(SystemExit) as left:
            main()
        told = capsys.readouterr()
        return left.value.code or 0, told.out, without_status(told.err)

    return call


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown(item, nextitem):
    """Let go of compiled programs between files, before there are more than Linux can map.

    Each program of XLA takes some memory mappings, of which Linux allows a process 65,530.
    Processes that compiled all tests' programs crashed in XLA, and this is the likely reason.
    """
    if nextitem is not None and nextitem.path == item.path:
        return
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > MAPPINGS:
        jax.clear_caches()
        gc.unfreeze()
    gc.collect()
    gc.freeze()
