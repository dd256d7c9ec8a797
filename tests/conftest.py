"""What every test runs under: no silent broadcasting, checked shapes, repeatable examples."""

import os
import sys

import jax
import pytest
from beartype import beartype
from hypothesis import settings
from jaxtyping import install_import_hook

# What one test compiled must not stand in for what another is to compile.
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
