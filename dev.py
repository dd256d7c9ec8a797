"""Set up the working environment in `.venv` and run things in it: `python3 dev.py demo`, for one.

Needs Python 3.11 or later and nothing else. Uses uv when it is on the PATH, else venv and pip. The
versions come from constraints.txt. What stands after the verb goes on to the program that it runs.
"""

import hashlib
import importlib.util
import os
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
HELP = """usage: python3 dev.py VERB [ARGUMENT ...]

  setup   set up .venv with all extras and build what the page draws with (three.js, from npm);
          does nothing when nothing changed
  browser find Chromium for the tests, or install Debian's, where this may be done
  demo    run the paper's experiment: echelon run paper [ARGUMENT ...]
  test    run the tests: pytest [ARGUMENT ...], on all cores
  lint    check style, layout and who imports whom: ruff, import-linter
  types   check types: pyright
  docs    build the documentation into site/, with warnings as errors: zensical
  fuzz    feed the command line nonsense for [SECONDS], and tell what it does not bear
  mutate  change the code in small ways and see which of them no test notices
  results make the published numbers of docs/ again: results (3 minutes on two free cores),
          comparison (10) and certificates (30), or [PAGE ...] of them
  wheel   build the wheel into build/, install it alone and without extras, and try it"""
NO_PIP = (
    "This Python cannot make an environment, since it has neither `ensurepip` nor `pip`"
    " 22.3 or later; install one of them (on Debian or Ubuntu: `apt install python3-venv`), or uv,"
    " and run this again."
)


class SetupError(Exception):
    """The environment cannot be set up; the message is what a person reads."""


def main(arguments: list[str]) -> int:
    """Run the verb and return the exit code of what it ran."""
    verb, rest = (arguments[0], arguments[1:]) if arguments else ("help", [])
    if verb in ("help", "-h", "--help"):
        print(HELP)
        return 0
    if verb not in VERBS:
        print(f"dev.py: `{verb}` is no verb.\n\n{HELP}", file=sys.stderr)
        return 2
    try:
        setup()
        folder = Path.cwd() if verb == "demo" else ROOT  # a demo's `--out` is the caller's
        return max((run(command, folder) for command in VERBS[verb](rest)), default=0)
    except (SetupError, OSError) as error:
        print(f"dev.py: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130


def program(name: str, venv: Path = VENV) -> Path:
    """Return where a program of an environment stands, or would."""
    return venv / "Scripts" / f"{name}.exe" if os.name == "nt" else venv / "bin" / name


def tool(name: str, *arguments: str) -> list[str]:
    """Return the command that runs a program of .venv as a module, wherever .venv was made."""
    return [str(program("python")), "-m", name, *arguments]


def tests(rest: list[str]) -> list[list[str]]:
    """Return the command that runs the tests, spread over the cores where there are several."""
    spread = ["-n", "auto", "--dist", "worksteal"] if cores() > 1 else []
    return [tool("pytest", *spread, *rest)]


def cores() -> int:
    """Return how many cores this process may use, which can be fewer than the machine has."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def wheel(rest: list[str]) -> list[list[str]]:
    """Build the wheel, install it where nothing else is, and return the commands that try it.

    They see what an editable install hides: a file that is not shipped, a dependency that only an
    extra or a tool brings.
    """
    wheels, alone = BUILD / "wheels", BUILD / "alone"
    clear(wheels)
    clear(alone)
    install = installer(alone)
    step(builder(alone, wheels), "The wheel could not be built; what stands above says why.")
    [built] = wheels.glob("*.whl")
    step([*install, str(built), *PINNED], "The wheel could not be installed.")
    echelon = str(program("echelon", alone))
    every_name = "import echelon; [getattr(echelon, name) for name in echelon.__all__]"
    return [
        [str(program("python", alone)), "-c", every_name],
        [echelon, "list"],
        [echelon, "check", "paper"],
        [echelon, "run", "paper", "--set", "simulation.horizon=1", "--out", str(alone / "run")],
        [echelon, "view", str(alone / "run"), "--html", str(alone / "run.html")],
    ]


BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


def browser(rest: list[str]) -> list[list[str]]:
    """Return the command that tells Chromium's version, installed first where there is none."""
    if not any(map(shutil.which, BROWSERS)) and shutil.which("apt-get"):
        # As root as it is, else only where that takes no password.
        sudo = [] if os.geteuid() == 0 else ["sudo", "-n"]
        apt = [*sudo, "apt-get", "-qq", "-o", "DPkg::Lock::Timeout=300"]
        for command in (["update"], ["install", "-y", "--no-install-recommends", "chromium"]):
            if not works([*apt, *command]):
                break
    found = next(filter(None, map(shutil.which, BROWSERS)), None)
    if found is None:
        raise SetupError("there is no Chromium on the PATH for the tests of the page; install it.")
    return [[found, "--version"]]


PAGES = {"results": [], "comparison": [], "certificates": ["--all"]}
"""The benchmarks that write pages of docs/, in the order of their parts."""


def results(rest: list[str]) -> list[list[str]]:
    """Return the commands that make the published numbers again."""
    unknown = [name for name in rest if name not in PAGES]
    if unknown:
        raise SetupError(f"`{unknown[0]}` is no page of numbers; there are {', '.join(PAGES)}.")
    # The times that are published are those of one thread.
    os.environ["OMP_NUM_THREADS"] = "1"
    python = str(program("python"))
    return [[python, f"benchmarks/{name}.py", *PAGES[name]] for name in rest or PAGES]


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
    "docs": lambda rest: [tool("zensical", "build", "--strict", "--clean", *rest)],
    "fuzz": lambda rest: [[str(program("python")), "benchmarks/fuzz.py", *rest]],
    "mutate": lambda rest: [[str(program("python")), "benchmarks/mutate.py", *rest]],
    "results": results,
    "wheel": wheel,
}


