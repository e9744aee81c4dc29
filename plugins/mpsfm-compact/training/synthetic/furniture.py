"""Functions ``(builder, x, y, yaw)`` that add a piece of furniture of random size.

The back of the furniture is at ``(x, y)`` in meters, and the front faces the direction ``yaw``
(rad). All pieces have the size of real furniture.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from training.synthetic.builder import Builder, Look
from training.synthetic.raycast import BALL, BOX, CYLINDER

Furniture = Callable[[Builder, float, float, float], None]


class Frame:
    """Coordinate frame of a piece of furniture, with u along the wall and v away from the wall."""

    def __init__(self, build: Builder, x: float, y: float, yaw: float) -> None:
        self.build, self.x, self.y, self.yaw = build, x, y, yaw

    def at(self, u: float, v: float, z: float) -> NDArray[np.float64]:
        """Convert a point from furniture coordinates (u, v, z) to world coordinates."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.array([self.x - s * u + c * v, self.y + c * u + s * v, z])

    def box(
        self,
        u: float,
        v: float,
        z: float,
        w: float,
        d: float,
        h: float,
        look: Look,
        turn: float = 0,
    ) -> None:
        """Add a box by its width along the wall, its depth away from the wall, and its height."""
        self.build.box(self.at(u, v, z), (d, w, h), look, self.yaw + turn)

    def pole(self, u: float, v: float, z: float, r: float, h: float, look: Look) -> None:
        """Add a vertical cylinder in furniture coordinates."""
        self.build.cylinder(self.at(u, v, z), r, h, look)

    def ball(
        self, u: float, v: float, z: float, half: tuple[float, float, float], look: Look
    ) -> None:
        """Add an ellipsoid."""
        self.build.ball(self.at(u, v, z), half, look, self.yaw)


def _between(b: Builder, low: float, high: float) -> float:
    return float(b.rng.uniform(low, high))


def clutter(f: Frame, u: float, v: float, z: float, largest: float = 0.35) -> None:
    """Add a small object on a horizontal surface."""
    b, look = f.build, f.build.look((0.05, 0.5))
    kind = b.rng.integers(6)
    r, h = _between(b, 0.02, largest / 3), _between(b, 0.04, largest)
    if kind == 0:  # box or book
        f.box(
            u,
            v,
            z,
            _between(b, 0.05, largest),
            _between(b, 0.05, largest),
            h * 0.6,
            look,
            _between(b, 0, 3),
        )
    elif kind == 1:  # bottle
        f.pole(u, v, z, r, h, look)
        f.pole(u, v, z + h, r * 0.35, h * 0.35, look)
    elif kind == 2:  # mug or tin
        f.pole(u, v, z, r, r * 2.2, look)
    elif kind == 3:  # bowl, fruit
        f.ball(u, v, z + r, (r, r, r), look)
    elif kind == 4:  # pile of paper and books
        for k in range(b.rng.integers(1, 6)):
            f.box(
                u, v, z + 0.03 * k, 0.25, 0.18, 0.028, b.look((0.05, 0.5)), _between(b, -0.3, 0.3)
            )
    else:  # lamp
        f.pole(u, v, z, 0.01, h, look)
        f.ball(u, v, z + h, (r * 1.5, r * 1.5, r), b.look(glow=_between(b, 0, 1)))


def _scatter(f: Frame, z: float, width: float, v0: float, v1: float, max_objects: int) -> None:
    for _ in range(f.build.rng.integers(0, max_objects + 1)):
        clutter(f, _between(f.build, -width / 2, width / 2), _between(f.build, v0, v1), z)


def table(b: Builder, x: float, y: float, yaw: float) -> None:
    """Add a table with objects on its top."""
    f, top, leg = Frame(b, x, y, yaw), b.look(), b.look()
    w, d, h = _between(b, 0.6, 2.0), _between(b, 0.5, 1.0), _between(b, 0.4, 0.78)
    f.box(0, d / 2, h - 0.04, w, d, 0.04, top)
    if b.rng.random() < 0.25:
        f.pole(0, d / 2, 0, 0.05, h - 0.04, leg)
        f.pole(0, d / 2, 0, 0.25, 0.03, leg)
    else:
        t = _between(b, 0.03, 0.08)
        for u in (-w / 2 + t, w / 2 - t):
            for v in (t, d - t):
                f.box(u, v, 0, t, t, h - 0.04, leg)
    _scatter(f, h, w * 0.9, 0.05, d - 0.05, 8)
    for _ in range(b.rng.integers(0, 3)):
        u = _between(b, -w / 2, w / 2)
        chair(b, *f.at(u, d + _between(b, 0, 0.5), 0)[:2], yaw + _between(b, 2.2, 4.0))


