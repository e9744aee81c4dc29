"""Builder of a synthetic scene from solids with materials, lights and a sky."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from training.synthetic.raycast import BALL, BOX, CYLINDER, GROUP, PLAIN

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Look:
    """Material: texture index, texture period in meters, tint, specular weight and emission."""

    texture: int
    period: float
    tint: Vector
    offset: tuple[float, float]
    shine: float = 0.0
    glow: float = 0.0


@dataclass
class Builder:
    """Collector of the solids of a scene, with lengths in meters and z up.

    In all methods, ``at`` is the center of the lower side of a solid in the world.
    """

    rng: np.random.Generator
    textures: int
    """Number of textures."""
    _solids: list[tuple[int, NDArray[Any], NDArray[Any], Look, int, bool]] = field(
        default_factory=list
    )
    lights: list[list[float]] = field(default_factory=list)
    ambient: tuple[Vector, Vector] = ((0.5, 0.5, 0.5), (0.4, 0.4, 0.4))
    sky: NDArray[Any] = field(
        default_factory=lambda: np.array([[0.8] * 3, [0.4, 0.6, 0.9], [0, 0, 1]])
    )

    def look(self, period: tuple[float, float] = (0.3, 3.0), **more: float) -> Look:
        """Draw a material with a random texture, tint and shine."""
        rng = self.rng
        tint = np.clip(rng.uniform(0.4, 1.1) + rng.normal(0, 0.08, 3), 0.05, 1.2)
        shine = rng.uniform(0, 0.8) if rng.random() < 0.25 else 0.0
        values: dict[str, Any] = {"shine": shine, **more}
        x, y = rng.random(2)
        return Look(
            int(rng.integers(self.textures)),
            float(np.exp(rng.uniform(*np.log(period)))),
            tuple(tint),
            (x, y),
            **values,
        )

    def box(
        self, at: ArrayLike, size: ArrayLike, look: Look, yaw: float = 0.0, **more: Any
    ) -> None:
        """Add a box with sides ``size`` in meters, rotated by ``yaw`` (rad) about the vertical."""
        half = np.asarray(size, float) / 2
        self._add(BOX, _lifted(at, half[2]), half, _turn(yaw), look, **more)

    def cylinder(
        self,
        at: ArrayLike,
        radius: float,
        height: float,
        look: Look,
        axis: str = "z",
        yaw: float = 0.0,
    ) -> None:
        """Add a vertical cylinder, or a horizontal one along x that is rotated by ``yaw`` (rad)."""
        half = np.array([radius, radius, height / 2])
        turn = _turn(yaw)
        lift = height / 2
        if axis == "x":
            turn, lift = turn @ np.array([[0, 0, 1.0], [0, 1, 0], [-1, 0, 0]]), radius
        self._add(CYLINDER, _lifted(at, lift), half, turn, look)

    def ball(self, center: ArrayLike, half: ArrayLike, look: Look, yaw: float = 0.0) -> None:
        """Add an ellipsoid with the half axes ``half`` in meters around ``center``."""
        half = np.broadcast_to(np.asarray(half, float), 3)
        self._add(BALL, np.asarray(center, float), half, _turn(yaw), look)

    def tumbled(self, kind: int, center: ArrayLike, half: ArrayLike, look: Look) -> None:
        """Add a solid in a random orientation."""
        q, _ = np.linalg.qr(self.rng.normal(size=(3, 3)))
        self._add(kind, np.asarray(center, float), np.asarray(half, float), q, look)

    def _add(
        self,
        kind: int,
        center: NDArray[Any],
        half: NDArray[Any],
        turn: NDArray[Any],
        look: Look,
        shows: int = PLAIN,
        shadow: bool = True,
    ) -> None:
        half = np.maximum(half, 1e-3)
        frame = np.concatenate([turn, center[:, None]], 1)
        self._solids.append((kind, frame, half, look, shows, shadow))

    @property
    def count(self) -> int:
        """Return the number of solids in the scene."""
        return len(self._solids)

    def lamp(self, at: ArrayLike, strength: float, warmth: float) -> None:
        """Add a point light with a color from blue (warmth -1) to yellow (warmth 1)."""
        colour = strength * np.array([1 + 0.15 * warmth, 1.0, 1 - 0.25 * warmth])
        self.lights.append([*np.asarray(at, float), *colour, 0.0])

    def sun(self, direction: ArrayLike, strength: float) -> None:
        """Add a directional light that shines from ``direction``."""
        d = np.asarray(direction, float)
        self.lights.append(
            [*(d / np.linalg.norm(d)), *(strength * np.array([1.0, 0.95, 0.85])), 1.0]
        )

    def arrays(self, bank: NDArray[np.uint8]) -> tuple[Any, NDArray[Any], NDArray[Any]]:
        """Return the arguments ``scene``, ``shows`` and ``sky`` of :func:`raycast.draw`."""
        n = self.count
        kinds, shows = np.empty(n, np.int64), np.empty(n, np.int64)
        inverses, centers = np.empty((n, 3, 4)), np.empty((n, 3))
        radii, sizes, looks = np.empty(n), np.empty((n, 3)), np.empty((n, 9))
        opaque = []
        for i, (kind, frame, half, look, what, shadow) in enumerate(self._solids):
            kinds[i], shows[i], sizes[i], centers[i] = kind, what, half, frame[:, 3]
            inverses[i, :, :3] = frame[:, :3].T / half[:, None]
            inverses[i, :, 3] = -inverses[i, :, :3] @ frame[:, 3]
            flat = {BOX: half, BALL: half[[half.argmax()]], CYLINDER: half[1:]}[kind]
            radii[i] = np.linalg.norm(flat)
            tint, offset = look.tint, look.offset
            looks[i] = [look.texture, 1 / look.period, *tint, *offset, look.shine, look.glow]
            if shadow:
                opaque.append(i)
        lights = np.array(self.lights, float).reshape(-1, 7)
        solids = (kinds, inverses, centers, radii)
        ambient = np.array(self.ambient)
        shadows = _groups(np.array(opaque, np.int64), centers, radii)
        scene = (solids, sizes, looks, bank, shadows, lights, ambient)
        return scene, shows, np.asarray(self.sky, float)


def _groups(opaque: NDArray[Any], centers: NDArray[Any], radii: NDArray[Any]) -> tuple[Any, ...]:
    """Compute the bounding spheres of groups of consecutive solids, which are close in space."""
    runs = [opaque[k : k + GROUP] for k in range(0, len(opaque), GROUP)]
    middles = np.array([centers[run].mean(0) for run in runs]).reshape(-1, 3)
    reach = [
        (np.linalg.norm(centers[run] - middle, axis=1) + radii[run]).max()
        for run, middle in zip(runs, middles, strict=True)
    ]
    return opaque, middles, np.array(reach)


def _lifted(at: ArrayLike, height: float) -> NDArray[Any]:
    return np.add(at, (0.0, 0.0, height))


def _turn(yaw: float) -> NDArray[Any]:
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
