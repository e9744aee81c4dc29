"""Functions for the stages of a reconstruction, which ``mpsfm_core`` exports.

The function :func:`mpsfm_core.reconstruct` runs the same stages one after another::

    images = load_images("photos/")
    features = extract_features(images)
    matches = match_images(images, features)
    priors = predict_priors(images, matches=matches)
    problem = build_problem(images, matches, depth=priors.depth, normals=priors.normals)
    result = run_mapper(problem)
    model = to_colmap(result.reconstructions[0], problem, images)

Every stage accepts arrays and objects of the caller instead of the results of earlier stages. A
provider argument is the name of an installed provider, a configuration block, or an object with the
method that its provider kind requires. The package ``mpsfm_core`` imports :mod:`mpsfm_core.api`
when a stage is first used.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from mpsfm_core.config import Config
from mpsfm_core.config.provider_arguments import Provider, configure
from mpsfm_core.data import DepthPrior, Features, MappingProblem, Pose
from mpsfm_core.data.errors import InputError, did_you_mean
from mpsfm_core.data.events import EventCallback
from mpsfm_core.data.options import parse_settings
from mpsfm_core.dense.densify import densify as densify_reconstruction
from mpsfm_core.dense.fusion import FusedPointCloud, fuse_depth_maps
from mpsfm_core.dense.mesh import TriangleMesh, mesh_depth_maps
from mpsfm_core.dense.options import DEFAULT_MAX_TEXTURE_SIZE, DenseOptions, MeshOptions
from mpsfm_core.dense.texture import TexturedMesh, build_texture
from mpsfm_core.evaluation import CONVENTIONS
from mpsfm_core.evaluation import evaluate as evaluate_poses
from mpsfm_core.extraction import runner
from mpsfm_core.extraction.context import ExtractionContext
from mpsfm_core.extraction.features import FeatureSet, FeatureSource, FeatureTable, GivenFeatures
from mpsfm_core.extraction.match_graph import MatchGraph, NamePair, Priors
from mpsfm_core.inputs import images as image_inputs
from mpsfm_core.inputs.images import ImageSet
from mpsfm_core.inputs.intrinsics import Cameras, choose_cameras
from mpsfm_core.inputs.models import read_poses
from mpsfm_core.mapping.options import MapperOptions
from mpsfm_core.mapping.parts import part_mapping
from mpsfm_core.mapping.scene.reconstruction import MappingResult, Reconstruction
from mpsfm_core.pipeline.input_reader import InputReader, Source
from mpsfm_core.pipeline.provider_resolution import resolve_providers
from mpsfm_core.pipeline.stages import Stages
from mpsfm_core.providers.registry import Registry
from mpsfm_core.results.colmap_model import build_pinhole_model, reconstruction_from_model
from mpsfm_core.results.original_images import OriginalImages
from mpsfm_core.results.refined_views import (
    refine_reconstructions,
    undistort_cameras,
    undistort_images,
    undistort_problem,
)
from mpsfm_core.results.writer import ComponentResult
from mpsfm_core.support.threads import limit_threads

PathLike = str | Path


def load_images(
    images: PathLike | Mapping[str, NDArray[Any]],
    *,
    cameras: Cameras | None = None,
    intrinsics: PathLike | None = None,
    image_list: PathLike | None = None,
    output: PathLike | None = None,
    config: PathLike | Config = "default",
    overrides: Sequence[str] = (),
    registry: Registry | None = None,
    on_event: EventCallback | None = None,
) -> ImageSet:
    """Load images and their cameras from a folder, a video, or arrays.

    Args:
        images: Folder of photos, path of a video, or (H, W, 3) uint8 RGB pixels by image name.
        cameras: Camera of all images, camera of each image by name, or ``pycolmap.Reconstruction``.
            A camera is a :class:`~mpsfm_core.PinholeCamera` or a ``pycolmap.Camera`` of any
            perspective model, for the image after EXIF rotation. Without cameras, the focal length
            is taken from EXIF, or guessed and refined.
        intrinsics: File with the cameras, instead of ``cameras``: ``intrinsics.yaml``, a COLMAP
            model or ``transforms.json``.
        image_list: Text file with one image name per line, by default all images of the folder.
        output: Folder into which the keyframes of a video are written.
        config: Configuration, of which the block ``inputs`` is used.
        overrides: Settings such as ``"inputs.max_image_size=1600"``.
        registry: Providers that the configuration may name, by default all installed providers.
        on_event: Function that receives progress events.

    Returns:
        Image set, whose images are decoded and undistorted on access.

    Raises:
        InputError: images or cameras cannot be read, or ``output`` is missing for a video.

    Examples:
        >>> images = mpsfm.load_images("photos/")
        >>> images = mpsfm.load_images({"a": rgb_a, "b": rgb_b}, cameras=camera)
    """
    config, registry = configure(config, registry, overrides)
    given = choose_cameras(cameras, intrinsics)
    if isinstance(images, Mapping):
        if intrinsics is not None or image_list is not None:
            raise TypeError("arrays have cameras, not intrinsics or image_list")
        return image_inputs.images_from_arrays(images, cameras, config.inputs)
    stages = Stages(registry, on_event)
    names_file = None if image_list is None else Path(image_list)
    source = Source(Path(images), given, names_file)
    reader = InputReader(source, None if output is None else Path(output), config.inputs, stages)
    reader.find_videos()
    reader.extract_video_frames()
    with stages.stage("inputs"):
        return reader.load_images()


def extract_features(
    images: ImageSet,
    features: Provider | None = None,
    *,
    masks: Sequence[Provider] | None = None,
    config: PathLike | Config = "default",
    overrides: Sequence[str] = (),
    registry: Registry | None = None,
    on_event: EventCallback | None = None,
) -> FeatureSet:
    """Detect and describe local features of all images.

    Args:
        images: Result of :func:`load_images`.
        features: Provider of features, by default the configured feature provider.
        masks: Mask providers, in whose masked areas features are removed.
        config: Configuration with providers and options.
        overrides: Settings such as ``"features.options.max_keypoints=2048"``.
        registry: Providers that the configuration may name, by default all installed providers.
        on_event: Function that receives progress events.

    Returns:
        Keypoints, descriptors, scores and scales by image name.

    Raises:
        InputError: the feature provider or its weights are missing.
        ProviderRunError: the feature provider failed on an image.

    Examples:
        >>> features = mpsfm.extract_features(images, "sift")
        >>> features["view_0.jpg"].descriptors.shape
        (4096, 128)
    """
    config, registry = configure(config, registry, overrides, masks=masks, features=features)
    if config.features is None:
        raise InputError("features: the configuration has no features provider; name a provider")
    with _extraction(images, config, registry, ("features", "masks"), on_event) as context:
        assert context.config.features is not None
        table = FeatureTable(context, context.config.features)
        table.extract(range(len(images)))
    return FeatureSet(images.names, table, context.config.features)


def match_images(
    images: ImageSet,
    features: FeatureSet | Mapping[str, Features] | None = None,
    matcher: Provider | None = None,
    *,
    pairs: Sequence[NamePair] | None = None,
    retrieval: Provider | None = None,
    masks: Sequence[Provider] | None = None,
    config: PathLike | Config = "default",
    overrides: Sequence[str] = (),
    registry: Registry | None = None,
    on_event: EventCallback | None = None,
) -> MatchGraph:
    """Match image pairs, and verify the matches with two-view geometry.

    Args:
        images: Result of :func:`load_images`.
        features: Result of :func:`extract_features`, or features that the caller computed, by image
            name. By default, the configured provider extracts features.
        matcher: Sparse or dense matcher, by default the configured matcher. The default matcher for
            features that the caller computed is ``mutual-nearest``.
        pairs: Pairs of image names to match, by default selected as the configuration block
            ``pairs`` specifies.
        retrieval: Provider of global image descriptors for the selection of pairs.
        masks: Mask providers, in whose masked areas dense matches are removed.
        config: Configuration with providers and options.
        overrides: Settings such as ``"pairs.mode=sequential"``.
        registry: Providers that the configuration may name, by default all installed providers.
        on_event: Function that receives progress events.

    Returns:
        Matches with scores, verified pairs with relative poses, and reasons of dropped pairs.

    Raises:
        InputError: a provider is missing, or the matcher does not accept the features.
        ProviderRunError: a provider failed on an image or pair.

    Examples:
        >>> matches = mpsfm.match_images(images, features, "mutual-nearest")
        >>> len(matches.verified["view_0.jpg", "view_1.jpg"])
        208
    """
    provider = features.provider if isinstance(features, FeatureSet) else None
    if features is not None and matcher is None and provider is None:
        matcher = "mutual-nearest"
    config, registry = configure(config, registry, overrides, masks=masks, retrieval=retrieval)
    if features is not None:
        known = provider is not None and provider.use in registry.names("features")
        matcher = matcher if known or matcher is not None else "mutual-nearest"
        update = {"features": provider if known else None, "fast_pass": None}
        config = config.model_copy(update=update)
    config, registry = configure(config, registry, matcher=matcher)
    chosen = None if pairs is None else _rows_of_pairs(images, pairs)
    blocks = ("features", "matcher", "dense_matcher", "retrieval", "masks")
    with _extraction(images, config, registry, blocks, on_event) as context:
        source: FeatureSource | None
        if features is None:
            source = runner.feature_table(context)
        elif isinstance(features, FeatureSet):
            source = features.source
        else:
            source = GivenFeatures(images.names, features)
        return runner.match_images(context, source, pairs=chosen)


def predict_priors(
    images: ImageSet,
    depth: Provider | None = None,
    normals: Provider | None = None,
    *,
    multiview: Provider | None = None,
    matches: MatchGraph | None = None,
    masks: Sequence[Provider] | None = None,
    config: PathLike | Config = "default",
    overrides: Sequence[str] = (),
    registry: Registry | None = None,
    on_event: EventCallback | None = None,
) -> Priors:
    """Predict depth and normals of all images, with calibrated variances.

    Args:
        images: Result of :func:`load_images`.
        depth: Depth provider, by default the configured depth provider.
        normals: Normals provider, by default the configured normals provider. If the depth provider
            predicts no normals, the default normals come from planes fitted to the depth map.
        multiview: Multi-view network, which is used if ``depth`` is ``"multiview"``.
        matches: Match graph, whose pairs define the groups of images for a multi-view network.
        masks: Mask providers, in whose masked areas depth and normals are invalid.
        config: Configuration with providers and options.
        overrides: Settings such as ``"extraction.integration_size=300"``.
        registry: Providers that the configuration may name, by default all installed providers.
        on_event: Function that receives progress events.

    Returns:
        Depth and normals with variance by image name, in the resolution that the mapper uses.

    Raises:
        InputError: a provider or its weights are missing.
        ProviderRunError: a provider failed on an image.

    Examples:
        >>> priors = mpsfm.predict_priors(images, depth=MyDepth())
        >>> priors.depth["view_0.jpg"].variance.shape
        (290, 387)
    """
    providers = {"depth": depth, "normals": normals, "multiview": multiview}
    config, registry = configure(config, registry, overrides, masks=masks, **providers)
    blocks = ("depth", "normals", "multiview", "masks")
    with _extraction(images, config, registry, blocks, on_event) as context:
        return runner.predict_priors(context, matches)


def run_mapper(
    problem: MappingProblem,
    options: MapperOptions | Mapping[str, Any] | None = None,
    *,
    on_event: EventCallback | None = None,
) -> MappingResult:
    """Reconstruct poses, points and refined depth maps from matches and priors.

    Args:
        problem: Result of :func:`build_problem`.
        options: Options of the mapper, or settings such as ``{"known_poses": "fixed"}``.
        on_event: Function that receives progress events. To cancel the mapper, the function raises
            :class:`~mpsfm_core.Cancelled`.

    Returns:
        Reconstruction of each connected component, the largest first, and the reason why an image
        is not registered, by image name.

    Raises:
        SettingsError: a mapper option is unknown or out of range.

    Examples:
        >>> result = mpsfm.run_mapper(problem, {"known_poses": "fixed"})
        >>> largest = result.reconstructions[0]
        >>> largest.poses["a"], largest.images[0].depth.variance
    """
    stages = Stages(Registry(), on_event)
    with stages.stage("mapping"):
        return part_mapping.reconstruct(problem, _parse_mapper_options(options), stages)


def _parse_mapper_options(options: MapperOptions | Mapping[str, Any] | None) -> MapperOptions:
    """Return mapper options from options or settings."""
    if isinstance(options, MapperOptions):
        return options
    return parse_settings(MapperOptions, options or {}, ())


def undistort_views(
    result: MappingResult,
    problem: MappingProblem,
    images: ImageSet,
    options: MapperOptions | Mapping[str, Any] | None = None,
) -> tuple[MappingResult, MappingProblem, ImageSet]:
    """Undistort images again with the distortion that the mapper estimated.

    Depth maps are refined again in the newly undistorted views. If the mapper estimated no
    distortion, all arguments are returned unchanged.

    Args:
        result: Result of :func:`run_mapper`.
        problem: Mapping problem, the input of :func:`run_mapper`.
        images: Images of the mapping problem.
        options: Options of the mapper for the refinement of depth maps, as in :func:`run_mapper`.

    Raises:
        SettingsError: a mapper option is unknown or out of range.

    Example:
        >>> result, problem, images = mpsfm.undistort_views(result, problem, images)
    """
    options = _parse_mapper_options(options)
    refined = undistort_images(images, problem, result.reconstructions)
    if refined is images:
        return result, problem, images
    problem = undistort_problem(images, refined, problem)
    parts = refine_reconstructions(refined, problem, result.reconstructions, options)
    return replace(result, reconstructions=parts), problem, refined


def to_colmap(
    reconstruction: Reconstruction, problem: MappingProblem, images: ImageSet | None = None
) -> pycolmap.Reconstruction:
    """Convert a reconstruction to a COLMAP model.

    Args:
        reconstruction: One reconstruction of the result of :func:`run_mapper`.
        problem: Mapping problem with the keypoints, the input of :func:`run_mapper`.
        images: Images of the mapping problem. With images, the model has original cameras and
            colored points. Without images, the model has the pinhole cameras of undistorted views
            and black points.

    Examples:
        >>> mpsfm.to_colmap(result.reconstructions[0], problem).num_points3D()
        8490
    """
    if images is None:
        return build_pinhole_model(reconstruction, problem)
    refined = undistort_images(images, problem, [reconstruction])
    photos = OriginalImages(refined, undistort_problem(images, refined, problem))
    return ComponentResult.of(undistort_cameras(refined, reconstruction), photos).model


def from_colmap(
    model: pycolmap.Reconstruction,
    images: ImageSet | None = None,
    depth: Mapping[str, DepthPrior] | None = None,
) -> Reconstruction:
    """Convert a COLMAP model to a reconstruction, for :func:`densify` and :func:`build_mesh`.

    Args:
        model: COLMAP model with poses and points.
        images: Images of the model, which are required for cameras with lens distortion.
        depth: Depth maps by image name in units of the model. An image without depth map gets a
            constant depth, whose standard deviation covers the depths of the points that the image
            observes.

    Raises:
        InputError: ``images`` is missing although a camera has lens distortion, or an image without
            depth map observes no points.

    Examples:
        >>> reconstruction = mpsfm.from_colmap(pycolmap.Reconstruction("sparse/0"), images)
        >>> dense = mpsfm.densify(reconstruction, images)
    """
    cameras = {} if images is None else {image.name: image.pinhole for image in images}
    return reconstruction_from_model(model, cameras, depth or {})


def densify(
    reconstruction: Reconstruction,
    images: ImageSet,
    options: DenseOptions | Mapping[str, Any] | None = None,
    *,
    on_event: EventCallback | None = None,
) -> Reconstruction:
    """Refine the depth maps of a reconstruction by multi-view stereo.

    Args:
        reconstruction: Posed images with depth maps.
        images: Images of the reconstruction.
        options: Options of multi-view stereo, or settings such as ``{"max_size": 800}``.
        on_event: Function that receives progress events.

    Returns:
        Copy of the reconstruction with dense depth maps.

    Examples:
        >>> dense = mpsfm.densify(result.reconstructions[0], images)
        >>> cloud = mpsfm.fuse(dense, images)
    """
    if isinstance(options, Mapping):
        options = parse_settings(DenseOptions, options, ())
    stages = Stages(Registry(), on_event)
    with stages.stage("dense"):
        progress = partial(stages.stage_progress, "dense")
        dense, _ = densify_reconstruction(
            reconstruction, images.view_of, options or DenseOptions(), progress=progress
        )
    return dense


def fuse(reconstruction: Reconstruction, images: ImageSet, seed: int = 0) -> FusedPointCloud:
    """Fuse the depth maps of a reconstruction into a colored point cloud.

    Args:
        reconstruction: Posed images with depth maps.
        images: Images of the reconstruction.
        seed: Random seed of the selection of pixels that become points.

    Examples:
        >>> mpsfm.fuse(dense, images).points.shape
        (181534, 3)
    """
    return fuse_depth_maps(reconstruction, images.view_of, seed=seed)


def build_mesh(
    reconstruction: Reconstruction,
    images: ImageSet,
    options: MeshOptions | Mapping[str, Any] | None = None,
) -> TriangleMesh:
    """Build a colored triangle mesh from the depth maps of a reconstruction.

    Args:
        reconstruction: Posed images with depth maps.
        images: Images of the reconstruction.
        options: Options of meshing, or settings such as ``{"max_triangles": 100000}``.

    Raises:
        InputError: the depth maps contain no surface, or the packages that ``pip install
            'mpsfm-core[mesh]'`` installs are missing.

    Examples:
        >>> mpsfm.build_mesh(dense, images).triangles.shape
        (120000, 3)
    """
    if isinstance(options, Mapping):
        options = parse_settings(MeshOptions, options, ())
    return mesh_depth_maps(reconstruction, images.view_of, options or MeshOptions())


def texture_mesh(
    mesh: TriangleMesh,
    reconstruction: Reconstruction,
    images: ImageSet,
    *,
    max_size: int = DEFAULT_MAX_TEXTURE_SIZE,
) -> TexturedMesh:
    """Texture a mesh with the photos of its reconstruction.

    Args:
        mesh: Mesh of :func:`build_mesh`.
        reconstruction: Reconstruction from which the mesh was built.
        images: Images of the reconstruction.
        max_size: Maximum side of the texture in pixels. Photos are reduced if necessary.

    Examples:
        >>> mpsfm.texture_mesh(mesh, dense, images).texture.shape
        (3120, 4021, 3)
    """
    return build_texture(mesh, reconstruction, images.view_of, max_size)


def evaluate(
    estimated: PathLike | Reconstruction | pycolmap.Reconstruction | Mapping[str, Any],
    truth: PathLike | Reconstruction | pycolmap.Reconstruction | Mapping[str, Any],
    images: Sequence[str] | None = None,
    *,
    convention: str = "paper",
) -> dict[str, Any]:
    """Evaluate estimated poses against true poses by pose AUC and trajectory errors.

    Args:
        estimated: Estimated poses as COLMAP model, reconstruction, result folder, or poses
            ``cam_from_world`` by image name in the forms that :func:`build_problem` accepts.
        truth: True poses, in the same forms as ``estimated``.
        images: Names of the images to evaluate, by default all images of ``truth``.
        convention: Convention of the pose AUC, one of ``paper``, ``models``, ``colmap`` and
            ``vggt``.

    Returns:
        Report as dictionary; the key ``auc`` has the pose AUC in percent by threshold in degrees.

    Raises:
        InputError: a COLMAP model cannot be read, an image has no true pose, or the convention is
            unknown.

    Examples:
        >>> mpsfm.evaluate("out/", "truth/")["auc"]["5"]
        97.1
    """
    if convention not in CONVENTIONS:
        raise InputError(f"no convention {convention!r}{did_you_mean(convention, CONVENTIONS)}")
    return evaluate_poses(_poses(estimated), _poses(truth), images, CONVENTIONS[convention])


def _poses(
    model: PathLike | Reconstruction | pycolmap.Reconstruction | Mapping[str, Any],
) -> Mapping[str, Pose]:
    if isinstance(model, Reconstruction):
        return model.poses
    return read_poses(Path(model) if isinstance(model, (str, Path)) else model)


def _rows_of_pairs(images: ImageSet, pairs: Sequence[NamePair]) -> list[tuple[int, int]]:
    """Convert pairs of image names to sorted pairs of image indices."""
    rows = images.row_of
    for name in np.unique([name for pair in pairs for name in pair]):
        if name not in rows:
            raise InputError(f"pairs: {name!r} is not one of the images{did_you_mean(name, rows)}")
    indices = {tuple(sorted((rows[a], rows[b]))) for a, b in pairs if a != b}
    return sorted((first, second) for first, second in indices)


@contextmanager
def _extraction(
    images: ImageSet,
    config: Config,
    registry: Registry,
    blocks: Sequence[str],
    on_event: EventCallback | None,
) -> Iterator[ExtractionContext]:
    """Choose the providers of configuration blocks, and open an extraction in a ``with`` block."""
    stages = Stages(registry, on_event)
    config = config.model_copy(update={"fast_pass": None})
    config = resolve_providers(config, registry, stages, blocks).config
    with limit_threads(config.runtime.workers), stages.stage("extraction"):
        context = ExtractionContext(images, config, registry, stages)
        with runner.extraction_environment(context):
            context.run_masks()
            yield context
