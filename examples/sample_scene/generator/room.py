"""Room of the sample scene, 6.4 m x 5.2 m x 2.7 m, and the camera path in the room.

World axes are x east, y north, z up; the origin is the south-west corner of the floor.
"""

from __future__ import annotations

import bpy
import numpy as np

from . import materials as mat
from .cameras import Pose, look
from .meshes import add_box, add_cylinder, add_ellipsoid, add_sheet, add_turned

LENGTH, WIDTH, HEIGHT = 6.4, 5.2, 2.7
WALL = 0.1
WINDOW_Y, WINDOW_Z = (1.7, 3.3), (0.95, 2.25)

CREAM, WHITE, BLACK = (0.8, 0.72, 0.55), (0.85, 0.85, 0.82), (0.03, 0.03, 0.04)
RED, OCHRE, TEAL = (0.5, 0.08, 0.06), (0.75, 0.45, 0.1), (0.05, 0.3, 0.32)
NAVY, LEAF, PALE_LEAF = (0.04, 0.07, 0.25), (0.05, 0.16, 0.04), (0.25, 0.45, 0.12)
OAK, DARK_OAK, WALNUT = (0.55, 0.33, 0.16), (0.28, 0.14, 0.06), (0.12, 0.06, 0.03)
BRICK, PALE_BRICK, MORTAR = (0.45, 0.15, 0.08), (0.65, 0.33, 0.2), (0.6, 0.58, 0.52)


def build_room(rng: np.random.Generator) -> None:
    """Fill the empty Blender scene with the room."""
    _shell()
    _lights()
    _south_wall(rng)
    _east_wall(rng)
    _north_wall(rng)
    _west_wall(rng)


def room_path(rng: np.random.Generator, views: int = 8) -> list[Pose]:
    """Create irregular camera poses around the room, about 45 deg of heading apart."""
    poses = []
    for step in np.arange(views) * 360 / views:
        heading = step + rng.normal(0, 0.7)
        forward = np.array([np.cos(np.radians(heading)), np.sin(np.radians(heading)), 0])
        centre = np.array([LENGTH / 2, WIDTH / 2, 1.45]) - forward * [1.0, 0.6, 0]
        pitch, roll = rng.normal([-4, 0], 1.5)
        poses.append(look(centre + rng.normal(0, 0.05, 3), heading, pitch, roll))
    return poses


def _shell() -> None:
    middle = (LENGTH / 2, WIDTH / 2)
    planks = mat.bricks(OAK, DARK_OAK, WALNUT, (1.1, 0.14), floor=True)
    add_box(planks, (LENGTH, WIDTH, WALL), (*middle, -WALL))
    ceiling = mat.mottled([(0.55, 0.52, 0.47), WHITE, (0.7, 0.68, 0.62)], 2.5)
    add_box(ceiling, (LENGTH, WIDTH, WALL), (*middle, HEIGHT))
    beam = mat.wood(DARK_OAK, WALNUT, (30, 2, 30))
    for x in np.arange(0.8, LENGTH, 1.2):
        add_box(beam, (0.14, WIDTH, 0.16), (x, WIDTH / 2, HEIGHT - 0.16))
    bricks = mat.bricks(BRICK, PALE_BRICK, MORTAR, (0.25, 0.08))
    add_box(bricks, (WALL, WIDTH, HEIGHT), (-WALL / 2, WIDTH / 2, 0))
    wallpaper = mat.patchwork([CREAM, WHITE, (0.55, 0.6, 0.4), CREAM, OCHRE], 7.0, grout=TEAL)
    add_box(wallpaper, (LENGTH, WALL, HEIGHT), (LENGTH / 2, WIDTH + WALL / 2, 0))
    plaster = mat.mottled([(0.45, 0.3, 0.2), CREAM, (0.9, 0.85, 0.75), OCHRE], 3.0)
    add_box(plaster, (LENGTH, WALL, HEIGHT), (LENGTH / 2, -WALL / 2, 0))
    x, (y0, y1), (z0, z1) = LENGTH + WALL / 2, WINDOW_Y, WINDOW_Z
    tinted = mat.mottled([(0.25, 0.4, 0.4), (0.6, 0.75, 0.7), (0.4, 0.5, 0.45), WHITE], 4.0)
    add_box(tinted, (WALL, y0, HEIGHT), (x, y0 / 2, 0))
    add_box(tinted, (WALL, WIDTH - y1, HEIGHT), (x, (y1 + WIDTH) / 2, 0))
    add_box(tinted, (WALL, y1 - y0, z0), (x, (y0 + y1) / 2, 0))
    add_box(tinted, (WALL, y1 - y0, HEIGHT - z1), (x, (y0 + y1) / 2, z1))
    board = mat.wood(CREAM, OCHRE)
    for y in (0.01, WIDTH - 0.01):
        add_box(board, (LENGTH, 0.02, 0.12), (LENGTH / 2, y, 0))


