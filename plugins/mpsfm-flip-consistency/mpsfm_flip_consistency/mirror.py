"""Horizontal mirroring of views and priors, which returns the original if applied twice."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mpsfm_core import DepthPrior, NormalPrior, View


def mirror_view(view: View) -> View:
    """Mirror a view: reverse its columns, and move the principal point to ``W - cx``."""
    camera = replace(view.camera, cx=view.camera.width - view.camera.cx)
    mask = None if view.mask is None else view.mask[:, ::-1]
    return View(view.name, np.ascontiguousarray(view.image[:, ::-1]), camera, mask)


def mirror_depth(prior: DepthPrior) -> DepthPrior:
    """Reverse the columns of a depth prior."""
    variance = None if prior.variance is None else prior.variance[:, ::-1]
    return DepthPrior(prior.depth[:, ::-1], variance, prior.valid[:, ::-1], prior.metric)


def mirror_normals(prior: NormalPrior) -> NormalPrior:
    """Reverse the columns of a normal prior, and negate the x components of its normals."""
    variance = None if prior.variance is None else prior.variance[:, ::-1]
    normals = prior.normals[:, ::-1] * np.array([-1, 1, 1], dtype=np.float32)
    return NormalPrior(normals, variance, prior.valid[:, ::-1])
