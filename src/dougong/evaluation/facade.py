"""A bracketed timber facade with labelled noise: the test piece of the denoising filters.

A wall between columns carries bracket sets (dougong: blocks and crossed arms in two tiers) under
an eave of rafters. Points are drawn at random, evenly over all faces, as METHOD.md 1.3 measures.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dougong.errors import InputError
from dougong.typing import Points

SURFACE, FEATURE = 0, 1
NOISE_UNIFORM, NOISE_NEAR, NOISE_OFFSET = 5, 6, 7
"""Truth labels: isolated noise, Gaussian noise about a surface, points 5 to 50 cm off a surface."""
NOISE_LABELS = (NOISE_UNIFORM, NOISE_NEAR, NOISE_OFFSET)

_LENGTH_M, _HEIGHT_M = 12.0, 4.5
_BAY_M = 3.0
_SENSOR_SIGMA_M = 0.002
_NEAR_SIGMA_M = 0.15
_OFFSET_M = (0.05, 0.50)
_MARGIN_M = 1.0


@dataclass(frozen=True, slots=True)
class _Face:
    """A rectangle: corner and two edges, each (3,), and its truth label."""

    corner: NDArray[np.float64]
    along: NDArray[np.float64]
    across: NDArray[np.float64]
    label: int

    @property
    def normal(self) -> NDArray[np.float64]:
        """Unit normal times the area."""
        return np.cross(self.along, self.across)


def _box(centre: tuple[float, float, float], size: tuple[float, float, float]) -> list[_Face]:
    """Return the six faces of a feature's box; centre and size (x, y, z), metres."""
    low, (a, b, c) = np.subtract(centre, np.divide(size, 2)), np.diag(size)
    pairs = ((a, b, c), (a, c, b), (b, c, a))
    return [_Face(low + shift, u, v, FEATURE) for u, v, w in pairs for shift in (np.zeros(3), w)]


def _bracket_set(x: float) -> list[_Face]:
    """Return one bracket set on the wall at `x`: cap block, two tiers of crossed arms, blocks."""
    faces = _box((x, -0.15, 3.10), (0.36, 0.30, 0.20))
    for tier, reach in enumerate((0.45, 0.70)):
        z = 3.27 + 0.30 * tier
        faces += _box((x, -0.15, z), (2 * reach, 0.10, 0.14))
        faces += _box((x, -0.15 - reach / 2, z), (0.10, reach, 0.14))
        for along, out in ((-reach, 0.15), (reach, 0.15), (0.0, 0.15 + reach)):
            faces += _box((x + along, -out, z + 0.15), (0.18, 0.18, 0.16))
    return faces


def _faces() -> list[_Face]:
    """Return every face of the facade: wall, columns, soffit (flat), brackets and rafters."""
    length, height = np.array([_LENGTH_M, 0, 0]), np.array([0, 0, _HEIGHT_M])
    eave = np.array([0.0, -2.0, -0.6])
    faces = [
        _Face(np.zeros(3), length, height, SURFACE),
        _Face(np.array([0.0, -2.0, 0.0]), length, np.array([0.0, 2.0, 0.0]), SURFACE),
        _Face(height + [0, 0, 0.3], length, eave, SURFACE),
    ]
    for x in np.arange(_BAY_M / 2, _LENGTH_M, _BAY_M):
        faces += _bracket_set(float(x))
        # Columns are square piers standing 25 cm out of the wall, wide enough to be flat.
        front = np.array([x - 0.25, -0.25, 0.0])
        up, out = np.array([0, 0, 3.0]), np.array([0, 0.25, 0])
        faces.append(_Face(front, np.array([0.5, 0, 0]), up, SURFACE))
        faces += [_Face(front + [side, 0, 0], out, up, SURFACE) for side in (0.0, 0.5)]
    for x in np.arange(0.2, _LENGTH_M, 0.4):
        faces += _box((float(x), -1.75, 4.10), (0.12, 0.60, 0.12))
    return faces


def bracketed_facade(
    density: float = 300.0, noise_share: float = 0.02, seed: int = 0
) -> tuple[Points, NDArray[np.uint8]]:
    """Draw the facade with noise.

    Parameters
    ----------
    density : float
        Points per square metre of face.
    noise_share : float
        Share of noise among all points, 0 .. 0.5: a third uniform in the box 1 m round the facade,
        a third 5 to 50 cm off a face along its normal, a third Gaussian (15 cm per axis) about it.
    seed : int

    Returns
    -------
    points : ndarray, shape (n, 3)
        Metres, z up, in random order.
    labels : ndarray, shape (n,)
        uint8: `SURFACE`, `FEATURE`, `NOISE_UNIFORM`, `NOISE_NEAR`, `NOISE_OFFSET`.
    """
    if not (density > 0 and 0 <= noise_share <= 0.5):
        msg = f"density must be > 0 and noise_share in 0..0.5, got {density} and {noise_share}."
        raise InputError(msg)
    rng = np.random.default_rng(seed)
    faces = _faces()
    areas = np.array([np.linalg.norm(face.normal) for face in faces])
    count = int(density * areas.sum())

    def draw(number: int) -> tuple[Points, NDArray[np.int64]]:
        chosen = rng.choice(len(faces), number, p=areas / areas.sum())
        corner, along, across = (
            np.array([getattr(face, name) for face in faces])[chosen]
            for name in ("corner", "along", "across")
        )
        return corner + rng.random((number, 1)) * along + rng.random((number, 1)) * across, chosen

    clean, chosen = draw(count)
    clean += rng.normal(0, _SENSOR_SIGMA_M, clean.shape)
    labels = [np.array([face.label for face in faces])[chosen]]
    third = round(count * noise_share / (1 - noise_share) / 3)
    low, high = clean.min(axis=0) - _MARGIN_M, clean.max(axis=0) + _MARGIN_M
    uniform = rng.uniform(low, high, (third, 3))
    near = draw(third)[0] + rng.normal(0, _NEAR_SIGMA_M, (third, 3))
    offset, chosen = draw(third)
    normals = np.array([face.normal for face in faces])[chosen] / areas[chosen][:, None]
    distance = rng.uniform(*_OFFSET_M, (third, 1)) * rng.choice([-1.0, 1.0], (third, 1))
    labels += [np.full(third, label) for label in NOISE_LABELS]
    points = np.concatenate([clean, uniform, near, offset + distance * normals])
    shuffle = rng.permutation(len(points))
    return points[shuffle], np.concatenate(labels).astype(np.uint8)[shuffle]