def _lights() -> None:
    world = bpy.data.worlds.new("sky")
    world.use_nodes = True
    world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.55, 0.75, 1, 1)
    world.node_tree.nodes["Background"].inputs["Strength"].default_value = 1.2
    bpy.context.scene.world = world
    for x, y, power in ((1.9, 1.6, 60), (4.5, 1.6, 55), (3.2, 3.8, 75)):
        light = bpy.data.lights.new("lamp", "AREA")
        light.size, light.energy = 1.2, power
        lamp = bpy.data.objects.new("lamp", light)
        lamp.location = (x, y, HEIGHT - 0.2)
        lamp.visible_camera = False
        bpy.context.collection.objects.link(lamp)


def _picture(
    rng: np.random.Generator,
    size: tuple[float, float],
    at: tuple[float, float, float],
    *,
    along_x: bool,
) -> None:
    """Add a framed picture on a wall; ``at`` is the center of the lower edge of the frame."""
    flat = (size[0], 0.03) if along_x else (0.03, size[0])
    add_box(mat.wood(OCHRE, DARK_OAK), (*flat, size[1]), at)
    corner = (at[0] + at[1] - size[0] / 2 + 0.05, at[2] + 0.05)
    canvas = mat.poster(rng, corner, (size[0] - 0.1, size[1] - 0.1))
    flat = (size[0] - 0.1, 0.05) if along_x else (0.05, size[0] - 0.1)
    add_box(canvas, (*flat, size[1] - 0.1), (at[0], at[1], at[2] + 0.05))


def _south_wall(rng: np.random.Generator) -> None:
    _bookshelf(rng, x0=0.9, x1=3.0, shelves=5)
    _picture(rng, (0.9, 0.7), (4.2, 0.0, 1.35), along_x=True)
    _picture(rng, (0.5, 0.6), (5.2, 0.0, 1.45), along_x=True)
    chest = mat.wood(OAK, WALNUT, (3, 30, 30))
    add_box(chest, (1.5, 0.45, 0.75), (4.5, 0.28, 0))
    knob = mat.plain(BLACK)
    for x in (3.95, 4.5, 5.05):
        for z in (0.15, 0.4, 0.62):
            add_ellipsoid(knob, (0.025, 0.025, 0.025), (x, 0.52, z))
    glaze = mat.patchwork([NAVY, WHITE, TEAL, WHITE], 22.0, grout=NAVY)
    profile = [(0.0, 0.0), (0.08, 0.0), (0.13, 0.12), (0.12, 0.2), (0.05, 0.3), (0.07, 0.36)]
    add_turned(glaze, profile, (4.05, 0.28, 0.75))
    add_box(
        mat.patchwork([RED, OCHRE, CREAM, NAVY], 18.0, grout=BLACK),
        (0.3, 0.2, 0.2),
        (4.9, 0.28, 0.75),
        turn_deg=20,
    )
    _plant(rng, (5.85, 0.55, 0), 1.5)


def _bookshelf(rng: np.random.Generator, x0: float, x1: float, shelves: int) -> None:
    timber = mat.wood(DARK_OAK, WALNUT, (3, 30, 30))
    depth, gap = 0.32, 0.4
    top = shelves * gap + 0.06
    for x in (x0, (x0 + x1) / 2, x1):
        add_box(timber, (0.03, depth, top), (x, depth / 2, 0))
    add_box(timber, (x1 - x0, 0.02, top), ((x0 + x1) / 2, 0.01, 0))
    covers = [
        mat.mottled([c, tuple(0.3 * v for v in c), c, CREAM], 40.0, low=0.3, high=0.75)
        for c in (RED, OCHRE, TEAL, NAVY, LEAF, CREAM, PALE_BRICK)
    ]
    for level in range(shelves + 1):
        z = 0.05 + level * gap
        add_box(timber, (x1 - x0, depth - 0.01, 0.03), ((x0 + x1) / 2, depth / 2 - 0.01, z - 0.03))
        x = x0 + 0.03
        while level < shelves and x < x1 - 0.08:
            width, tall = rng.uniform(0.02, 0.06), rng.uniform(0.2, 0.35)
            if rng.random() < 0.85 and abs(x + width / 2 - (x0 + x1) / 2) > 0.06:
                deep = rng.uniform(0.18, 0.28)
                add_box(
                    covers[rng.integers(len(covers))],
                    (width, deep, tall),
                    (x + width / 2, deep / 2 + 0.02, z),
                )
            x += width + 0.003