def desk(b: Builder, x: float, y: float, yaw: float) -> None:
    """Build a desk."""
    f, top, side = Frame(b, x, y, yaw), b.look(), b.look()
    w, d, h = _between(b, 1.0, 1.8), _between(b, 0.6, 0.8), _between(b, 0.7, 0.78)
    f.box(0, d / 2, h - 0.03, w, d, 0.03, top)
    f.box(-w / 2 + 0.2, d / 2, 0, 0.4, d * 0.95, h - 0.03, side)
    f.box(w / 2 - 0.02, d / 2, 0, 0.03, d * 0.95, h - 0.03, side)
    dark = b.look(shine=0.6)
    dark = Look(dark.texture, 5.0, (0.08, 0.08, 0.09), dark.offset, 0.5, _between(b, 0, 0.3))
    for u in np.arange(b.rng.integers(0, 3)) * 0.62 - 0.2:
        f.box(u, 0.2, h, 0.25, 0.18, 0.02, dark)
        f.box(u, 0.2, h, 0.05, 0.04, 0.2, dark)
        f.box(u, 0.24, h + 0.12, _between(b, 0.4, 0.62), 0.04, _between(b, 0.26, 0.38), dark)
        f.box(u, 0.55, h, 0.44, 0.14, 0.02, b.look())
    _scatter(f, h, w * 0.9, 0.1, d - 0.05, 8)
    if b.rng.random() < 0.8:
        office_chair(
            b, *f.at(_between(b, -0.4, 0.4), d + _between(b, 0.0, 0.5), 0)[:2], _between(b, 0, 6.3)
        )


def chair(b: Builder, x: float, y: float, yaw: float) -> None:
    """Build a chair."""
    f, look = Frame(b, x, y, yaw), b.look()
    seat = b.look() if b.rng.random() < 0.5 else look
    h, w = _between(b, 0.42, 0.48), _between(b, 0.38, 0.48)
    f.box(0, w / 2, h - 0.04, w, w, 0.04, seat)
    for u in (-w / 2 + 0.02, w / 2 - 0.02):
        f.box(u, w - 0.02, 0, 0.035, 0.035, h - 0.04, look)
        f.box(u, 0.02, 0, 0.035, 0.035, h + _between(b, 0.35, 0.5), look)
    for z in (h + 0.12, h + 0.28)[: b.rng.integers(1, 3)]:
        f.box(0, 0.02, z, w - 0.04, 0.025, _between(b, 0.06, 0.2), seat)


def office_chair(b: Builder, x: float, y: float, yaw: float) -> None:
    """Add an office chair."""
    f, look, dark = Frame(b, x, y, yaw), b.look(), b.look()
    f.pole(0, 0.25, 0.06, 0.03, 0.38, dark)
    for turn in range(5):
        f.box(
            0.14 * np.cos(turn * 1.257),
            0.25 + 0.14 * np.sin(turn * 1.257),
            0.05,
            0.05,
            0.28,
            0.04,
            dark,
            turn * 1.257 + 1.57,
        )
    f.box(0, 0.25, 0.44, 0.48, 0.48, 0.08, look)
    f.box(0, 0.02, 0.58, 0.44, 0.06, _between(b, 0.4, 0.65), look)


def sofa(b: Builder, x: float, y: float, yaw: float) -> None:
    """Build a sofa."""
    f, look = Frame(b, x, y, yaw), b.look()
    w, d = _between(b, 0.9, 2.4), _between(b, 0.8, 1.0)
    f.box(0, d / 2, 0.06, w, d, 0.34, look)
    f.box(0, 0.12, 0.3, w, 0.22, _between(b, 0.4, 0.6), look)
    for u in (-w / 2, w / 2):
        f.box(u, d / 2, 0.06, 0.2, d, _between(b, 0.5, 0.6), look)
    for _ in range(b.rng.integers(0, 5)):
        f.ball(_between(b, -w / 2, w / 2), 0.35, 0.55, (0.1, 0.22, 0.2), b.look((0.1, 0.6)))


def bed(b: Builder, x: float, y: float, yaw: float) -> None:
    """Build a bed."""
    f, frame = Frame(b, x, y, yaw), b.look()
    w, d = _between(b, 0.9, 1.9), 2.05
    f.box(0, 0.03, 0, w + 0.1, 0.06, _between(b, 0.6, 1.2), frame)
    f.box(0, d / 2, 0.1, w, d, 0.2, frame)
    f.box(0, d / 2 + 0.03, 0.3, w - 0.03, d - 0.06, _between(b, 0.12, 0.25), b.look())
    f.box(0, d / 2 + 0.35, 0.35, w + 0.06, d - 0.7, 0.18, b.look())
    for u in (-w / 4, w / 4):
        f.ball(u, 0.35, 0.58, (0.2, w / 5, 0.09), b.look())


