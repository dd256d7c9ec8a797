"""A flight beside a simulation: where they differ, in numbers."""

import json
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from echelon.core.errors import OutputError
from echelon.experiments.results.recording import Recording


class Beside(NamedTuple):
    """A run of N agents at F of its own times, and the flight at the same times.

    Attributes:
        times: s (F,).
        flown, run: states (F, N, n); flown ones are linear between the frames of the flight.
        flown_inputs, run_inputs: (F, N, m); flown ones hold from frame to frame.
        here: which agents flew (F, N).
        away: distance between the positions, or the measured states, of each agent; NaN where it
            did not fly (F, N).
        of: the flight, for its names and units.
    """

    times: Float[np.ndarray, " F"]
    flown: Float[np.ndarray, "F N n"]
    run: Float[np.ndarray, "F N n"]
    flown_inputs: Float[np.ndarray, "F N m"]
    run_inputs: Float[np.ndarray, "F N m"]
    here: Bool[np.ndarray, "F N"]
    away: Float[np.ndarray, "F N"]
    of: Recording

    def lines(self) -> Iterator[str]:
        """Yield a table of how far each agent was from where the run has it, and of inputs."""
        unit = f", {self.of.length_unit}" if self.of.length_unit else ""
        yield f"agent  RMS apart{unit}  largest{unit}  at, s"
        for agent in range(self.away.shape[1]):
            away = self.away[:, agent]
            if np.isnan(away).all():
                yield f"{agent:<5}  did not fly"
                continue
            worst = int(np.nanargmax(away))
            mean = np.sqrt(np.nanmean(away**2))
            yield f"{agent:<5}  {mean:<11.3g}  {away[worst]:<9.3g}  {self.times[worst]:.4g}"
        apart = np.abs(self.flown_inputs - self.run_inputs)[self.here]
        names = zip(self.of.input_names, self.of.input_units, apart.T, strict=True)
        for name, unit, column in names:
            mean, most = (f"{x:.3g} {unit}".rstrip() for x in _sizes(column))
            yield f"- Input `{name}`: {mean} RMS apart, {most} at most."
        yield (
            f"- Compared at {len(self.times)} times of the run, from {self.times[0]:.4g} to "
            f"{self.times[-1]:.4g} s."
        )


def _sizes(apart: Float[np.ndarray, " K"]) -> tuple[float, float]:
    return float(np.sqrt((apart**2).mean())), float(apart.max())


def beside(flown: Recording, run: Recording) -> Beside:
    """Return a flight beside a run.

    Raises:
        OutputError: they have other agents, states or inputs, the first is no flight, or they
            share no time.
    """
    _check_alike(flown, run)
    within = (run.times >= flown.times[0] - 1e-9) & (run.times <= flown.times[-1] + 1e-9)
    if not within.any():
        raise OutputError("`--beside`: the flight and the run share no time.")
    times, shape = run.times[within], flown.states.shape[1:]
    flat = flown.states.reshape(len(flown.times), -1)
    between = [np.interp(times, flown.times, column) for column in flat.T]
    states = np.stack(between, axis=1).reshape(-1, *shape)
    row = (np.searchsorted(flown.times, times + 1e-9, "right") - 1).clip(0)
    here = np.ones((len(times), shape[0]), bool) if flown.presence is None else flown.presence[row]
    apart = (states - run.states[within])[:, :, list(flown.measured)]
    away = np.where(here, np.linalg.norm(apart, axis=2), np.nan)
    inputs = flown.inputs[row], run.inputs[within]
    return Beside(times, states, run.states[within], *inputs, here, away, flown)


def _check_alike(flown: Recording, run: Recording) -> None:
    if "flight" not in flown.attributes:
        raise OutputError("`--beside` compares a flight with a run, and the first is no flight.")
    for what in ("agents", "state_names", "state_units", "input_names", "input_units"):
        own, other = (json.dumps(getattr(each, what)) for each in (flown, run))
        if own != other:
            raise OutputError(
                f"`--beside`: the run has the {what.replace('_', ' ')} {other}, and the flight "
                f"{own}; give a run of the same scenario."
            )
