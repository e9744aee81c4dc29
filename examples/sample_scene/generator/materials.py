"""Procedural Blender materials in world coordinates, so that no two surfaces look alike."""

from __future__ import annotations

from collections.abc import Sequence

import bpy
import numpy as np
from numpy.typing import NDArray

Colour = tuple[float, float, float]


class Shader:
    """Matte Blender material of shader nodes (``position`` is the node of the world position)."""

    def __init__(self, roughness: float = 0.8) -> None:
        self.material = bpy.data.materials.new("material")
        self.material.use_nodes = True
        self._tree = self.material.node_tree
        self._surface = self._tree.nodes["Principled BSDF"]
        self._surface.inputs["Roughness"].default_value = roughness
        self._surface.inputs["Specular IOR Level"].default_value = 0.2
        self.position = self.node("ShaderNodeNewGeometry").outputs["Position"]

    def node(self, kind: str, inputs: dict[str | int, object] | None = None) -> bpy.types.Node:
        """Add a shader node, whose inputs are constants or output sockets of other nodes."""
        node = self._tree.nodes.new(kind)
        for name, value in (inputs or {}).items():
            if isinstance(value, bpy.types.NodeSocket):
                self._tree.links.new(value, node.inputs[name])
            else:
                node.inputs[name].default_value = value
        return node

    def ramp(
        self, factor: bpy.types.NodeSocket, colours: Sequence[Colour], low: float, high: float
    ) -> bpy.types.NodeSocket:
        """Map a shader value in [low, high] to evenly spaced colors."""
        node = self.node("ShaderNodeValToRGB", {"Fac": factor})
        stops = np.linspace(low, high, len(colours))
        while len(node.color_ramp.elements) < len(colours):
            node.color_ramp.elements.new(0.5)
        for element, stop, colour in zip(node.color_ramp.elements, stops, colours, strict=True):
            element.position, element.color = stop, (*colour, 1)
        return node.outputs["Color"]

    def noise(
        self, scale: float, at: bpy.types.NodeSocket | None = None, roughness: float = 0.65
    ) -> bpy.types.NodeSocket:
        """Create fractal noise in [0, 1] with ``scale`` cells per meter."""
        inputs = {"Vector": at or self.position, "Scale": scale, "Detail": 7.0}
        node = self.node("ShaderNodeTexNoise", {**inputs, "Roughness": roughness})
        return node.outputs["Fac"]

    def mix(
        self,
        a: bpy.types.NodeSocket | Colour,
        b: bpy.types.NodeSocket | Colour,
        factor: bpy.types.NodeSocket | float,
        blend: str = "MIX",
    ) -> bpy.types.NodeSocket:
        """Blend two colours."""
        a, b = (c if isinstance(c, bpy.types.NodeSocket) else (*c, 1) for c in (a, b))
        node = self.node("ShaderNodeMixRGB", {"Fac": factor, "Color1": a, "Color2": b})
        node.blend_type = blend
        return node.outputs["Color"]

    def plane(self, floor: bool) -> bpy.types.NodeSocket:
        """Return texture coordinates of a floor (x, y) or of an axis-aligned wall (x + y, z)."""
        if floor:
            return self.position
        xyz = self.node("ShaderNodeSeparateXYZ", {"Vector": self.position}).outputs
        along = self.node("ShaderNodeMath", {0: xyz["X"], 1: xyz["Y"]}).outputs["Value"]
        return self.node("ShaderNodeCombineXYZ", {"X": along, "Y": xyz["Z"]}).outputs["Vector"]

    def stretched(self, scale: Sequence[float]) -> bpy.types.NodeSocket:
        """Return the world position with scaled axes, which stretches noise to wood grain."""
        node = self.node("ShaderNodeMapping", {"Vector": self.position, "Scale": tuple(scale)})
        return node.outputs["Vector"]

    def finish(self, colour: bpy.types.NodeSocket) -> bpy.types.Material:
        """Set ``colour`` as the color of the material."""
        self._tree.links.new(colour, self._surface.inputs["Base Color"])
        return self.material


def mottled(
    colours: Sequence[Colour], scale: float, *, low: float = 0.35, high: float = 0.65
) -> bpy.types.Material:
    """Create a material of fractal blotches, for plaster, stone, foliage and cloth."""
    shader = Shader()
    return shader.finish(shader.ramp(shader.noise(scale), colours, low, high))


def wood(light: Colour, dark: Colour, grain: Sequence[float] = (3, 3, 30)) -> bpy.types.Material:
    """Create a wood material with grain along the axis with the smallest ``grain`` frequency."""
    shader = Shader(0.5)
    fine = shader.noise(1.0, shader.stretched(grain), 0.75)
    colour = shader.ramp(fine, [dark, light, dark, light], 0.3, 0.7)
    knots = shader.ramp(shader.noise(5.0), [(0.35, 0.35, 0.35), (1, 1, 1)], 0.36, 0.48)
    return shader.finish(shader.mix(colour, knots, 0.8, "MULTIPLY"))


