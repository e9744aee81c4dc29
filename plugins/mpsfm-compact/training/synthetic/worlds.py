"""Synthetic rooms, streets and table tops, and random camera poses in them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from training.synthetic.builder import Builder, Look
from training.synthetic.furniture import FURNITURE, Frame, clutter, person
from training.synthetic.raycast import BALL, BOX, CYLINDER, MIRROR, WINDOW


@dataclass(frozen=True)
class Shot:
    """Camera center, rotation world_from_camera (3, 3), and focal length over image diagonal."""

    origin: NDArray[np.float64]
    rotation: NDArray[np.float64]
    focal: float


World = Callable[[Builder], Callable[[], Shot]]
"""Function that adds a scene to a builder, and returns a function that draws random cameras."""


def room(b: Builder) -> Callable[[], Shot]:
    """Build a furnished room with windows, doors and pictures."""
    rng = b.rng
    (length, width), height = _floor_plan(rng)
    _sky(b)
    walls = b.look((1, 5))
    ceiling = Look(b.look().texture, 5, tuple(rng.uniform(0.7, 1.1) * np.ones(3)), (0, 0))
    shell = {"shadow": False}
    b.box((0, 0, -0.1), (length + 1, width + 1, 0.1), b.look((0.4, 3)), **shell)
    b.box((0, 0, height), (length + 1, width + 1, 0.1), ceiling, **shell)
    sides = [(length / 2, 0, np.pi, width), (0, width / 2, -np.pi / 2, length)]
    sides += [(-length / 2, 0, 0.0, width), (0, -width / 2, np.pi / 2, length)]
    skirting = b.look((1, 5))
    for x, y, yaw, wide in sides:
        look = walls if rng.random() < 0.6 else b.look((0.5, 4))
        f = Frame(b, x, y, yaw)
        b.box(f.at(0, -0.05, 0), (0.1, wide + 0.2, height), look, yaw, **shell)
        f.box(0, 0.008, 0, wide, 0.016, 0.1, skirting)
        _wall(b, f, wide, height)
    if rng.random() < 0.3:
        for u in np.arange(-length / 2 + 0.5, length / 2, rng.uniform(0.7, 1.5)):
            b.box((u, 0, height - 0.18), (0.14, width, 0.18), skirting)
    for _ in range(rng.integers(0, 3)):
        spot = (rng.uniform(-0.3, 0.3) * length, rng.uniform(-0.3, 0.3) * width)
        b.box(
            (*spot, 0.0),
            (rng.uniform(0.6, 2.5), rng.uniform(0.6, 2.5), 0.012),
            b.look(),
            rng.uniform(0, 3),
        )
        if rng.random() < 0.5:
            drop = rng.uniform(0.3, 1.0)
            b.cylinder((*spot, height - drop), 0.006, drop, skirting)
            b.ball(
                (*spot, height - drop), rng.uniform(0.08, 0.25), b.look(glow=rng.uniform(0, 1.5))
            )
    dense = rng.uniform(0.4, 1.0)
    for x, y, yaw, wide in sides:
        along = -wide / 2 + rng.uniform(0.2, 0.9)
        while along < wide / 2 - 0.3:
            if rng.random() < dense:
                f = Frame(b, x, y, yaw)
                place = f.at(along, 0.03 + (0 if rng.random() < 0.8 else rng.uniform(0, 0.6)), 0)
                FURNITURE[rng.integers(len(FURNITURE))](b, place[0], place[1], yaw)
            along += rng.uniform(0.7, 1.9)
    for _ in range(rng.integers(0, 1 + int(length * width / 8))):
        at = rng.uniform(-0.35, 0.35, 2) * (length, width)
        FURNITURE[rng.integers(len(FURNITURE))](b, at[0], at[1], rng.uniform(0, 6.28))
    warmth = rng.uniform(-0.5, 1)
    for _ in range(rng.integers(1, 4)):
        at = rng.uniform(-0.4, 0.4, 2) * (length, width)
        b.lamp((*at, height - rng.uniform(0.1, 0.6)), rng.uniform(0.4, 2.0), warmth)
    level = rng.uniform(0.15, 0.6)
    b.ambient = ((level,) * 3, (level * rng.uniform(0.5, 1),) * 3)

    def shoot() -> Shot:
        at = rng.uniform(-0.46, 0.46, 2) * (length, width)
        to = rng.uniform(-0.5, 0.5, 2) * (length, width)
        if rng.random() < 0.5:  # indoor images are mostly taken from near a wall
            longer = int(width > length)
            end = rng.choice([-1.0, 1.0]) * (length, width)[longer]
            at[longer], to[longer] = rng.uniform(0.2, 0.46) * end, -rng.uniform(0, 0.5) * end
        high = rng.uniform(1.2, 1.75) if rng.random() < 0.65 else rng.uniform(0.6, 2.0)
        eye = np.array([*at, min(high, height - 0.3)])
        goal = np.array([*to, rng.uniform(0, 1.8)])
        if np.linalg.norm(goal - eye) < 0.5:
            goal[:2] = -at
        return _aimed(rng, eye, goal)

    return shoot


def _floor_plan(rng: np.random.Generator) -> tuple[tuple[float, float], float]:
    """Draw length, width and height in meters of a closet, a room, a hall or a corridor."""
    kind = rng.choice(5, p=(0.12, 0.46, 0.22, 0.1, 0.1))
    low, high = ((1.8, 3.5), (3.0, 6.5), (4.5, 10.0), (8.0, 18.0), (5.0, 20.0))[kind]
    length, width = rng.uniform(low, high, 2)
    if kind == 4:
        width = rng.uniform(1.2, 2.6)
    height = rng.uniform(2.7, 6.0) if kind == 3 else rng.uniform(2.3, 3.3)
    sides = (length, width) if rng.random() < 0.5 else (width, length)
    return sides, height


def street(b: Builder) -> Callable[[], Shot]:
    """Build house fronts around a street or court, with trees, cars, columns and people."""
    rng = b.rng
    _sky(b)
    b.box((0, 0, -1), (400, 400, 1), b.look((0.5, 5)), shadow=False)
    b.box((0, 0, 0), (rng.uniform(3, 12), 300, 0.005), b.look((1, 6)), shadow=False)
    depth = rng.uniform(4, 25)
    fronts = [(depth, 0.0, np.pi)]
    if rng.random() < 0.7:
        fronts.append((-rng.uniform(6, 30), 0.0, 0.0))
    if rng.random() < 0.6:
        fronts.append((0.0, rng.uniform(10, 40), -np.pi / 2))
    for x, y, yaw in fronts:
        f, along = Frame(b, x, y, yaw), -rng.uniform(8, 20)
        while along < 15 and b.count < 900:
            wide = rng.uniform(5, 18)
            if rng.random() < 0.9:
                _house(b, f, along + wide / 2, wide)
            along += wide + (0 if rng.random() < 0.6 else rng.uniform(0.5, 5))
    for _ in range(rng.integers(2, 12)):
        at = np.array([rng.uniform(-4, depth - 1), rng.uniform(-12, 14)])
        _THINGS[rng.integers(len(_THINGS))](b, at[0], at[1])
    up = np.array([*rng.normal(size=2), rng.uniform(0.3, 1.5)])
    b.sun(up, rng.uniform(0.0, 1.3) if rng.random() < 0.8 else 0.0)
    level = rng.uniform(0.4, 0.8)
    b.ambient = ((level * 0.95, level, level * 1.1), (level * 0.5,) * 3)

    def shoot() -> Shot:
        eye = np.array([rng.uniform(-3, depth * 0.8), rng.uniform(-8, 8), rng.uniform(1.0, 2.2)])
        if rng.random() < 0.1:
            eye[2] = rng.uniform(2, 10)
        goal = np.array([depth, eye[1] + rng.normal(0, depth * 0.6), rng.uniform(0.3, 6)])
        if rng.random() < 0.25:
            goal = eye + np.array([*rng.normal(size=2), rng.normal(0, 0.2)]) * 10
        return _aimed(rng, eye, goal)

    return shoot


def table_top(b: Builder) -> Callable[[], Shot]:
    """Build objects on a table or floor for close-up views."""
    rng = b.rng
    _sky(b)
    b.box((0, 0, -0.05), (rng.uniform(0.6, 3), rng.uniform(0.6, 3), 0.05), b.look((0.2, 2)))
    b.box((0, 0, -0.9), (8, 8, 0.1), b.look((0.4, 3)), shadow=False)
    for x, y, yaw in ((3, 0, np.pi), (0, 3, -np.pi / 2), (-3, 0, 0.0), (0, -3, np.pi / 2)):
        f = Frame(b, x * rng.uniform(0.3, 1), y * rng.uniform(0.3, 1), yaw)
        b.box(f.at(0, -0.05, -0.8), (0.1, 8, 3), b.look((0.5, 4)), yaw, shadow=False)
    f = Frame(b, 0, 0, rng.uniform(0, 6.3))
    for _ in range(rng.integers(3, 25)):
        spread = rng.uniform(0.1, 0.6)
        clutter(f, rng.normal(0, spread), rng.normal(0, spread), 0.0)
    for _ in range(rng.integers(0, 6)):
        half = rng.uniform(0.02, 0.15, 3)
        kind = int(rng.choice([BOX, BALL, CYLINDER]))
        half[1] = half[0] if kind == CYLINDER else half[1]
        b.tumbled(kind, [*rng.normal(0, 0.3, 2), half.max() * 0.7], half, b.look((0.05, 0.5)))
    for _ in range(rng.integers(1, 3)):
        b.lamp(
            (*rng.uniform(-1.5, 1.5, 2), rng.uniform(0.8, 1.8)),
            rng.uniform(0.3, 1.2),
            rng.uniform(-0.5, 1),
        )
    level = rng.uniform(0.2, 0.6)
    b.ambient = ((level,) * 3, (level * 0.7,) * 3)

    def shoot() -> Shot:
        turn, tilt, far = rng.uniform(0, 6.28), rng.uniform(0.15, 1.2), rng.uniform(0.4, 1.6)
        eye = far * np.array(
            [np.cos(turn) * np.cos(tilt), np.sin(turn) * np.cos(tilt), np.sin(tilt)]
        )
        return _aimed(rng, eye, np.array([*rng.normal(0, 0.15, 2), rng.uniform(0, 0.15)]))

    return shoot


WORLDS: tuple[tuple[World, float], ...] = ((room, 0.68), (street, 0.22), (table_top, 0.1))
"""Functions that build a scene, and the share of each in the samples."""


def _aimed(rng: np.random.Generator, eye: NDArray[np.float64], goal: NDArray[np.float64]) -> Shot:
    """Create a camera that is aimed at ``goal`` with hand-held errors and a random focal length."""
    forward = (goal - eye) / np.linalg.norm(goal - eye)
    forward = forward + rng.normal(0, 0.05, 3)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1.0])
    right /= max(np.linalg.norm(right), 1e-6)
    down = np.cross(forward, right)
    roll = rng.normal(0, 0.06)
    frame = np.stack([right, down, forward], 1)
    c, s = np.cos(roll), np.sin(roll)
    turned = frame @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return Shot(eye, turned, float(np.exp(rng.uniform(np.log(0.45), np.log(1.15)))))


def _sky(b: Builder) -> None:
    rng = b.rng
    grey = rng.uniform(0.5, 1.2)
    blue = np.array([0.35, 0.55, 0.95]) * rng.uniform(0.5, 1.2)
    zenith = blue if rng.random() < 0.6 else np.ones(3) * grey
    sun = rng.normal((0.0, 0.0, 1.0))
    b.sky = np.array([np.ones(3) * grey, zenith, sun / np.linalg.norm(sun)])


def _wall(b: Builder, f: Frame, wide: float, height: float) -> None:
    """Add windows, doors, pictures, mirrors, boards or curtains to a wall."""
    rng = b.rng
    frame = b.look((1, 5))
    for _ in range(rng.integers(0, 4)):
        u = rng.uniform(-wide / 2 + 0.3, wide / 2 - 0.3)
        kind = rng.choice(
            ["window", "door", "picture", "mirror", "board", "curtain"],
            p=[0.25, 0.2, 0.3, 0.06, 0.09, 0.1],
        )
        if kind == "door":
            w, h = rng.uniform(0.75, 1.0), rng.uniform(1.95, 2.15)
            f.box(u, 0.015, 0, w + 0.16, 0.03, h + 0.08, frame)
            f.box(u, 0.03, 0, w, 0.025, h, b.look((1, 4)))
            f.ball(u + w * 0.42, 0.09, 1.05, (0.03, 0.05, 0.012), b.look(shine=0.8))
            continue
        if kind == "curtain":
            look, w = b.look((0.2, 2)), rng.uniform(0.3, 1.0)
            for k in range(int(w / 0.07)):
                f.pole(u + 0.07 * k, 0.1, 0.05, rng.uniform(0.035, 0.06), height * 0.88, look)
            continue
        w, h = rng.uniform(0.3, 1.6), rng.uniform(0.3, 1.3)
        z = min(rng.uniform(0.7, 1.7), max(height - h - 0.1, 0.3))
        f.box(u, 0.02, z - 0.04, w + 0.08, 0.04, h + 0.08, frame)
        pane = (0.045, w, h)
        if kind == "window":
            b.box(f.at(u, 0.023, z), pane, frame, f.yaw, shows=WINDOW, shadow=False)
            f.box(u, 0.03, z, 0.04, 0.05, h, frame)
            f.box(u, 0.03, z + h / 2, w, 0.05, 0.04, frame)
            if rng.random() < 0.6:
                f.box(u, 0.12, z - 0.07, w + 0.2, 0.24, 0.03, frame)
                b.lamp(f.at(u, 0.6, z + h / 2), rng.uniform(0, 1.5), -0.5)
        elif kind == "mirror":
            b.box(f.at(u, 0.023, z), pane, frame, f.yaw, shows=MIRROR)
        elif kind == "board":
            depth = rng.uniform(0.15, 0.35)
            f.box(u, depth / 2, z, w, depth, 0.025, frame)
            for _ in range(rng.integers(1, 7)):
                clutter(f, u + rng.uniform(-w / 2, w / 2), depth / 2, z + 0.025, 0.25)
        else:
            b.box(f.at(u, 0.023, z), pane, b.look((w, 1.5 * w)), f.yaw)


def _house(b: Builder, f: Frame, u: float, wide: float) -> None:
    rng = b.rng
    floors, storey = int(rng.integers(1, 6)), rng.uniform(2.7, 4.2)
    high, deep = floors * storey + rng.uniform(0, 1), rng.uniform(5, 12)
    ahead = rng.uniform(-1.5, 1.5) if rng.random() < 0.5 else 0.0
    wall, trim, glass = b.look((1, 6)), b.look((1, 4)), b.look(shine=0.5)
    f.box(u, ahead - deep / 2, 0, wide, deep, high, wall)
    across = max(1, int(wide / rng.uniform(1.8, 3.5)))
    w, h = rng.uniform(0.7, 1.3), rng.uniform(1.0, 2.0)
    out = rng.uniform(-0.02, 0.12)
    arches = rng.random() < 0.3
    for level in range(floors):
        for k in range(across):
            at, z = u - wide / 2 + (k + 0.5) * wide / across, level * storey + rng.uniform(0.9, 1.0)
            if level == 0 and rng.random() < 0.3:
                f.box(at, ahead + 0.02, 0, w * 1.2, 0.1, 2.3, b.look((1, 4)))
                continue
            pane = (0.05, w, h)
            shows = {"shows": WINDOW} if rng.random() < 0.15 else {}
            b.box(f.at(at, ahead, z), pane, glass, f.yaw, **shows)
            for side in (-1, 1):
                f.box(at + side * w / 2, ahead + out / 2, z - 0.1, 0.14, 0.14 + out, h + 0.2, trim)
            f.box(at, ahead + out / 2, z - 0.14, w + 0.3, 0.22 + out, 0.1, trim)
            f.box(at, ahead + out / 2, z + h, w + 0.3, 0.16 + out, 0.14, trim)
            if arches:
                f.ball(at, ahead, z + h + 0.1, (0.12, w / 2, w / 2), trim)
        if rng.random() < 0.5:
            f.box(u, ahead + 0.1, (level + 1) * storey - 0.2, wide, 0.3, 0.2, trim)
    if rng.random() < 0.3:
        for k in range(across + 1):
            f.pole(
                u - wide / 2 + k * wide / across,
                ahead + 0.3,
                0,
                rng.uniform(0.15, 0.35),
                high * 0.9,
                trim,
            )
    if rng.random() < 0.5:  # a niche with figures in relief
        for _ in range(rng.integers(2, 12)):
            at = f.at(u + rng.normal(0, wide / 6), ahead + 0.1, rng.uniform(0.3, high))
            b.tumbled(BALL, at, rng.uniform(0.1, 0.7, 3), trim)


def _tree(b: Builder, x: float, y: float) -> None:
    rng, leaf = b.rng, b.look((0.2, 1.5))
    high, green = (
        rng.uniform(2, 8),
        Look(leaf.texture, leaf.period, (0.3, rng.uniform(0.35, 0.6), 0.2), (0, 0)),
    )
    b.cylinder((x, y, 0), rng.uniform(0.06, 0.3), high * 0.7, b.look((0.2, 1)))
    for _ in range(rng.integers(5, 40)):
        at = np.array([x, y, high * 0.75]) + rng.normal(0, high * 0.15, 3)
        b.tumbled(BALL, at, rng.uniform(0.05, 0.16, 3) * high, green)


def _car(b: Builder, x: float, y: float) -> None:
    look, yaw = b.look((2, 6), shine=0.5), b.rng.uniform(0, 6.28)
    f = Frame(b, x, y, yaw)
    f.box(0, 0, 0.3, 4.2, 1.75, 0.55, look)
    f.box(-0.1, 0, 0.8, 2.3, 1.55, 0.6, b.look(shine=0.7))
    for u in (-1.3, 1.3):
        for v in (-0.8, 0.8):
            b.cylinder(f.at(u, v, 0), 0.32, 0.2, b.look((1, 3)), axis="x", yaw=yaw)


def _column(b: Builder, x: float, y: float) -> None:
    rng, stone = b.rng, b.look((0.5, 3))
    r, h = rng.uniform(0.15, 0.6), rng.uniform(1.5, 6)
    b.box((x, y, 0), (3 * r, 3 * r, 0.5), stone)
    b.cylinder((x, y, 0.5), r, h, stone)
    for _ in range(rng.integers(1, 8)):
        at = rng.normal((x, y, h + 0.5), (0.25, 0.25, 0.4))
        b.tumbled(BALL, at, rng.uniform(0.08, 0.4, 3), stone)


def _basin(b: Builder, x: float, y: float) -> None:
    rng, stone = b.rng, b.look((0.5, 3))
    r, z = rng.uniform(1.0, 3.5), 0.0
    for _ in range(rng.integers(1, 4)):
        h = rng.uniform(0.3, 0.9)
        b.cylinder((x, y, z), r, h, stone)
        z, r = z + h, r * rng.uniform(0.3, 0.7)
    _column(b, x, y)


def _wall_or_fence(b: Builder, x: float, y: float) -> None:
    rng, yaw = b.rng, b.rng.uniform(0, 6.28)
    f, wide, high = Frame(b, x, y, yaw), rng.uniform(2, 8), rng.uniform(0.4, 2)
    if rng.random() < 0.5:
        f.box(0, 0, 0, wide, 0.25, high, b.look())
        return
    look = b.look()
    for k in range(int(wide / 0.25)):
        f.pole(0.25 * k, 0, 0, 0.025, high, look)
    f.box(wide / 2, 0, high * 0.9, wide, 0.05, 0.05, look)


def _passer_by(b: Builder, x: float, y: float) -> None:
    person(b, x, y, b.rng.uniform(0, 6.28))


def _steps(b: Builder, x: float, y: float) -> None:
    rng, look = b.rng, b.look()
    f, wide = Frame(b, x, y, rng.uniform(0, 6.28)), rng.uniform(1.5, 6)
    for k in range(rng.integers(2, 9)):
        f.box(0, 0.3 * k, 0, wide, 0.3, 0.16 * (k + 1), look)


_THINGS = (_tree, _tree, _car, _column, _basin, _wall_or_fence, _passer_by, _steps)
