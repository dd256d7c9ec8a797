"""The leader's path, in the axes in which the followers' law works."""

from typing import NamedTuple

import jax
import numpy as np

from echelon.agents.models.heading_symmetry import (
    heading_index,
    input_turn,
    rest_heading,
    rotate_state,
)
from echelon.agents.models.model import ControlAffine
from echelon.core.compiled import cached_jit
from echelon.core.types import Array, Input, State, States
from echelon.guarantees.promises.leaders import Leaders, own_paths
from echelon.simulation.engine.law_drive import Laws
from echelon.simulation.engine.parts import Parts
from echelon.simulation.step.settings import Settings

MOMENTS = 192
"""States of the path that are looked at."""
_SHORT = 1e-6  # s, over which a path's velocity is taken


class PathSamples(NamedTuple):
    """What K agents are asked with: times, their leader's states and inputs, their own states."""

    times: Array
    leaders: Array
    inputs: Array
    states: Array
    rates: Array


class LeaderPath(NamedTuple):
    """Moments (K,), the leader's states (K, n) then, its normalized inputs (K, m), and its trim.

    A law that turns sees them in the axes of the headings (K,), which turn at rates (K,).
    """

    times: Array
    states: Array
    inputs: Array
    trim: Array
    headings: Array
    rates: Array

    @property
    def rows(self) -> PathSamples:
        """What followers at the leader's own states are asked with."""
        return PathSamples(self.times, self.states, self.inputs, self.states, self.rates)

    def extreme_rates(self) -> tuple[float, ...]:
        """Return the least and the largest rate, rad/s, once where they are one; no zero."""
        if not len(self.rates):
            return ()
        # Flatness maps round: a heading that stays seems to turn at 1e-17.
        known = np.round([self.rates.min(), self.rates.max()], 9)
        return tuple(rate for rate in dict.fromkeys(known.tolist()) if rate)

    def own_headings(self, parts: Parts) -> Array:
        """Return how far a leader's own gain is turned in these axes, (K,)."""
        turns = getattr(getattr(parts.drive, "leader", None), "turns", False)
        if not turns or self.headings.any():
            return np.zeros(len(self.times))
        return self.states[:, heading_index(parts.model)] - rest_heading(parts.model)

    def at_start(self, model: ControlAffine, states: Array) -> PathSamples:
        """Return what followers in states (K, n) are asked with at the beginning."""
        count = len(states)
        if not len(self.times):
            still, sent = np.zeros(count), np.zeros((count, self.inputs.shape[1]))
            return PathSamples(still, np.tile(self.trim, (count, 1)), sent, states, still)
        first = PathSamples(*(np.repeat(part[:1], count, axis=0) for part in self.rows))
        away = np.repeat(self.headings[:1], count)
        seen = _in_axes(model, states, away) if away.any() else states
        return first._replace(times=np.zeros(count), states=np.asarray(seen))


def leader_path_of(parts: Parts, settings: Settings, leaders: Leaders) -> LeaderPath:
    """Return where the leader goes: its reference, or by itself where its input rests."""
    model, times = parts.model, np.linspace(0.0, settings.horizon, MOMENTS)
    trim, m = np.asarray(model.trim[0], float), len(model.input_names)
    twice = jax.device_put(np.concatenate([times, times + _SHORT]))
    desired = parts.drive.reference_states(model, twice)
    if desired is not None:
        states, soon = np.split(np.asarray(desired), 2)
        v = _inputs(model, states, soon)
        finite = np.isfinite(states).all(axis=1) & np.isfinite(v).all(axis=1)
        return _as_sensed(parts, times[finite], states[finite], v[finite])
    paths = None
    if leaders.rest and not (leaders.starts == trim).all():
        paths = own_paths(parts, settings, leaders.starts[:1])
    if paths is None:
        return _as_sensed(parts, np.zeros(0), np.zeros((0, len(trim))), np.zeros((0, m)))
    frames = np.linspace(0, len(paths) - 1, MOMENTS).round().astype(int)
    return _as_sensed(parts, times, paths[frames, 0], np.zeros((MOMENTS, m)))


def _as_sensed(parts: Parts, times: Array, states: Array, inputs: Array) -> LeaderPath:
    """Return a path as a law that turns with the heading sees it, or as it is."""
    assert isinstance(parts.drive, Laws)
    model, still = parts.model, np.zeros(len(times))
    path = LeaderPath(times, states, inputs, np.asarray(model.trim[0], float), still, still)
    if not (parts.drive.follower.turning and len(times)):
        return path
    away = states[:, heading_index(model)] - rest_heading(model)
    found = _in_heading(model, states, inputs, away)
    back, sent, rates = map(np.asarray, found)
    return path._replace(states=back, inputs=sent, headings=away, rates=rates)


@cached_jit
def _in_axes(model: ControlAffine, states: States, angles: jax.Array) -> States:
    """Return states (K, n) in axes that are turned by angles (K,)."""
    return jax.vmap(lambda x, angle: rotate_state(model, x, -angle))(states, angles)


@cached_jit
def _in_heading(
    model: ControlAffine, states: States, inputs: jax.Array, angles: jax.Array
) -> tuple[States, jax.Array, jax.Array]:
    """Return states (K, n) and normalized inputs (K, m) in turned axes, and how fast these turn."""

    def rate(x: State, v: Input) -> jax.Array:
        return model.velocity(x, model.physical(v))[heading_index(model)]

    sent = jax.vmap(input_turn(model))(inputs, -angles)
    return _in_axes(model, states, angles), sent, jax.vmap(rate)(states, inputs)


def _inputs(model: ControlAffine, now: Array, soon: Array) -> Array:
    """Return the normalized inputs that take agents from states to others _SHORT later."""
    velocities, maps = map(np.asarray, _pushes(model, now, soon))
    finite = np.isfinite(velocities).all(axis=1) & np.isfinite(maps).all(axis=(1, 2))
    inputs = np.full((len(maps), maps.shape[2]), np.nan)
    inputs[finite] = np.einsum("kmn,kn->km", np.linalg.pinv(maps[finite]), velocities[finite])
    return inputs


@cached_jit
def _pushes(model: ControlAffine, now: States, soon: States) -> tuple[States, jax.Array]:
    """Return what inputs add to the drift there (K, n), and their maps (K, n, m)."""

    def one(x: State, later: State) -> tuple[State, jax.Array]:
        moved = model.difference(later, x) / _SHORT - model.normalized_drift(x)
        return moved, model.normalized_input_map(x)

    return jax.vmap(one)(now, soon)