def cabinet(b: Builder, x: float, y: float, yaw: float) -> None:
    """Build a cabinet."""
    f, look, knob = Frame(b, x, y, yaw), b.look(), b.look()
    w, d, h = _between(b, 0.4, 2.2), _between(b, 0.3, 0.65), _between(b, 0.4, 2.2)
    f.box(0, d / 2, 0, w, d, h, look)
    front = look if b.rng.random() < 0.5 else b.look()
    across, down = max(1, round(w / _between(b, 0.35, 0.7))), int(b.rng.integers(1, 5))
    for i in range(across):
        for j in range(down):
            pw, ph = w / across, (h - 0.06) / down
            u, z = -w / 2 + (i + 0.5) * pw, 0.05 + j * ph
            f.box(u, d, z + 0.01, pw - 0.015, 0.03, ph - 0.015, front)
            f.ball(u + pw * 0.3, d + 0.03, z + ph / 2, (0.015, 0.015, 0.015), knob)
    if h < 1.3:
        _scatter(f, h, w * 0.9, 0.05, d - 0.05, 5)


def shelves(b: Builder, x: float, y: float, yaw: float) -> None:
    """Add shelves with objects."""
    f, look = Frame(b, x, y, yaw), b.look()
    w, d, levels = _between(b, 0.5, 1.8), _between(b, 0.22, 0.4), int(b.rng.integers(2, 7))
    gap = _between(b, 0.28, 0.42)
    for u in (-w / 2, w / 2):
        f.box(u, d / 2, 0, 0.025, d, levels * gap + 0.03, look)
    f.box(0, 0.01, 0, w, 0.015, levels * gap, look)
    for level in range(levels + 1):
        z = level * gap
        f.box(0, d / 2, z, w, d, 0.022, look)
        u = -w / 2 + 0.03
        while level < levels and u < w / 2 - 0.08:
            if b.rng.random() < 0.75:
                t = _between(b, 0.015, 0.06) * (1 if b.rng.random() < 0.8 else 3)
                deep = _between(b, 0.6, 0.95) * d
                f.box(
                    u + t / 2,
                    deep / 2,
                    z + 0.022,
                    t,
                    deep,
                    gap * _between(b, 0.5, 0.9),
                    b.look((0.05, 0.3)),
                )
                u += t
            else:
                u += _between(b, 0.05, 0.25)


def counter(b: Builder, x: float, y: float, yaw: float) -> None:
    """Add a kitchen counter."""
    f, front, top = Frame(b, x, y, yaw), b.look(), b.look((0.2, 1.5), shine=0.3)
    units = int(b.rng.integers(2, 6))
    w = units * 0.6
    f.box(0, 0.3, 0.08, w, 0.58, 0.78, front)
    f.box(0, 0.31, 0.86, w, 0.64, 0.04, top)
    high = b.rng.random() < 0.7
    for i in range(units):
        u = -w / 2 + 0.3 + 0.6 * i
        if b.rng.random() < 0.3:  # oven or dishwasher
            glass = b.look(shine=0.7)
            f.box(
                u, 0.6, 0.12, 0.56, 0.02, 0.6, Look(glass.texture, 4, (0.1, 0.1, 0.1), (0, 0), 0.7)
            )
        else:
            f.box(u, 0.6, 0.1, 0.57, 0.02, 0.72, front)
        if high and b.rng.random() < 0.85:
            f.box(u, 0.17, 1.4, 0.59, 0.33, 0.72, front)
    f.pole(_between(b, -w / 3, w / 3), 0.12, 0.9, 0.012, 0.3, b.look(shine=0.8))
    _scatter(f, 0.9, w * 0.95, 0.1, 0.55, 10)


def fridge(b: Builder, x: float, y: float, yaw: float) -> None:
    """Build a fridge."""
    f, look = Frame(b, x, y, yaw), b.look((1, 4), shine=0.4)
    h = _between(b, 0.85, 2.0)
    f.box(0, 0.33, 0, 0.62, 0.64, h, look)
    f.box(0, 0.66, h * 0.35, 0.6, 0.03, h * 0.63, look)
    f.box(0.25, 0.7, h * 0.45, 0.02, 0.03, 0.4, b.look())


