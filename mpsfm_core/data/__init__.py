"""Immutable, validated data classes that cross package boundaries.

Providers take and return instances of the data classes, and the mapper takes a
:class:`MappingProblem`. Constructors check shape, dtype and range, raise
:class:`~mpsfm_core.data.errors.DataError`, and store arrays as read-only views.

Conventions:

* Camera frame: x right, y down, z forward.
* Depth is z, in meters if ``metric``.
* Normals are unit vectors in the camera frame that face the camera (``n . ray < 0``).
* Pixels follow COLMAP: the center of the first pixel is (0.5, 0.5).
* Transforms are ``b_from_a``; the pose of an image is ``cam_from_world``.
* Uncertainty is a variance unless the name contains ``std`` (standard deviation).
"""

from mpsfm_core.data.arrays import Bool, Float32, Float64, Int64, Pose, UInt8
from mpsfm_core.data.cameras import PinholeCamera, View, dot_with_rays
from mpsfm_core.data.features import DenseMatches, Features, PairMatches, SparseMatches
from mpsfm_core.data.mapping_problem import (
    MappingImage,
    MappingProblem,
    PosedImage,
    SceneState,
    VerifiedPair,
)
from mpsfm_core.data.priors import (
    UNIT_NORMAL_TOLERANCE,
    DepthPrior,
    MultiViewPrior,
    NormalPrior,
    PairDepth,
)
from mpsfm_core.data.rigs import Rig

__all__ = [
    "UNIT_NORMAL_TOLERANCE",
    "Bool",
    "DenseMatches",
    "DepthPrior",
    "Features",
    "Float32",
    "Float64",
    "Int64",
    "MappingImage",
    "MappingProblem",
    "MultiViewPrior",
    "NormalPrior",
    "PairDepth",
    "PairMatches",
    "PinholeCamera",
    "Pose",
    "PosedImage",
    "Rig",
    "SceneState",
    "SparseMatches",
    "UInt8",
    "VerifiedPair",
    "View",
    "dot_with_rays",
]
