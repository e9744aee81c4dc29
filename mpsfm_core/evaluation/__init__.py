"""Evaluation of reconstructions with ground truth, and the benchmark of mappers."""

from mpsfm_core.data import Pose
from mpsfm_core.evaluation.alignment import TrajectoryErrors, trajectory_errors
from mpsfm_core.evaluation.pose_auc import CONVENTIONS, pose_auc, pose_errors_deg
from mpsfm_core.evaluation.pose_evaluation import evaluate
from mpsfm_core.inputs.models import read_poses, reconstruction_poses

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
