"""`echelon init`: a starter folder with a scenario, a model, a law and a notebook."""

from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer


def init(folder: Annotated[Path, typer.Argument(help="A new folder, such as my-swarm.")]) -> None:
    """Create a folder with a scenario, a model, a law and a notebook that run as they are."""
    from echelon.output.archive.starter_folder import create_starter

    files = create_starter(folder)
    print(f"- Written to {folder}: {', '.join(file.name for file in files)}.")
    print(f"- Next: cd {folder} && echelon run scenario.yaml")
    if find_spec("jupyterlab") is None:
        print("- The notebook needs JupyterLab: in echelon's clone, pip install '.[notebook]'")
