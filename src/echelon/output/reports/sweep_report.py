"""The text report of a sweep: number of runs, outcomes, and quantiles of errors."""

from collections import Counter
from typing import TYPE_CHECKING

import numpy as np

from echelon.core.types import Array, JsonObject
from echelon.core.words import GuaranteeVerdict, amount
from echelon.experiments.results.run_numbers import settling_bound
from echelon.experiments.sweeps.plan import SEED, SUMMARIZED
from echelon.experiments.sweeps.sweep_dataset import share_bounds, succeeded

if TYPE_CHECKING:
    import xarray as xr

_LINES, _WARNINGS = 20, 5


def sweep_mapping(data: "xr.Dataset") -> JsonObject:
    """Return the numbers of a sweep, ready for JSON."""
    outcome = data["outcome"]
    names = outcome.attrs["flag_meanings"].split()
    counts = {
        name: int((outcome == code).sum())
        for name, code in zip(names, outcome.attrs["flag_values"], strict=True)
    }
    conditional = data["promise_verdict"] == str(GuaranteeVerdict.CONDITIONAL)
    return {
        "runs": int(outcome.size),
        "outcomes": {name: count for name, count in counts.items() if count},
        "settled": int(succeeded(data).sum()),
        "promised": int((data["promised"] == 1).sum()),
        "conditional": int(conditional.sum()),
        "covered": int((conditional & (data["covered"] == 1)).sum()),
        "quantiles": {name: _quantiles(data[name].values) for name in SUMMARIZED},
    }


def sweep_report(data: "xr.Dataset") -> str:
    """Return the numbers of a sweep as text, with a line per combination if there are few."""
    summary = sweep_mapping(data)
    outcomes = ", ".join(
        f"{count} {name.replace('_', ' ')}" for name, count in summary["outcomes"].items()
    )
    done = summary["runs"] - summary["outcomes"].get("missing", 0)
    lines = [f"- {amount(summary['runs'], 'run')}: {outcomes}."]
    within = settling_bound(data["worst_final_error"].attrs.get("units", ""))
    lines += [f"- Settled to {within}: {_share(summary['settled'], done)}."]
    lines += [f"- With a guarantee: {summary['promised']} of {summary['runs']}."]
    if summary["conditional"]:
        text = f"- With a claim that holds while no input is at a limit: {summary['conditional']}"
        lines += [f"{text}; covered in every step: {summary['covered']}."]
    for name, values in summary["quantiles"].items():
        if values is not None:
            low, median, high = (f"{value:.3g}" for value in values)
            label = name.replace("_", " ").capitalize()
            unit = f" {data[name].attrs.get('units', '')}".rstrip()
            lines.append(f"- {label}: median {median}{unit}; 5 to 95 %: {low} to {high}{unit}.")
    return "\n".join([*lines, *_warnings(data), *_cases(data)])


def _warnings(data: "xr.Dataset") -> list[str]:
    counts = Counter(line for text in data["warnings"].values.flat for line in text.splitlines())
    return [f"- Warning ({amount(n, 'run')}): {line}" for line, n in counts.most_common(_WARNINGS)]


def _cases(data: "xr.Dataset") -> list[str]:
    keys = [key for key in data["outcome"].dims if key != SEED]
    if SEED not in data.dims or not keys or np.prod([data.sizes[key] for key in keys]) > _LINES:
        return []
    present = (data["outcome"] != data["outcome"].attrs["flag_values"][0]).sum(SEED)
    settled = succeeded(data).sum(SEED).stack(case=keys)
    counts = present.stack(case=keys).values
    lines = []
    for place, count, total in zip(settled["case"].values, settled.values, counts, strict=True):
        values = place if isinstance(place, tuple) else (place,)
        texts = (f"{x:g}" if isinstance(x, int | float | np.number) else str(x) for x in values)
        case = ", ".join(f"{key} {text}" for key, text in zip(keys, texts, strict=True))
        lines.append(f"- {case}: {_share(int(count), int(total))} settled")
    return lines


def _share(count: int, total: int) -> str:
    if not total:
        return "0 of 0"
    low, high = share_bounds(count, total)
    return f"{count} of {total} ({100 * low:.3g} to {100 * high:.3g} %, 95 % confidence)"


def _quantiles(values: Array) -> list[float] | None:
    finite = values[np.isfinite(values)]
    return [float(q) for q in np.quantile(finite, [0.05, 0.5, 0.95])] if finite.size else None
