"""Camera projection, rigid transforms, robust statistics and patch alignment."""

from mpsfm_core.geometry.projection import (
    inside,
    log_depth_steps,
    pixel_centers,
    project,
    rays,
    resize_map,
    sample_bilinear,
    sample_nearest,
    scale_pixels,
    unproject,
)
from mpsfm_core.geometry.transforms import (
    angle_between_deg,
    camera_center,
    compose,
    invert,
    rotation_angle_deg,
    transform,
    triangulation_angle_deg,
)

__all__ = [
    "angle_between_deg",
    "camera_center",
    "compose",
    "inside",
    "invert",
    "log_depth_steps",
    "pixel_centers",
    "project",
    "rays",
    "resize_map",
    "rotation_angle_deg",
    "sample_bilinear",
    "sample_nearest",
    "scale_pixels",
    "transform",
    "triangulation_angle_deg",
    "unproject",
]
