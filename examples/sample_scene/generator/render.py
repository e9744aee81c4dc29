"""Color images by Cycles; exact depth and normals by casting one ray per pixel center."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
from mathutils.bvhtree import BVHTree

from .cameras import Camera, Pose, Truth

BLENDER_FROM_CV = np.diag([1.0, -1.0, -1.0])
"""Rotation between camera frames: Blender looks along -z with y up, COLMAP along +z with y down."""
SENSOR_MM = 36.0


def empty_scene() -> None:
    """Start Blender (bpy) with an empty scene."""
    bpy.ops.wm.read_factory_settings(use_empty=True)


def render_image(camera: Camera, pose: Pose, path: Path, samples: int) -> None:
    """Render the open Blender scene to the JPEG file ``path``."""
    scene = bpy.context.scene
    scene.camera = _blender_camera(camera, pose)
    scene.render.engine = "CYCLES"
    scene.cycles.samples = samples
    scene.cycles.seed = 0
    scene.cycles.use_adaptive_sampling = False
    scene.cycles.use_denoising = True
    scene.cycles.max_bounces = 4
    scene.render.resolution_x, scene.render.resolution_y = camera.width, camera.height
    scene.render.resolution_percentage = 100
    scene.view_settings.view_transform = "Standard"
    scene.render.image_settings.file_format = "JPEG"
    scene.render.image_settings.quality = 92
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)


def _blender_camera(camera: Camera, pose: Pose) -> bpy.types.Object:
    lens = bpy.data.cameras.new("camera")
    lens.sensor_fit, lens.sensor_width = "HORIZONTAL", SENSOR_MM
    lens.lens = camera.focal * SENSOR_MM / camera.width
    lens.clip_start = 0.01
    body = bpy.data.objects.new("camera", lens)
    world_from_camera = np.eye(4)
    world_from_camera[:3, :3] = pose.rotation.T @ BLENDER_FROM_CV
    world_from_camera[:3, 3] = pose.centre
    body.matrix_world = world_from_camera.T.tolist()
    bpy.context.collection.objects.link(body)
    return body


def scene_surface() -> BVHTree:
    """Build a ray-casting tree (BVH) of all triangles of the open Blender scene."""
    vertices, faces = [], []
    bpy.context.view_layer.update()
    for item in bpy.context.scene.objects:
        if item.type == "MESH":
            first = len(vertices)
            vertices += [item.matrix_world @ v.co for v in item.data.vertices]
            faces += [[first + i for i in face.vertices] for face in item.data.polygons]
    return BVHTree.FromPolygons(vertices, faces)


def cast_truth(surface: BVHTree, camera: Camera, pose: Pose) -> Truth:
    """Compute exact depth and normals at the pixel centers by ray casting."""
    rays = camera.rays().reshape(-1, 3)
    length = np.linalg.norm(rays, axis=1)
    towards = (rays / length[:, None]) @ pose.rotation
    depth, normals = np.zeros(len(rays)), np.zeros((len(rays), 3))
    origin = pose.centre.tolist()
    for pixel, direction in enumerate(towards.tolist()):
        _, normal, _, distance = surface.ray_cast(origin, direction)
        if distance is not None:
            depth[pixel] = distance / length[pixel]
            normals[pixel] = normal
    normals = normals @ pose.rotation.T
    normals *= -np.sign((normals * rays).sum(1))[:, None]
    shape = (camera.height, camera.width)
    return Truth(depth.reshape(shape), normals.reshape(*shape, 3))
