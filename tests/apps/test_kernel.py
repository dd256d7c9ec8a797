"""A real kernel of Jupyter: commands behind `!`, and results as the last line of a cell."""

import os
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

# With ipykernel, which `pip install ".[notebook]"` brings, and fails without.
pytestmark = [pytest.mark.study, pytest.mark.outside]


@pytest.fixture(scope="module")
def kernel(tmp_path_factory):
    """A kernel of this Python in an empty folder, whose shell finds this Python's commands."""
    from jupyter_client.manager import start_new_kernel

    folder = tmp_path_factory.mktemp("notebook")
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    manager, client = start_new_kernel(cwd=str(folder), env=os.environ | {"PATH": path})

    def cell(code):
        printed, shown = [], {}

        def keep(message):
            content = message["content"]
            printed.append(content.get("text", "") + "\n".join(content.get("traceback", ())))
            shown.update(content.get("data", {}))

        reply = client.execute_interactive(code, timeout=600.0, output_hook=keep)["content"]
        assert reply["status"] == "ok", "".join(printed)
        return "".join(printed), shown

    yield SimpleNamespace(cell=cell, folder=folder)
    client.stop_channels()
    manager.shutdown_kernel(now=True)


def test_a_command_runs_in_a_cell(kernel):
    code = "!echelon run paper --out first --set simulation.horizon=2\nprint(_exit_code)"
    printed, _ = kernel.cell(code)
    assert "Written to first" in printed and printed.split()[-1] == "0", printed
    assert (kernel.folder / "first" / "run.nc").is_file()
    assert list((kernel.folder / "first" / "figures").glob("*.png"))


def test_results_are_tables_in_a_cell(kernel):
    _, shown = kernel.cell(
        "import echelon as ech\n"
        "experiment = ech.build(ech.load_scenario('integrators'))\n"
        "ech.check(*experiment)"
    )
    assert shown["text/html"].count("<table>") == 3 and "<table>" not in shown["text/plain"]
    assert "<table>" in kernel.cell("ech.design(experiment)")[1]["text/html"]
    assert "<table>" in kernel.cell("ech.simulate(*experiment)")[1]["text/html"]
    printed, _ = kernel.cell("print(ech.guarantee_text(ech.guarantee(*experiment)))")
    assert "Guaranteed" in printed
