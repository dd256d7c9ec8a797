"""The perspective of a video: from places to pixels in a fifth of the time of mplot3d."""

from typing import NamedTuple

import numpy as np

from echelon.core.types import Array
from echelon.output.plots.space import Space

_BACK = (0.42, -0.78, 0.47)
"""The direction from a space to the camera: front, right and above."""
_TALL = float(np.tan(np.deg2rad(16.0)))
_FILL = 0.9
_MOST = 500
"""Frames whose places are looked at, evenly over a run."""


class Camera(NamedTuple):
    """A view of a space from a place, or of a plane from above.

    Attributes:
        eye: (3,).
        axes: (3, 3), right, up and forward as rows.
        focal: pixels for one unit at distance one; in a plane, pixels for one unit.
        middle: (2,) pixels of the picture's middle.
        flat: whether there is no perspective.
    """

    eye: Array
    axes: Array
    focal: float
    middle: Array
    flat: bool

    def project(self, places: Array) -> tuple[Array, Array]:
        """Return pixels (..., 2), upwards, and distances (...) of places (..., 3)."""
        view = (places - self.eye) @ self.axes.T
        depth = view[..., 2]
        scale = self.focal if self.flat else self.focal / np.maximum(depth, 1e-6)[..., None]
        return self.middle + scale * view[..., :2], depth


def camera_for(
    space: Space, width: int, height: int, left: int, places: Array | None = None
) -> Camera:
    """Return a camera that shows the box of a space in a rectangle of pixels.

    Of a space with places (T, N, 3) in it, it shows these and their shadows as large as they fit.
    """
    middle = np.array([left + 0.5 * width, 0.5 * height])
    low, high = space.low, space.high
    centre = 0.5 * (low + high)
    if space.kind != "space":
        size = np.maximum(high - low, 1e-9)
        focal = 0.86 * float(min(width / size[0], height / size[1]))
        return Camera(centre, np.eye(3), focal, middle, True)
    back = np.array(_BACK) / np.linalg.norm(_BACK)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(back, right), -back])
    corners = np.stack(np.meshgrid(*zip(low, high, strict=True)), axis=-1).reshape(-1, 3)
    shown = corners if places is None else _around(places, space)
    x, y, away = _position(shown - centre, axes, _FILL * _TALL * width / height, _FILL * _TALL)
    eye = centre + x * axes[0] + y * axes[1] + away * back
    return Camera(eye, axes, 0.5 * height / _TALL, middle, False)


def _around(places: Array, space: Space) -> Array:
    """Return places (K, 3) of a run and under them, with the room that bodies take."""
    high = places[:: max(1, len(places) // _MOST)].reshape(-1, 3)
    high = np.clip(high[np.isfinite(high).all(axis=1)], space.low, space.high)
    below = high * (1.0, 1.0, 0.0) + (0.0, 0.0, space.low[2])
    room = 0.05 * float((space.high - space.low).max())
    beside = room * np.concatenate([np.eye(3), -np.eye(3)])
    return (np.concatenate([high, below])[:, None] + beside).reshape(-1, 3)


def _position(corners: Array, axes: Array, wide: float, tall: float) -> tuple[float, float, float]:
    """Return the distances sideways, up and back at which corners (K, 3) just fit."""
    across, up, near = (corners @ axis for axis in (axes[0], axes[1], -axes[2]))
    x = y = away = 0.0
    # The middle of the picture depends on the distance.
    for _ in range(8):
        away = float((np.maximum(np.abs(across - x) / wide, np.abs(up - y) / tall) + near).max())
        view = (across / (away - near), up / (away - near))
        x, y = (away * 0.5 * float(line.max() + line.min()) for line in view)
    return x, y, away
