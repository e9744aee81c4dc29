"""Names of the files and folders that a run writes into its output folder.

Folders that contain a ``summary.json`` are results, so the search for input images skips them. The
package ``mpsfm_core.results`` writes the result files, and ``mpsfm_core.report`` reads the result
files.
"""

SUMMARY = "summary.json"
"""Summary of a run: configuration, reconstructed components, and reasons for missing images."""
IMAGES = "images"
"""Folder of images that the caller passed as arrays, written as PNG files."""
CUT_VIEWS = "perspective_views"
"""Folder of the perspective images that a run cuts out of panoramas and fisheye images. The image
of viewing direction k of the image ``a.jpg`` is ``camera<k>/a.jpg``."""
MASKS_OF_VIEWS = "perspective_masks"
"""Folder of the masks of these perspective images."""
SPARSE = "sparse"
"""COLMAP model of the original (distorted) images in binary format."""
SPARSE_TEXT = "sparse_text"
"""COLMAP model of the original (distorted) images in text format."""
COMPONENTS = "components"
"""COLMAP models of the components after the largest, numbered from 1 by decreasing size."""
UNDISTORTED = "undistorted"
"""Folder of the undistorted images and their COLMAP model with pinhole cameras."""
POINTS = "points.ply"
"""Triangulated points of the largest component."""
DENSE = "dense.ply"
"""Fused depth maps."""
DEPTH = "depth"
"""Refined depth maps of the images, ``NAME.npz``."""
MESH_PLY = "mesh.ply"
"""Surface mesh with vertex colors, which ``mpsfm mesh`` extracts from the depth maps."""
MESH_GLB = "mesh.glb"
"""The same mesh with a texture in the upright frame, y up."""
MESH_OBJ = "mesh.obj"
"""The same mesh with a texture in the world frame; the texture is in ``mesh.mtl`` and
``mesh.jpg``."""
MESH = (MESH_PLY, MESH_GLB, MESH_OBJ, "mesh.mtl", "mesh.jpg")
"""All files of a mesh."""
TRANSFORMS = "transforms.json"
"""Cameras and poses in the format of nerfstudio."""
TRAJECTORY = "trajectory.txt"
"""Poses of the frames of a video in the format of TUM, ``timestamp tx ty tz qx qy qz qw``."""
FRAME_TABLE = "trajectory.csv"
"""Source, standard deviation and number of inliers of each frame of a video."""
TRAJECTORIES = "trajectories"
"""Folder of the same two files for each of several videos, ``NAME.txt`` and ``NAME.csv``."""
VIEWS = "views"
"""Thumbnails, priors and matches that the HTML report displays."""
REPORT = "report.html"
"""Report page."""
ENTRIES = (
    SPARSE,
    SPARSE_TEXT,
    COMPONENTS,
    UNDISTORTED,
    POINTS,
    DENSE,
    *MESH,
    DEPTH,
    TRANSFORMS,
    TRAJECTORY,
    FRAME_TABLE,
    TRAJECTORIES,
    VIEWS,
    REPORT,
    SUMMARY,
)
"""All files and folders of the output folder that a run may replace."""
