"""Write ``report.html``, a self-contained page about a run."""

from __future__ import annotations

import base64
import html
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib import resources
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mpsfm_core.data import Float64
from mpsfm_core.data.camera_models import NUM_DISTORTION, CameraModel, IntrinsicParameter
from mpsfm_core.data.errors import InputError, MpsfmError
from mpsfm_core.data.result_layout import REPORT, VIEWS
from mpsfm_core.dense.texture import TexturedMesh
from mpsfm_core.extraction.cache import cache_folder
from mpsfm_core.report import pictures
from mpsfm_core.report.findings import describe_scale, findings, partner_counts
from mpsfm_core.report.points import PointSet, dense_points, sparse_points
from mpsfm_core.report.reasons import explain_image, explain_pair
from mpsfm_core.report.result_folder import MatchLines, PriorMaps, RefinedMap, ResultFolder
from mpsfm_core.report.verdict import judge
from mpsfm_core.support.disk_arrays import DiskArrays, store_fields
from mpsfm_core.support.files import write_file
from mpsfm_core.support.threads import parallel_map
from mpsfm_core.support.yaml_text import write_yaml

MAX_DENSE_POINTS = 280_000
MAX_SPARSE_POINTS = 40_000
"""Maximum numbers of dense and sparse points in the page, 16 bytes each in base64."""
MAX_MESH_TRIANGLES = 600_000
"""Maximum number of triangles of a mesh in the page, about 25 bytes each in base64."""
MAX_PICTURE_BYTES = 9_000_000
"""Maximum size in bytes of all pictures in the page; with many images each picture is smaller."""
MAX_EMBEDDED = 700
"""Maximum number of images with pictures in the page, so that the smallest pictures fit in
``MAX_PICTURE_BYTES``. Other images are loaded from the result folder when they are shown."""
MAX_LINE_BYTES = 9_000_000
"""Maximum size in bytes of all match lines in the page; with many pairs each pair has fewer."""
MAX_VIDEO_FRAMES = 2000
"""Maximum number of frames of a video whose poses are in the page, about 100 bytes each."""
_TEXTURE_SIDE = 2048
"""Maximum of the longer side in pixels of the texture of a mesh."""
_PHOTO_SIDE = (192, 800)
"""Minimum and maximum of the longer side in pixels of an embedded image."""
_MAP_SIDE = (128, 360)
"""Minimum and maximum of the longer side in pixels of an embedded depth or normal map."""
_BYTES_PER_PIXEL = 0.16
"""Mean size in bytes per pixel of a WebP picture in base64, measured on indoor images."""
_LINE_BYTES = 11
"""Size in bytes of a match line in base64."""
_NUM_MAPS = 4
"""Number of embedded depth, std and normal maps per image."""
_MAX_COORDINATE = 0xFFFF
"""Maximum value of a 16-bit coordinate."""
CENTER = [IntrinsicParameter.PRINCIPAL_POINT_X, IntrinsicParameter.PRINCIPAL_POINT_Y]
_DEFAULT_MAX_STD = 0.2
"""Relative depth std that the brightest color of a std map encodes if no image is registered."""


def write_report(folder: Path) -> Path:
    """Write the report page of a finished result folder.

    Returns:
        Path of the report page.

    Raises:
        InputError: the folder has no results, or the results are damaged.
        OSError: the report page cannot be written, for example because the disk is full.
    """
    result = ResultFolder.open(folder)
    try:
        text = render(result)
    except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
        if isinstance(error, MpsfmError):
            raise
        raise InputError(f"{folder}: the results are damaged: {error!r}") from error
    write_file(folder / REPORT, text.encode("utf-8"))
    return folder / REPORT


def render(result: ResultFolder, max_embedded: int = MAX_EMBEDDED) -> str:
    """Return the report page of a result folder as HTML text.

    Args:
        result: The result folder.
        max_embedded: Maximum number of images with pictures in the page.
    """
    payload = _payload(result, max_embedded)
    data = json.dumps(payload, separators=(",", ":"), allow_nan=False)
    parts = {
        "TITLE": html.escape(result.path.resolve().name),
        "STYLE": _asset("page.css"),
        "THREE": _asset("three.min.js"),
        "SCRIPT": _asset("page.js"),
        "DATA": _script_safe(data),
    }
    page = _asset("page.html")
    head, *rest = page.split("{{")
    filled = [head]
    for piece in rest:
        name, _, after = piece.partition("}}")
        filled += [parts[name], after]
    return "".join(filled)


