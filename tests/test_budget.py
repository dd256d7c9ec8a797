"""Budgets of lines: what each package may have."""

import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
BUDGET = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["echelon"]["budget"]


def lines_of(folder):
    return sum(len(path.read_bytes().splitlines()) for path in (ROOT / folder).rglob("*.py"))


def test_every_package_has_a_budget_of_lines_and_keeps_it():
    inner = [*(ROOT / "src" / "echelon").iterdir(), *(ROOT / "packages").glob("*/*")]
    homes = [*inner, ROOT / "tests"]
    folders = {str(home.relative_to(ROOT)) for home in homes if any(home.rglob("*.py"))}
    folders = {name for name in folders if (ROOT / name).is_dir()}
    assert {*BUDGET} == folders
    counted = {name: lines_of(name) for name in sorted(folders)}
    assert {name: n for name, n in counted.items() if n > BUDGET[name]} == {}