def _east_wall(rng: np.random.Generator) -> None:
    cloth = mat.mottled([RED, OCHRE, (0.7, 0.2, 0.1), CREAM], 6.0)
    for y in (WINDOW_Y[0] - 0.22, WINDOW_Y[1] + 0.22):
        across, z = np.meshgrid(np.linspace(-0.26, 0.26, 120), np.linspace(0.25, 2.4, 20))
        depth = LENGTH - 0.12 + 0.045 * np.sin(across * 55 + y) * (1.2 - 0.25 * z)
        add_sheet(cloth, np.stack([depth, y + across, z], -1))
    frame = mat.plain(WHITE)
    for y in (*WINDOW_Y, sum(WINDOW_Y) / 2):
        add_box(frame, (0.06, 0.06, WINDOW_Z[1] - WINDOW_Z[0]), (LENGTH + 0.05, y, WINDOW_Z[0]))
    for z in (WINDOW_Z[0], 1.55, WINDOW_Z[1] - 0.06):
        add_box(
            frame, (0.05, WINDOW_Y[1] - WINDOW_Y[0], 0.06), (LENGTH + 0.05, sum(WINDOW_Y) / 2, z)
        )
    desk = mat.wood(OAK, DARK_OAK, (30, 3, 30))
    add_box(desk, (0.65, 1.7, 0.04), (LENGTH - 0.4, 2.5, 0.72))
    for x, y in ((5.72, 1.72), (5.72, 3.28), (6.28, 1.72), (6.28, 3.28)):
        add_box(desk, (0.06, 0.06, 0.72), (x, y, 0))
    pots = mat.mottled([(0.5, 0.2, 0.1), (0.7, 0.35, 0.2), (0.35, 0.15, 0.08)], 14.0)
    add_turned(pots, [(0, 0), (0.08, 0), (0.11, 0.18), (0.09, 0.18), (0, 0.1)], (6.1, 1.95, 0.76))
    for width, z in ((0.3, 0.76), (0.27, 0.81), (0.22, 0.85)):
        tome = mat.mottled([NAVY, TEAL, WHITE, OCHRE], 25.0)
        add_box(tome, (0.2, width, 0.045), (6.0, 2.95, z), turn_deg=100 * z)
    _chair(5.25, 2.4)
    add_box(mat.wood(OAK, WALNUT), (0.4, 0.9, 1.1), (LENGTH - 0.22, 4.5, 0))
    _picture(rng, (0.7, 0.9), (LENGTH, 4.5, 1.4), along_x=False)
    _picture(rng, (0.7, 0.5), (LENGTH, 0.75, 1.5), along_x=False)


def _chair(x: float, y: float) -> None:
    timber = mat.wood(OCHRE, DARK_OAK)
    for dx in (-0.2, 0.2):
        for dy in (-0.2, 0.2):
            add_cylinder(timber, 0.022, 0.45 if dx > 0 else 0.95, (x + dx, y + dy, 0))
    add_box(mat.patchwork([TEAL, CREAM, OCHRE], 20.0, grout=NAVY), (0.44, 0.44, 0.05), (x, y, 0.45))
    for z in (0.6, 0.72, 0.84):
        add_box(timber, (0.02, 0.4, 0.07), (x - 0.2, y, z))