def _asset(name: str) -> str:
    return (resources.files("mpsfm_core.report") / "assets" / name).read_text(encoding="utf-8")


def _script_safe(data: str) -> str:
    """Escape JSON text so that the text cannot close its ``<script>`` element."""
    return data.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")


def _payload(result: ResultFolder, max_embedded: int) -> dict[str, Any]:
    summary = result.summary
    names = result.names
    embedded = [names[row] for row in _space_evenly(len(names), max_embedded)]
    disk = DiskArrays(cache_folder())

    def read_map(name: str) -> RefinedMap | None:
        refined = result.refined(name)
        return None if refined is None else store_fields(refined, disk.store)

    maps = dict(zip(embedded, parallel_map(read_map, embedded), strict=True))
    refined_maps = [refined for refined in maps.values() if refined is not None]
    photos = _ImageEntries(result, maps)
    ids = {name: row for row, name in enumerate(names)}
    verdict = judge(summary)
    return {
        "folder": result.path.resolve().name,
        "verdict": {"level": verdict.level, "text": verdict.text},
        "findings": [asdict(finding) for finding in findings(summary)],
        "photos": parallel_map(photos.describe, names),
        "pairs": _pairs(summary, ids),
        "lines": _lines(result.matches(), photos, ids),
        "points": {
            "sparse": _points(sparse_points(result.model, refined_maps, MAX_SPARSE_POINTS)),
            "dense": _points(dense_points(result.dense_cloud(), refined_maps, MAX_DENSE_POINTS)),
        },
        "mesh": _encode_mesh(result.textured_mesh()),
        "frames": _describe_frames(result.model, ids),
        "trajectories": [
            _describe_trajectory(name, rows) for name, rows in result.trajectories().items()
        ],
        "up": _estimate_up(refined_maps),
        "reconstructions": summary["reconstructions"],
        "scales": [describe_scale(summary, i) for i in range(len(summary["reconstructions"]))],
        "providers": summary["providers"],
        "stages": {name: stage["seconds"] for name, stage in summary["stages"].items()},
        "steps": {name: step["seconds"] for name, step in summary["mapping_steps"].items()},
        "memory_mb": _find_peak_memory(summary),
        "config": write_yaml(summary["config"]),
        "versions": summary["versions"],
    }


def _describe_frames(
    model: pycolmap.Reconstruction, ids: Mapping[str, int]
) -> list[dict[str, Any]]:
    """Return name, images and pose of each frame of a rig, such as a panorama.

    The name is that of the first image without the folder of its camera, and the pose is
    ``world_from_rig`` (3 x 4, row-major).
    """
    described = []
    for frame in model.frames.values():
        names = sorted(model.images[data.id].name for data in frame.image_ids)
        rows = [ids[name] for name in names if name in ids]
        if len(rows) > 1:
            pose = frame.rig_from_world.inverse().matrix()
            name = names[0].split("/", 1)[-1]
            described.append({"name": name, "photos": rows, "pose": _rounded(pose.ravel())})
    return sorted(described, key=lambda entry: str(entry["name"]))


def _describe_trajectory(name: str, rows: Float64) -> dict[str, Any]:
    """Describe the frames of a video, or evenly spaced frames of a long video.

    Args:
        name: Name of the video, which is empty for a single video.
        rows: (n, 8) time stamps, camera centers and quaternions of the frames.

    Returns:
        Name, time stamps, and poses ``world_from_cam`` (3 x 4, row-major).
    """
    rows = rows[_space_evenly(len(rows), MAX_VIDEO_FRAMES)]
    rotations = Rotation.from_quat(rows[:, 4:]).as_matrix()
    poses = np.concatenate([rotations, rows[:, 1:4, None]], axis=2).reshape(-1, 12)
    return {
        "name": name,
        "times": _rounded(rows[:, 0]),
        "poses": [_rounded(pose) for pose in poses],
    }


