"""Compares reconstructions with ground truth."""

from mpsfm_core.evaluation.alignment import TrajectoryErrors, trajectory_errors
from mpsfm_core.evaluation.models import evaluate, read_poses, reconstruction_poses
from mpsfm_core.evaluation.pose_auc import CONVENTIONS, Pose, pose_auc, pose_errors_deg

__all__ = [
    "CONVENTIONS",
    "Pose",
    "TrajectoryErrors",
    "evaluate",
    "pose_auc",
    "pose_errors_deg",
    "read_poses",
    "reconstruction_poses",
    "trajectory_errors",
]