def plant(b: Builder, x: float, y: float, yaw: float) -> None:
    """Add a plant in a pot."""
    f, leaf = Frame(b, x, y, yaw), b.look((0.05, 0.3))
    h, r = _between(b, 0.3, 1.6), _between(b, 0.1, 0.22)
    f.pole(0, 0.25, 0, r, r * 1.8, b.look())
    f.pole(0, 0.25, 0, 0.015, h, b.look())
    green = Look(leaf.texture, leaf.period, (0.25, _between(b, 0.4, 0.7), 0.2), leaf.offset)
    for _ in range(b.rng.integers(6, 25)):
        c = f.at(0, 0.25, h) + b.rng.normal(0, (0.15, 0.15, h / 5))
        b.tumbled(BALL, c, (_between(b, 0.03, 0.14), _between(b, 0.02, 0.06), 0.006), green)


def floor_lamp(b: Builder, x: float, y: float, yaw: float) -> None:
    """Add a floor lamp."""
    f, look = Frame(b, x, y, yaw), b.look()
    h = _between(b, 1.2, 1.8)
    f.pole(0, 0.2, 0, 0.14, 0.03, look)
    f.pole(0, 0.2, 0, 0.012, h, look)
    f.pole(0, 0.2, h - 0.1, _between(b, 0.1, 0.22), 0.28, b.look(glow=_between(b, 0.2, 1.2)))


def heap(b: Builder, x: float, y: float, yaw: float) -> None:
    """Add a heap of boxes."""
    f = Frame(b, x, y, yaw)
    for _ in range(b.rng.integers(1, 6)):
        size = b.rng.uniform(0.12, 0.55, 3)
        u, v = _between(b, -0.5, 0.5), _between(b, 0.2, 0.8)
        f.box(u, v, 0, *size, b.look((0.1, 1)), _between(b, 0, 3))
        if b.rng.random() < 0.3:
            f.box(u, v, size[2], *(size * 0.7), b.look((0.1, 1)), _between(b, 0, 3))


def radiator(b: Builder, x: float, y: float, yaw: float) -> None:
    """Build a radiator."""
    f, look = Frame(b, x, y, yaw), b.look((1, 4))
    n, h = int(b.rng.integers(6, 20)), _between(b, 0.4, 0.8)
    for i in range(n):
        f.box((i - n / 2) * 0.06, 0.08, 0.12, 0.045, 0.1, h, look)


def person(b: Builder, x: float, y: float, yaw: float) -> None:
    """Build a person."""
    f, top, legs, skin = Frame(b, x, y, yaw), b.look((0.1, 1)), b.look((0.1, 1)), b.look((0.5, 2))
    h = _between(b, 1.5, 1.9)
    v = 0.4
    for u in (-0.1, 0.1):
        f.pole(u, v, 0, 0.075, h * 0.48, legs)
    f.ball(0, v, h * 0.66, (0.13, 0.2, h * 0.21), top)
    for u in (-0.24, 0.24):
        f.ball(u, v + 0.03, h * 0.62, (0.06, 0.055, h * 0.18), top)
    f.ball(0, v, h * 0.93, (0.1, 0.085, 0.12), Look(skin.texture, 2, (0.8, 0.6, 0.5), (0, 0)))


def screen(b: Builder, x: float, y: float, yaw: float) -> None:
    """Add a television on a low board."""
    f, w = Frame(b, x, y, yaw), _between(b, 0.7, 1.5)
    f.box(0, 0.22, 0, w * 1.2, 0.4, 0.45, b.look())
    f.box(0, 0.2, 0.5, w, 0.05, w * 0.56, Look(0, 5, (0.05, 0.05, 0.06), (0, 0), 0.8))


def odd(b: Builder, x: float, y: float, yaw: float) -> None:
    """Add a sculpture made of solids in random orientations."""
    f = Frame(b, x, y, yaw)
    look = b.look()
    for _ in range(b.rng.integers(1, 7)):
        half = b.rng.uniform(0.03, 0.35, 3)
        center = f.at(_between(b, -0.4, 0.4), _between(b, 0.2, 0.8), _between(b, 0.1, 1.3))
        kind = int(b.rng.choice([BOX, BALL, CYLINDER]))
        half[1] = half[0] if kind == CYLINDER else half[1]
        b.tumbled(kind, center, half, look if b.rng.random() < 0.5 else b.look())


FURNITURE: tuple[Furniture, ...] = (
    table, table, desk, desk, chair, office_chair, sofa, sofa, bed, cabinet, cabinet, cabinet,
    shelves, shelves, counter, counter, fridge, plant, floor_lamp, heap, radiator, person, screen,
    odd,
)  # fmt: skip
