"""Names of the files and folders that a run writes into its output folder.

Readers of images skip folders that contain :data:`SUMMARY`; ``results`` writes the files and
``report`` reads them.
"""

SUMMARY = "summary.json"
"""Marks a result folder: what was run, what was reconstructed, and why images are missing."""
SPARSE = "sparse"
"""COLMAP model of the original images, binary."""
SPARSE_TEXT = "sparse_text"
"""The same model as text."""
COMPONENTS = "components"
"""Models of further components, numbered from 1, largest first."""
UNDISTORTED = "undistorted"
"""Undistorted images with a COLMAP model of pinhole cameras."""
POINTS = "points.ply"
"""Triangulated points of the largest component."""
DENSE = "dense.ply"
"""Fused depth maps."""
DEPTH = "depth"
"""Refined depth maps, ``NAME.npz``."""
MESH = ("mesh.ply", "mesh.glb")
"""Surface mesh, made from the depth maps after the run."""
TRANSFORMS = "transforms.json"
"""Cameras and poses for nerfstudio."""
VIEWS = "views"
"""Small images, priors and matches that the report shows."""
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
    VIEWS,
    REPORT,
    SUMMARY,
)
"""All entries of an output folder that a run may replace."""