def run(command: list[str], folder: Path = ROOT) -> int:
    """Run a command in the foreground and return its exit code, 128 + n for one ended by signal n.

    Ctrl-C reaches the command as well. It is left to end in its own way, and only then, unless it
    ended well, is the interruption passed on.
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


def setup() -> None:
    """Make .venv what pyproject.toml and constraints.txt ask for, and build the page's three.js."""
    wanted = fingerprint()
    if not (program("python").exists() and STAMP.is_file() and STAMP.read_text("utf-8") == wanted):
        install_all(wanted)
    if run([str(program("python")), str(ROOT / "web" / "build.py")]) != 0:
        print("dev.py: all but `echelon view` and `echelon live` works without.", file=sys.stderr)


def install_all(wanted: str) -> None:
    """Install what is needed into .venv, and note of what."""
    print(f"Setting up {VENV}; the first time, this takes a few minutes.", flush=True)
    STAMP.unlink(missing_ok=True)
    install = [*installer(VENV), "--editable", ".[all,dev]", *PINNED]
    step(install, "The packages could not be installed; what stands above says why.")
    STAMP.write_text(wanted, "utf-8")


def fingerprint() -> str:
    """Return what .venv depends on: a hash of the two files, the Python version, this folder."""
    files = b"".join((ROOT / name).read_bytes() for name in ("pyproject.toml", "constraints.txt"))
    return "\n".join([hashlib.sha256(files).hexdigest(), version(), str(ROOT), ""])


def version() -> str:
    """Return the version of the Python that runs this file, such as `3.11`."""
    return "{}.{}".format(*sys.version_info)


def installer(venv: Path) -> list[str]:
    """Make sure that an environment exists and return the command that installs into it."""
    return with_uv(venv) if shutil.which("uv") else with_pip(venv)


def builder(venv: Path, folder: Path) -> list[str]:
    """Return the command that builds the wheel into a folder."""
    if shutil.which("uv"):
        return ["uv", "build", "--wheel", "--out-dir", str(folder)]
    return [*pip(venv), "wheel", *quiet(), "--no-deps", "--wheel-dir", str(folder), "."]


def with_uv(venv: Path) -> list[str]:
    """Make sure that an environment exists and return how uv installs into it."""
    if not fits(venv):
        clear(venv)
        step(["uv", "venv", "--python", sys.executable, str(venv)], f"uv could not make {venv}.")
    return ["uv", "pip", "install", "--python", str(program("python", venv))]


def with_pip(venv: Path) -> list[str]:
    """Make sure that an environment exists and return how pip installs into it."""
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

    Debian takes `ensurepip` out of its Python, and then an environment is born without pip; a pip
    outside the environment can install into it all the same (from pip 22.3 on).
    """
    python = str(program("python", venv))
    inner, outer = [python, "-m", "pip"], [sys.executable, "-m", "pip", "--python", python]
    return next((one for one in (inner, outer) if works([*one, "--version"])), [])


def quiet() -> list[str]:
    """Return pip's option for few lines where nobody watches its progress bars."""
    return [] if sys.stdout.isatty() else ["--quiet"]


def fits(venv: Path) -> bool:
    """Tell whether an environment exists and is for this version of Python, whoever made it."""
    config = venv / "pyvenv.cfg"
    if not (program("python", venv).exists() and config.is_file()):
        return False
    pairs = (line.partition("=") for line in config.read_text().splitlines())
    settings = {key.strip(): value.strip() for key, _, value in pairs}
    made_for = settings.get("version") or settings.get("version_info") or ""
    return made_for.startswith(f"{version()}.")


def clear(folder: Path) -> None:
    """Remove what stands where a folder will be made: what does not fit, or is half made."""
    if folder.is_symlink():
        folder.unlink()
    elif folder.exists():
        shutil.rmtree(folder)


def works(command: list[str]) -> bool:
    """Tell whether a command exists and ends well; what it says is not shown."""
    silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    try:
        return subprocess.run(command, check=False, **silent).returncode == 0
    except OSError:
        return False


def step(command: list[str], sentence: str) -> None:
    """Run one step of the set-up, and raise `SetupError` with the sentence when it fails."""
    if run(command) != 0:
        raise SetupError(sentence)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