def _north_wall(rng: np.random.Generator) -> None:
    sofa = mat.mottled([NAVY, TEAL, (0.3, 0.45, 0.5), NAVY], 12.0)
    x, y = 3.0, WIDTH - 0.5
    add_box(sofa, (2.3, 0.85, 0.4), (x, y, 0.05))
    add_box(sofa, (2.3, 0.22, 0.5), (x, WIDTH - 0.2, 0.4))
    for side in (-1.15, 1.15):
        add_box(sofa, (0.2, 0.89, 0.6), (x + side, y - 0.02, 0.04))
    for dx, colours in (
        (-0.75, [RED, OCHRE, CREAM]),
        (-0.2, [LEAF, CREAM, TEAL]),
        (0.7, [OCHRE, WHITE, RED]),
    ):
        cushion = mat.patchwork(colours, 16.0, grout=BLACK)
        add_ellipsoid(cushion, (0.24, 0.11, 0.22), (x + dx, WIDTH - 0.42, 0.64))
    _picture(rng, (1.1, 0.75), (2.3, WIDTH, 1.3), along_x=True)
    _picture(rng, (0.6, 0.8), (3.6, WIDTH, 1.25), along_x=True)
    _picture(rng, (0.45, 0.45), (5.5, WIDTH, 1.5), along_x=True)
    table = mat.wood(DARK_OAK, WALNUT)
    add_cylinder(table, 0.3, 0.03, (4.75, 4.75, 0.52))
    add_cylinder(table, 0.04, 0.52, (4.75, 4.75, 0))
    base = mat.mottled([OCHRE, WHITE, RED], 20.0)
    add_turned(base, [(0, 0), (0.1, 0), (0.12, 0.1), (0.03, 0.22), (0.02, 0.4)], (4.75, 4.75, 0.55))
    shade = mat.patchwork([CREAM, WHITE, OCHRE], 15.0, grout=RED)
    add_turned(shade, [(0.19, 0.38), (0.11, 0.62)], (4.75, 4.75, 0.55))
    _plant(rng, (0.75, 4.55, 0), 1.3)
    rug = mat.patchwork([RED, NAVY, CREAM, OCHRE, TEAL], 6.0, grout=CREAM)
    add_box(rug, (3.0, 2.1, 0.015), (3.1, 2.9, 0), turn_deg=4)


def _west_wall(rng: np.random.Generator) -> None:
    sideboard = mat.wood(OAK, DARK_OAK, (30, 3, 30))
    add_box(sideboard, (0.45, 1.9, 0.7), (0.26, 2.3, 0.1))
    for y in (1.5, 3.1):
        add_box(mat.plain(BLACK), (0.4, 0.06, 0.1), (0.26, y, 0))
    for y in (1.68, 2.3, 2.92):
        add_box(mat.wood(OCHRE, OAK), (0.02, 0.52, 0.54), (0.49, y, 0.18))
    jar = [(0, 0), (0.1, 0), (0.14, 0.1), (0.1, 0.22), (0.06, 0.24), (0.06, 0.28)]
    for y, colours in ((1.6, [RED, CREAM, OCHRE]), (2.9, [TEAL, WHITE, NAVY])):
        add_turned(mat.patchwork(colours, 25.0, grout=BLACK), jar, (0.26, y, 0.8))
    add_ellipsoid(
        mat.mottled([NAVY, TEAL, LEAF, OCHRE], 9.0), (0.16, 0.16, 0.16), (0.26, 2.25, 1.0)
    )
    add_turned(mat.plain(BLACK), [(0.1, 0), (0.02, 0.05), (0.02, 0.08)], (0.26, 2.25, 0.8))
    _picture(rng, (0.8, 0.6), (0.0, 1.75, 1.45), along_x=False)
    _picture(rng, (0.55, 0.75), (0.0, 2.9, 1.35), along_x=False)
    door = mat.wood(CREAM, OCHRE, (4, 4, 0.7))
    add_box(door, (0.06, 0.85, 2.05), (0.02, 0.65, 0))
    for z in (0.25, 1.15):
        add_box(mat.wood(OCHRE, OAK), (0.08, 0.6, 0.7), (0.02, 0.65, z))
    add_ellipsoid(mat.plain(BLACK), (0.04, 0.03, 0.03), (0.08, 0.98, 1.05))


def _plant(rng: np.random.Generator, at: tuple[float, float, float], height: float) -> None:
    pot = mat.bricks(BRICK, OCHRE, CREAM, (0.08, 0.05))
    add_turned(pot, [(0, 0), (0.16, 0), (0.22, 0.35), (0.19, 0.35), (0, 0.3)], at)
    foliage = mat.mottled([LEAF, PALE_LEAF, LEAF, OCHRE], 18.0)
    s, t = np.meshgrid(np.linspace(0, 1, 10), np.linspace(-1, 1, 5), indexing="ij")
    for _ in range(26):
        heading, reach = rng.uniform(0, 2 * np.pi), rng.uniform(0.15, 0.4)
        rise = rng.uniform(0.35, 1) * (height - 0.35)
        out, half = reach * s**1.5, 0.07 * np.sin(np.pi * s**0.8) * t
        x = out * np.cos(heading) - half * np.sin(heading)
        y = out * np.sin(heading) + half * np.cos(heading)
        z = 0.32 + rise * (1.5 * s - 0.5 * s**3)
        add_sheet(foliage, np.stack([x, y, z], -1) + np.asarray(at))
