"""Options of reading images and videos."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from mpsfm_core.data.camera_models import CameraModel
from mpsfm_core.data.cameras import MapOrientation
from mpsfm_core.data.options import Options, expert


class VideoOptions(Options):
    """Options of the selection of video frames as images."""

    motion: float = expert(0.08, gt=0, lt=1)
    """Median motion of tracked points between selected frames, relative to the image diagonal.
    Larger motion selects fewer frames [3 to 5 degrees of rotation of a phone]."""
    overlap: float = expert(0.7, gt=0, lt=1)
    """Share of still tracked points below which the next frame is selected. A larger share of
    tracked points selects more frames."""
    max_frames: int | None = Field(None, ge=2)
    """Maximum number of keyframes of a video. If more keyframes are selected, those with the least
    motion are dropped. Without a maximum (null), keyframes beyond 300 are dropped as long as
    neighbors still overlap, and keyframes beyond 1000 always. More keyframes take proportionally
    more time and memory. [ours]"""
    trajectory_every: int = Field(1, ge=0)
    """Interval of the video frames whose poses are written to ``trajectory.txt``; 1 localizes all
    frames, and 0 writes no trajectory."""


class InputOptions(Options):
    """Options of the reading and undistortion of images."""

    max_image_size: int | None = Field(None, ge=32)
    """Maximum longer side in pixels of the images; larger images are downscaled, and null keeps the
    size [paper 4]. The command of the MP-SfM reference code downscales images to 1200 pixels.
    Larger images give more accurate keypoints and take more time."""
    projection: Literal["auto", "perspective", "equirectangular"] = "auto"
    """Projection of the images. With ``equirectangular``, panoramas of 360 x 180 degrees are cut
    into eight perspective images, which form a rig with one center [COLMAP panorama_sfm]. With
    ``auto``, panoramas are recognized by XMP data or by their pixels. All images are cut if they
    are twice as wide as high and most are recognized; otherwise, panoramas are left out. With
    ``perspective``, no image is taken for a panorama."""
    max_pixels: int = expert(250_000_000, ge=1024)
    """Maximum number of pixels of an image or mask. Larger images are rejected before decoding,
    because a small file can decode to gigabytes [above all cameras on the market]."""
    strict: bool = False
    """If true, a damaged image ends the run. If false, damaged images are left out with a warning,
    unless more than half of the images are damaged."""
    nadir_angle_deg: float = Field(0.0, ge=0, lt=180)
    """Angle from the downward direction up to which the pixels of panoramas and fisheye images that
    are cut into views are ignored, such as the operator of a 360-degree camera. A larger angle
    hides more. The views of a panorama end at 45 degrees, so smaller angles change nothing."""
    masks: Path | None = None
    """Folder of masks of the original images, named ``X.jpg.png``, ``X.png``, ``X_mask.png`` or
    ``X.jpg`` for the image ``X.jpg``, or one mask file of all images. Pixels that are black in the
    mask are ignored [COLMAP mask_path]."""
    mask_orientation: MapOrientation = expert("auto")
    """Orientation of masks whose size fits the image before and after EXIF rotation, either
    ``stored`` (before) or ``upright`` (after). With ``auto``, masks that fit both orientations get
    the orientation of the majority of masks whose size fits only one orientation, or ``stored``
    without such masks [COLMAP, which ignores EXIF orientation]."""
    camera_per: Literal["auto", "image", "folder", "set"] = "auto"
    """Criterion by which images without given intrinsics share a camera [COLMAP single_camera,
    single_camera_per_folder, single_camera_per_image]. With ``image``, each image has its own
    camera. With ``folder`` or ``set``, all images of one size in a folder or in the whole set share
    a camera. With ``auto``, images of one size share a camera if EXIF names the same camera, lens
    and focal length, and images without EXIF share a camera by folder and size. The mapper gives
    images that contradict the shared focal length their own camera."""
    camera_model: CameraModel = CameraModel.SIMPLE_RADIAL
    """COLMAP camera model of images without given intrinsics, whose parameters the mapper estimates
    [COLMAP ImageReader.camera_model]. A model with more parameters needs more photos. The views of
    ``OPENCV_FISHEYE`` images are undistorted before matching."""
    default_focal_ratio: float = expert(1.2, gt=0)
    """Ratio of focal length to longer image side for images without a known focal length [COLMAP
    default_focal_length_factor]."""
    video: VideoOptions = Field(default_factory=VideoOptions)
    """Options of the frame selection if the input is a video."""