class _ImageEntries:
    """Collector of the statistics and pictures of each image for the report page.

    Args:
        result: The result folder.
        maps: Refined depth map or None of each image with pictures in the page.
    """

    def __init__(self, result: ResultFolder, maps: Mapping[str, RefinedMap | None]) -> None:
        self._result = result
        self._maps = maps
        self._renderings = result.held_out_renderings()
        self._images = {image.name: image for image in result.model.images.values()}
        self._errors = {key: point.error for key, point in result.model.points3D.items()}
        self._partners = partner_counts(result.summary)
        self._matched = Counter(
            name
            for pair in result.summary["pairs"]["all"]
            if "inliers" in pair
            for name in pair["images"]
        )
        self._sizes = _PictureSizes.of(len(maps))
        stds = [
            float(np.percentile(refined.relative_std[refined.valid], 95))
            for refined in maps.values()
            if refined is not None and refined.valid.any()
        ]
        self._max_std = max(stds, default=_DEFAULT_MAX_STD)
        self._views: dict[str, tuple[int, int]] = {}

    def describe(self, name: str) -> dict[str, Any]:
        """Return status, statistics, pose and pictures of an image for the report page."""
        images = self._result.summary["images"]
        reason = {**images["unregistered"], **images["unconfirmed"]}.get(name)
        explained = None if reason is None else explain_image(reason)
        status = "registered"
        if name in images["unconfirmed"]:
            status = "unconfirmed"
        elif explained is not None:
            status = "missing"
        prior = self._result.prior(name)
        if prior is not None:
            self._views[name] = prior.camera.size
        details = images["details"][name]
        return {
            "name": name,
            "status": status,
            "explanation": explained and explained.text,
            "remedy": explained and explained.remedy,
            "keypoints": details["keypoints"],
            "partners": self._partners[name] if explained is None else self._matched[name],
            "depth_std": details["median_relative_depth_std"],
            "valid_depth": details["valid_depth"],
            "rendering": self._renderings.get(name),
            "focal": details["focal_length_px"],
            "focal_from": details["focal_length_from"],
            "refined_focal": details.get("refined_focal_length_px"),
            "lens": _list_lens_parameters(details),
            **self._in_model(name),
            **self._camera(name, prior),
            "pictures": self._pictures(name, prior)
            if name in self._maps
            else self._link_picture(name),
        }

    def lines(self, pair: MatchLines, max_lines: int) -> str:
        """Encode matches as uint16 (ax, ay, bx, by), relative to the sizes of both images."""
        sides = []
        for name, points in ((pair.image_a, pair.points_a), (pair.image_b, pair.points_b)):
            size = np.array(self._views.get(name, (1, 1)))
            sides.append(np.clip(points[:max_lines] / size, 0, 1) * _MAX_COORDINATE)
        return _base64(np.concatenate(sides, axis=1).astype("<u2"))

    def _in_model(self, name: str) -> dict[str, Any]:
        """Return the 3D point count and mean reprojection error in pixels of an image."""
        image = self._images.get(name)
        if image is None:
            return {"points": 0, "error": None}
        errors = [self._errors[point.point3D_id] for point in image.get_observation_points2D()]
        return {"points": len(errors), "error": float(np.mean(errors)) if errors else None}

    def _camera(self, name: str, prior: PriorMaps | None) -> dict[str, Any]:
        """Return ``world_from_cam`` (3 x 4, row-major) and the image borders at depth 1."""
        image = self._images.get(name)
        if image is None:
            return {"pose": None}
        pose = image.cam_from_world().inverse().matrix()
        if prior is not None:
            width, height = prior.camera.size
            (fx, fy, cx, cy) = prior.camera.params.tolist()
        else:
            camera = self._result.model.cameras[image.camera_id]
            width, height = camera.width, camera.height
            fx, fy = camera.focal_length_x, camera.focal_length_y
            cx, cy = camera.principal_point_x, camera.principal_point_y
        edges = [-cx / fx, -cy / fy, (width - cx) / fx, (height - cy) / fy]
        return {"pose": _rounded(pose.ravel()), "edges": _rounded(np.array(edges))}

    def _link_picture(self, name: str) -> dict[str, Any]:
        """Return the address of the image, which the browser loads when the image is shown."""
        if not (self._result.path / VIEWS / f"{name}.webp").is_file():
            return {}
        return {"photo": {"src": quote(f"{VIEWS}/{name}.webp"), "linked": True}}

    def _pictures(self, name: str, prior: PriorMaps | None) -> dict[str, Any]:
        sizes, made, refined = self._sizes, {}, self._maps[name]
        picture = self._result.picture(name)
        if picture is not None:
            made["photo"] = {"src": pictures.photo(picture, sizes.photo)}
        refined_range = None
        if refined is not None:
            refined_range = pictures.range_of(refined.depth, refined.valid)
        if prior is not None:
            factor = _scale_between(prior, refined)
            depth = (prior.depth * factor).astype(np.float32)
            span = refined_range or pictures.range_of(depth, prior.valid)
            legend = f"{span[0]:.3g} to {span[1]:.3g}"
            made["prior"] = {
                "src": pictures.depth_map(depth, prior.valid, span, sizes.maps),
                "legend": f"red {legend} blue, scaled to the reconstruction"
                if refined_range
                else legend,
            }
        if refined is not None and refined_range is not None:
            made["refined"] = {
                "src": pictures.depth_map(refined.depth, refined.valid, refined_range, sizes.maps),
                "legend": f"red {refined_range[0]:.3g} to {refined_range[1]:.3g} blue",
            }
        std = refined or prior
        if std is not None:
            made["std"] = {
                "src": pictures.std_map(std.relative_std, std.valid, self._max_std, sizes.maps),
                "legend": f"dark 0 to {self._max_std:.0%} of the depth bright",
            }
        if prior is not None:
            made["normals"] = {
                "src": pictures.normal_map(prior.normals, prior.valid, sizes.maps),
                "legend": "red faces right, green up, blue the camera",
            }
        return made


