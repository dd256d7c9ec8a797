"""What every test runs under: no silent broadcasting, checked shapes, repeatable examples."""

import os
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
from beartype import beartype  # noqa: E402
from hypothesis import settings  # noqa: E402
from jaxtyping import install_import_hook  # noqa: E402

# The command line's own cache is another matter, which its own tests turn on.
os.environ["ECHELON_CACHE"] = "off"

jax.config.update("jax_numpy_rank_promotion", "raise")


def check_shapes(function):
    """Check what is declared with a shape; a wrong type is for echelon to refuse, as for a user."""
    hints = function.__annotations__.items()
    function.__annotations__ = {name: hint for name, hint in hints if "jaxtyping" in repr(hint)}
    return beartype(function)


install_import_hook("echelon", "conftest.check_shapes")

# The first example compiles, so none has a deadline.
settings.register_profile("echelon", deadline=None, derandomize="CI" in os.environ)
settings.load_profile("echelon")


@pytest.fixture
def echelon(monkeypatch, capsys):
    """Run the command line in this process: exit code, standard output, standard error."""
    from echelon.cli.app import main

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["echelon", *map(str, arguments)])
        with pytest.raises(SystemExit) as left:
            main()
        told = capsys.readouterr()
        return left.value.code or 0, told.out, told.err

    return call