def bricks(
    first: Colour, second: Colour, mortar: Colour, size: tuple[float, float], *, floor: bool = False
) -> bpy.types.Material:
    """Create a material of bricks, tiles or planks of ``size`` (length, height) in many shades."""
    shader = Shader()
    inputs = {"Color1": (*first, 1), "Color2": (*second, 1), "Mortar": (*mortar, 1), "Scale": 1.0}
    pattern = shader.node("ShaderNodeTexBrick", {**inputs, "Vector": shader.plane(floor)})
    pattern.inputs["Brick Width"].default_value, pattern.inputs["Row Height"].default_value = size
    pattern.inputs["Mortar Size"].default_value = 0.006
    grain = shader.noise(9.0, shader.stretched((0.5, 4, 4)) if floor else None, 0.8)
    stains = shader.ramp(grain, [(0.15, 0.15, 0.15), (1, 1, 1)], 0.3, 0.62)
    return shader.finish(shader.mix(pattern.outputs["Color"], stains, 0.75, "MULTIPLY"))


def patchwork(colours: Sequence[Colour], scale: float, *, grout: Colour) -> bpy.types.Material:
    """Create a material of irregular colored cells with seams, for rugs, wallpaper and cushions."""
    shader = Shader(0.9)
    cell = {"Vector": shader.position, "Scale": scale}
    shade = shader.node("ShaderNodeTexVoronoi", cell).outputs["Color"]
    pick = shader.node("ShaderNodeSeparateColor", {"Color": shade}).outputs["Red"]
    edges = shader.node("ShaderNodeTexVoronoi", cell)
    edges.feature = "DISTANCE_TO_EDGE"
    seam = shader.ramp(edges.outputs["Distance"], [(1, 1, 1), (0, 0, 0)], 0.02, 0.06)
    colour = shader.mix(shader.ramp(pick, colours, 0.1, 0.9), grout, seam)
    wear = shader.ramp(shader.noise(12.0), [(0.3, 0.3, 0.3), (1, 1, 1)], 0.32, 0.6)
    return shader.finish(shader.mix(colour, wear, 0.7, "MULTIPLY"))


def plain(colour: Colour) -> bpy.types.Material:
    """Create a material of uniform color with slight wear."""
    shader = Shader(0.6)
    wear = shader.ramp(shader.noise(25.0), [(0.55, 0.55, 0.55), (1, 1, 1)], 0.35, 0.6)
    return shader.finish(shader.mix(colour, wear, 0.8, "MULTIPLY"))


def painting(rng: np.random.Generator, pixels: int = 256) -> NDArray[np.float32]:
    """Create a random abstract picture, (pixels, pixels, 3) in [0, 1]."""
    rows, cols = np.mgrid[:pixels, :pixels] / pixels
    picture = np.ones((pixels, pixels, 3)) * rng.uniform(0.3, 0.9, 3)
    for _ in range(60):
        centre, size = rng.uniform(0, 1, 2), rng.uniform(0.02, 0.2)
        turn, aspect = rng.uniform(0, np.pi), rng.uniform(1, 5)
        u = (cols - centre[0]) * np.cos(turn) + (rows - centre[1]) * np.sin(turn)
        v = (rows - centre[1]) * np.cos(turn) - (cols - centre[0]) * np.sin(turn)
        power = rng.choice([2, 20])
        inside = np.abs(u / size) ** power + np.abs(v * aspect / size) ** power < 1
        picture[inside] = rng.uniform(0, 1, 3)
    return picture.astype(np.float32)


def poster(
    rng: np.random.Generator, corner: Sequence[float], size: tuple[float, float]
) -> bpy.types.Material:
    """Create a painting on the wall rectangle that starts at ``corner`` (x + y, z)."""
    shader = Shader(0.6)
    pixels = painting(rng)
    image = bpy.data.images.new("painting", pixels.shape[1], pixels.shape[0])
    image.pixels.foreach_set(np.dstack([pixels, np.ones(pixels.shape[:2])]).ravel().astype("f"))
    image.pack()
    scale = (1 / size[0], 1 / size[1], 1)
    offset = (-corner[0] / size[0], -corner[1] / size[1], 0)
    inputs = {"Vector": shader.plane(floor=False), "Scale": scale, "Location": offset}
    node = shader.node(
        "ShaderNodeTexImage", {"Vector": shader.node("ShaderNodeMapping", inputs).outputs[0]}
    )
    node.image = image
    return shader.finish(node.outputs["Color"])
