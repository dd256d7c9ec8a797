"""`echelon init`: a folder to begin with."""

from pathlib import Path
from typing import Annotated

import typer


def init(
    folder: Annotated[Path, typer.Argument(help="A new folder, such as my-swarm.")],
) -> None:
    """Make a folder with a scenario, a model, a law and a notebook, all of which run."""
    from echelon.output.archive.starter_folder import begin

    files = begin(folder)
    print(f"- Written to {folder}: {', '.join(file.name for file in files)}.")
    print(f"- Next: cd {folder} && echelon run scenario.yaml")