def _lines(
    pairs: Sequence[MatchLines], photos: _ImageEntries, ids: Mapping[str, int]
) -> dict[str, str]:
    """Encode the match lines of all pairs, by the indices of both images."""
    shown = [pair for pair in pairs if pair.image_a in ids and pair.image_b in ids]
    max_lines = MAX_LINE_BYTES // (_LINE_BYTES * max(len(shown), 1))
    return {
        f"{ids[pair.image_a]} {ids[pair.image_b]}": photos.lines(pair, max(max_lines, 1))
        for pair in shown
    }


def _space_evenly(count: int, max_rows: int) -> list[int]:
    """Return at most ``max_rows`` of ``count`` row indices at even distances."""
    number = min(count, max_rows)
    return [row * count // number for row in range(number)]


@dataclass(frozen=True)
class _PictureSizes:
    """Longer sides in pixels of an embedded image and of an embedded map."""

    photo: int
    maps: int

    @classmethod
    def of(cls, count: int) -> _PictureSizes:
        """Return the picture sizes with which ``count`` images fit in :data:`MAX_PICTURE_BYTES`."""
        full = 0.75 * (_PHOTO_SIDE[1] ** 2 + _NUM_MAPS * _MAP_SIDE[1] ** 2)
        share = (MAX_PICTURE_BYTES / (max(count, 1) * full * _BYTES_PER_PIXEL)) ** 0.5
        return cls(
            int(np.clip(share * _PHOTO_SIDE[1], *_PHOTO_SIDE)),
            int(np.clip(share * _MAP_SIDE[1], *_MAP_SIDE)),
        )


def _list_lens_parameters(details: Mapping[str, Any]) -> list[tuple[str, float, float, int]]:
    """List the estimated distortion coefficients and principal point of an image.

    Args:
        details: Entry of the image in ``images.details`` of ``summary.json``.

    Returns:
        Name, value, standard deviation and number of shown decimals of each parameter.
    """
    is_fisheye = details.get("camera_model") == CameraModel.OPENCV_FISHEYE.value
    coefficients = ("k1", "k2", "k3", "k4") if is_fisheye else ("k1", "k2", "p1", "p2")
    names = dict(zip(list(IntrinsicParameter)[-NUM_DISTORTION:], coefficients, strict=True))
    decimals = {**dict.fromkeys(names, 3), **dict.fromkeys(CENTER, 1)}
    names |= {parameter: f"c{axis}, px" for parameter, axis in zip(CENTER, "xy", strict=True)}
    keys = {parameter: parameter.name.lower() for parameter in names}
    return [
        (names[parameter], details[key], details[f"{key}_std"], decimals[parameter])
        for parameter, key in keys.items()
        if key in details and f"{key}_reason" not in details
    ]


def _scale_between(prior: PriorMaps, refined: RefinedMap | None) -> float:
    """Return the median ratio of refined depth to prior depth."""
    if refined is None or refined.depth.shape != prior.depth.shape:
        return 1.0
    both = refined.valid & prior.valid
    return float(np.median(refined.depth[both] / prior.depth[both])) if both.any() else 1.0


def _pairs(summary: Mapping[str, Any], ids: Mapping[str, int]) -> list[list[Any]]:
    """Return image indices, matches, inliers and reason of rejection of each image pair."""
    return [
        [
            *(ids[name] for name in pair["images"]),
            pair["matches"],
            pair.get("inliers", 0),
            _why_unused(pair),
        ]
        for pair in summary["pairs"]["all"]
    ]


def _why_unused(pair: Mapping[str, Any]) -> str:
    """Return why an image pair was dropped or cannot initialize a component, else ""."""
    if "dropped" in pair:
        return explain_pair(pair["dropped"]).text
    return explain_image(pair["cannot_start"]).text if "cannot_start" in pair else ""


def _points(points: PointSet) -> dict[str, Any]:
    """Encode positions of points with 16 bits, and colors and other values with 8 bits."""
    return {
        "count": len(points.xyz),
        **_encode_positions(points.xyz),
        "rgb": _base64(points.rgb),
        "values": {
            "error": _values(points.error, points.error_unit),
            "std": _values(points.std, "%"),
            "views": _values(points.views, ""),
        },
    }


def _encode_positions(xyz: Float64) -> dict[str, Any]:
    """Encode positions (n, 3) with 16 bits for each coordinate."""
    low, step = np.zeros(3), np.ones(3)
    if len(xyz):
        low = xyz.min(axis=0)
        step = np.maximum(np.ptp(xyz, axis=0), 1e-9) / _MAX_COORDINATE
    steps = np.round((xyz - low) / step).astype("<u2")
    return {"low": low.tolist(), "step": step.tolist(), "xyz": _base64(steps)}


def _encode_mesh(mesh: TexturedMesh | None) -> dict[str, Any] | None:
    """Encode vertices, texture coordinates, triangles and texture; None without a mesh."""
    if mesh is None or len(mesh.triangles) > MAX_MESH_TRIANGLES:
        return None
    texture = np.asarray(mesh.texture[..., ::-1], np.uint8)
    return {
        **_encode_positions(mesh.vertices),
        "uv": _base64(np.round(mesh.uv * _MAX_COORDINATE).astype("<u2")),
        "triangles": _base64(mesh.triangles.astype("<u4")),
        "texture": pictures.photo(texture, _TEXTURE_SIDE),
    }


def _values(values: NDArray[np.float32], unit: str) -> dict[str, Any]:
    """Quantize values from the minimum to the 98th percentile to 8 bits; 255 is no value."""
    known = values[np.isfinite(values)]
    low, high = np.percentile(known, [0, 98]).tolist() if len(known) else (0.0, 0.0)
    share = (np.nan_to_num(values, nan=high) - low) / max(high - low, 1e-9)
    steps = np.where(np.isfinite(values), np.clip(np.round(254 * share), 0, 254), 255)
    return {"bytes": _base64(steps.astype(np.uint8)), "low": low, "high": high, "unit": unit}


def _estimate_up(maps: list[RefinedMap]) -> list[float]:
    """Return the mean up axis of the cameras as a unit vector in world coordinates."""
    mean: Float64 = -np.sum([refined.rotation[1] for refined in maps], axis=0, dtype=np.float64)
    length = np.linalg.norm(mean)
    return _rounded(mean / length) if length > 1e-6 else [0.0, -1.0, 0.0]


def _find_peak_memory(summary: Mapping[str, Any]) -> float | None:
    peaks = [stage["peak_memory_mb"] for stage in summary["stages"].values()]
    return max((peak for peak in peaks if peak is not None), default=None)


def _rounded(values: NDArray[Any]) -> list[float]:
    return [float(f"{value:.7g}") for value in values]


def _base64(values: NDArray[Any]) -> str:
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode("ascii")
