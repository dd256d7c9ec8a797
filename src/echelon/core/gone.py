"""Keys, values, commands and names of earlier versions, each with what to use instead.

Whoever uses one in a scenario, on the command line or in Python gets one sentence. What goes from
echelon adds a line here, which stays for two minor versions.
"""

KEYS: dict[str, str] = {
    "leadership.heirs": "use `backups`",
    "leadership.waits": "make the leader's path slower, as by a smaller `rate` of `reference`",
    "live.gusts": "set `rms` of `disturbance` for the whole run",
    "live.lag": "set `lag` of `actuator` for the whole run",
}
"""Scenario keys; `section.key` is that key alone, and `key` is it in any section."""

VALUES: dict[str, str] = {
    "prediction: none": "use `packet`, by which the model carries the leader on",
    "export --to json": "use `csv`, or `nc` with xarray; numbers are in `summary.json`",
    "report --out .html": "use `.txt`, or `echelon view RUN --html FILE`, which shows it",
}
"""Values of scenario keys, as in `prediction: none`, and of options, as in `export --to json`."""

COMMANDS: dict[str, str] = {
    "tune": "minimize the cost by `ech.gradient` and SciPy, as in docs/recipes.md",
}
"""Commands of the command line."""

NAMES: dict[str, str] = {
    "load_run": "use `load`",
    "open_run": "use `load`",
    "network.recommend_edges": "compare `graph.with_edges([pair]).spectrum().low`; see recipes.md",
    "network.recommend_leaders": "compare `graph.with_leaders([k]).spectrum().low`; see recipes.md",
    "speedup": "use `-1 / gain.certificate.abscissa` of each graph; see recipes.md",
    "tune": "minimize the cost by `ech.gradient` and SciPy, as in docs/recipes.md",
}
"""Public names below `echelon`."""

RENAMED: dict[str, str] = {"Promise": "Guarantee", "promise": "guarantee"}
"""Public names below `echelon` that still work, with a warning."""

METHODS: dict[str, str] = {"flatten": "to_flat", "switch_on": "initial_integrators"}
"""Methods of a model that a class may declare, and what they are called now."""


def gone_key(*path: str | int) -> str:
    """Return ` is gone; ...` of a scenario's key, or "" where no earlier version had it."""
    names = [key for key in path if isinstance(key, str)]
    tails = (".".join(names[start:]) for start in range(len(names)))
    return next((gone(KEYS, tail) for tail in tails if tail in KEYS), "")


def no_name(name: str) -> AttributeError:
    """Return the error of a name below `echelon` that is gone, or never was."""
    return AttributeError(f"`echelon.{name}`{gone(NAMES, name) or ' does not exist.'}")


def gone(table: dict[str, str], name: str) -> str:
    """Return ` is gone; ...` of an entry of a table, or "" where no earlier version had it."""
    return f" is gone; {table[name]}." if name in table else ""
