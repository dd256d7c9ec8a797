"""A sweep in words: how many runs there were, how they ended, and how large errors were."""

from collections import Counter
from typing import TYPE_CHECKING, Any

import numpy as np

from echelon.core.types import Array
from echelon.experiments.sweeps.axes import SEED
from echelon.experiments.sweeps.numbers import NUMBERS, SUMMARIZED
from echelon.experiments.sweeps.sweep_dataset import share_bounds, succeeded

if TYPE_CHECKING:
    import xarray as xr

_LINES, _WARNINGS = 20, 5


def sweep_mapping(data: "xr.Dataset") -> dict[str, Any]:
    """Return what a sweep comes to, ready for JSON."""
    outcome = data["outcome"]
    names = outcome.attrs["flag_meanings"].split()
    counts = {
        name: int((outcome == code).sum())
        for name, code in zip(names, outcome.attrs["flag_values"], strict=True)
    }
    return {
        "runs": int(outcome.size),
        "outcomes": {name: count for name, count in counts.items() if count},
        "settled": int(succeeded(data).sum()),
        "promised": int((data["promised"] == 1).sum()),
        "quantiles": {name: _quantiles(data[name].values) for name in SUMMARIZED},
    }


def sweep_report(data: "xr.Dataset") -> str:
    """Return what a sweep comes to, as text: a line a fact, and one for each case of a few."""
    found = sweep_mapping(data)
    ended = ", ".join(
        f"{count} {name.replace('_', ' ')}" for name, count in found["outcomes"].items()
    )
    done = found["runs"] - found["outcomes"].get("missing", 0)
    lines = [f"- {found['runs']} runs: {ended}."]
    lines += [f"- Settled within 1 cm for good: {_share(found['settled'], done)}."]
    lines += [f"- Something was promised of {found['promised']}."]
    for name, values in found["quantiles"].items():
        if values is not None:
            low, middle, high = (f"{value:.3g}" for value in values)
            unit = " s" if NUMBERS[name].unit == "s" else ""
            lines.append(
                f"- {name.replace('_', ' ')}: median {middle}{unit}, 5 to 95 %: {low} to {high}."
            )
    return "\n".join([*lines, *_warned(data), *_cases(data)])


def _warned(data: "xr.Dataset") -> list[str]:
    """Return a line for each of the warnings that most runs gave."""
    told = Counter(line for text in data["warnings"].values.flat for line in text.splitlines())
    return [f"- Warning, of {n} of the runs: {line}" for line, n in told.most_common(_WARNINGS)]


def _cases(data: "xr.Dataset") -> list[str]:
    """Return a line for each combination of what is no seed, where there are a few."""
    keys = [key for key in data["outcome"].dims if key != SEED]
    if SEED not in data.dims or not keys or np.prod([data.sizes[key] for key in keys]) > _LINES:
        return []
    there = (data["outcome"] != data["outcome"].attrs["flag_values"][0]).sum(SEED)
    settled = succeeded(data).sum(SEED).stack(case=keys)
    return [
        "- "
        + ", ".join(f"{key} {_shown(value)}" for key, value in zip(keys, _tuple(place)))
        + f": {_share(int(count), int(there.stack(case=keys)[k]))} settled"
        for k, (place, count) in enumerate(zip(settled["case"].values, settled.values, strict=True))
    ]


def _tuple(place: Any) -> tuple[Any, ...]:
    return place if isinstance(place, tuple) else (place,)


def _shown(value: Any) -> str:
    return f"{value:g}" if isinstance(value, int | float | np.number) else str(value)


def _share(count: int, total: int) -> str:
    """Return a share of all, with the interval that holds its probability at 95 %."""
    if not total:
        return "none of 0"
    low, high = share_bounds(count, total)
    return f"{count} of {total} ({100 * low:.3g} to {100 * high:.3g} % at 95 %)"


def _quantiles(values: Array) -> list[float] | None:
    """Return what 5, 50 and 95 % of the values that exist lie below."""
    known = values[np.isfinite(values)]
    return [float(q) for q in np.quantile(known, [0.05, 0.5, 0.95])] if known.size else None
