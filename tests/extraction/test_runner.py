"""Tests of the whole extraction on a synthetic scene."""

from __future__ import annotations

import shutil
import threading
from itertools import combinations

import cv2
import numpy as np
import pycolmap
import pytest

from mpsfm_core.config import RuntimeOptions
from mpsfm_core.data import DepthPrior
from mpsfm_core.data.errors import ConfigError, ProviderOutputError, ProviderRunError
from mpsfm_core.extraction import output_checks
from mpsfm_core.extraction.cache import digest
from mpsfm_core.extraction.options import AdjustmentOptions, ExtractionOptions, PairOptions
from mpsfm_core.extraction.pairs import pairing as pairs
from mpsfm_core.extraction.pairs import similarity as pair_similarity
from mpsfm_core.extraction.priors.prior_maps import EDGE_VARIANCE
from mpsfm_core.extraction.runner import extract, predict_priors_again
from mpsfm_core.geometry import angle_between_deg, compose, invert, rotation_angle_deg
from mpsfm_core.inputs.images import load_images
from mpsfm_core.inputs.options import InputOptions
from mpsfm_core.providers import ProviderSpec, hookimpl
from mpsfm_core.providers.provider_config import ProviderConfig
from mpsfm_core.providers.uncertainty.calibration import DepthCalibration

ALL_PAIRS = {(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)}


def pairs_of(problem) -> set[tuple[int, int]]:
    return {(pair.image_a, pair.image_b) for pair in problem.pairs}


def identical(first, second) -> bool:
    images = [(digest(a), digest(b)) for a, b in zip(first.images, second.images, strict=True)]
    pairs = [(digest(a), digest(b)) for a, b in zip(first.pairs, second.pairs, strict=True)]
    return all(a == b for a, b in images + pairs)


def test_extract_on_analytic_scene_returns_true_problem(world) -> None:
    problem = world.extract().problem
    assert [image.name for image in problem.images] == world.names
    assert pairs_of(problem) == ALL_PAIRS
    for pair in problem.pairs:
        a, b = (world.poses[world.names[i]] for i in (pair.image_a, pair.image_b))
        rotation, translation = compose((b[:, :3], b[:, 3]), invert(a[:, :3], a[:, 3]))
        assert pair.calibrated
        assert rotation_angle_deg(pair.rotation @ rotation.T) < 0.3
        assert angle_between_deg(pair.translation, translation) < 1.0
        xy_a = problem.images[pair.image_a].keypoints[pair.matches[:, 0]]
        truth = world.scene.correspondences(
            problem.images[0].camera, a, problem.images[0].camera, b, xy_a
        )
        xy_b = problem.images[pair.image_b].keypoints[pair.matches[:, 1]]
        # A point that is occluded in one image can match a neighboring point.
        assert (np.abs(xy_b - truth.xy_b).max(axis=1) < 1e-3).mean() > 0.9


def test_extract_returns_priors_on_one_grid(world) -> None:
    options = ExtractionOptions(integration_size=80)
    image = world.extract(extraction=options).problem.images[1]
    truth = world.scene.render(image.camera.resized(80, 60), world.poses[image.name])
    assert image.depth.shape == image.normals.shape == (60, 80)
    relative = np.abs(image.depth.depth / truth.depth - 1)
    assert np.median(relative) < 1e-3
    std = np.sqrt(image.depth.variance) / image.depth.depth
    expected = np.maximum(DepthCalibration().relative_std, 0.02 / image.depth.depth)
    assert np.allclose(np.median(std / expected), 1, atol=0.01)
    edges = image.normals.variance == EDGE_VARIANCE
    assert 0.01 < edges.mean() < 0.6  # the slanted floor has large depth steps on the coarse grid
    trusting = ExtractionOptions(integration_size=80, edge_ratio=None)
    assert world.extract(extraction=trusting).problem.images[1].normals.variance.max() < 0.1


def test_extract_reports_pairs_images_and_providers(world) -> None:
    report = world.extract().report
    assert (report["pairs_proposed"], report["pairs_matched"]) == (6, 6)
    assert report["pairs_verified"] == 6
    first = report["pairs"][0]
    assert first["images"] == ["view0.png", "view1.png"]
    assert first["inliers"] <= first["matches"] and first["geometry"] == "calibrated"
    assert report["images"]["view0.png"]["valid_depth"] == 1.0
    used = {(p["kind"], p["name"]): (p["computed"], p["from_cache"]) for p in report["providers"]}
    assert used["features", "truth"] == (4, 0) and used["depth", "truth"][0] == 4


def test_extract_reports_reasons_of_dropped_pairs(world) -> None:
    world.seeds = world.seeds[:10]
    extraction = world.extract()
    assert not extraction.problem.pairs
    reasons = [pair["dropped"] for pair in extraction.report["pairs"]]
    assert any(reason.get("min_matches") == 15 for reason in reasons)


def test_extract_does_not_depend_on_number_of_workers(world) -> None:
    one = world.extract(runtime=RuntimeOptions(cache_dir=world.root / "one", workers=1))
    many = world.extract(runtime=RuntimeOptions(cache_dir=world.root / "many", workers=3))
    assert identical(one.problem, many.problem)


def test_joint_depth_and_normals_take_one_pass(world) -> None:
    separate = world.extract().problem
    world.asked()
    joint = world.extract(
        depth=ProviderConfig(use="joint"), normals=ProviderConfig(use="joint")
    ).problem
    assert world.asked() == {"joint": 4, "depth": 4}  # joint prediction calls depth
    assert identical(separate, joint)


def test_sampled_dense_matches_follow_sparse_matches(world) -> None:
    sparse = world.extract().problem
    both = world.extract(dense_matcher=ProviderConfig(use="dense")).problem
    for before, after in zip(sparse.images, both.images, strict=True):
        count = len(before.keypoints)
        assert np.array_equal(after.keypoints[:count], before.keypoints)
        added = after.keypoints[count:]
        assert len(added) > 10
    pair_before, pair_after = sparse.pairs[0], both.pairs[0]
    assert len(pair_after) > len(pair_before)
    free = pair_after.matches[:, 0] >= len(sparse.images[0].keypoints)
    assert np.array_equal(pair_after.matches[~free], pair_before.matches)
    distance = np.linalg.norm(
        both.images[0].keypoints[pair_after.matches[free, 0]][:, None]
        - sparse.images[0].keypoints[None],
        axis=2,
    )
    assert distance.min() >= 6


def test_sampled_dense_matches_have_separate_keypoints(world) -> None:
    problem = world.extract(
        features=None, matcher=None, dense_matcher=ProviderConfig(use="dense")
    ).problem
    assert pairs_of(problem) == ALL_PAIRS
    for index, image in enumerate(problem.images):
        columns = [p.matches[:, 0] for p in problem.pairs if p.image_a == index]
        columns += [p.matches[:, 1] for p in problem.pairs if p.image_b == index]
        rows = np.sort(np.concatenate(columns))
        assert np.array_equal(rows, np.arange(len(image.keypoints)))
        assert image.keypoint_std_px == 2.0


def test_dense_matches_snap_to_features_without_a_sparse_matcher(world) -> None:
    options = ExtractionOptions(dense_snap_px=4.0)
    problem = world.extract(
        matcher=None, dense_matcher=ProviderConfig(use="dense"), extraction=options
    ).problem
    features = world.positions(world.names[0])[0]
    assert np.array_equal(problem.images[0].keypoints[: len(features)], features)
    snapped = problem.pairs[0].matches[:, 0] < len(features)
    assert 0 < snapped.sum() < len(snapped)


def test_depth_from_matcher_uses_most_precise_pair(world) -> None:
    """The depth of an image comes from the pair with the smallest variance."""
    calibration = {"std_scale": 1.0, "relative_std": 0.0, "std_floor": 0.0}
    problem = world.extract(
        dense_matcher=ProviderConfig(use="dense-depth"),
        depth=ProviderConfig(use="matcher", calibration=calibration),
    ).problem
    furthest = {0: 3, 1: 2, 2: 2, 3: 3}  # images apart
    for index, image in enumerate(problem.images):
        std = np.sqrt(image.depth.variance) / image.depth.depth
        assert np.median(std) == pytest.approx(0.1 - 0.01 * furthest[index], rel=1e-3)


def test_depth_from_matcher_without_pair_depth_is_a_config_error(world) -> None:
    with pytest.raises(ConfigError, match="'mutual-nearest' predicts no depth"):
        world.extract(depth=ProviderConfig(use="matcher"))
    assert not world.asked()


def test_mask_providers_remove_features_and_priors(world) -> None:
    plain = world.extract().problem
    problem = world.extract(masks=(ProviderConfig(use="left"),)).problem
    for image, full in zip(problem.images, plain.images, strict=True):
        assert 0 < len(image.keypoints) < len(full.keypoints)
        assert image.keypoints[:, 0].max() <= 80
        middle = image.depth.shape[1] // 2
        assert image.depth.valid[:, :middle].all() and not image.depth.valid[:, middle + 1 :].any()
        assert not image.normals.valid[:, middle + 1 :].any()


def test_masks_of_providers_and_user_intersect(world) -> None:
    (world.root / "masks").mkdir()
    for name in world.names:
        drawn = np.zeros((120, 160), np.uint8)
        drawn[60:] = 255
        cv2.imwrite(str(world.root / "masks" / name), drawn)
    problem = world.extract(
        inputs=InputOptions(masks=world.root / "masks"), masks=(ProviderConfig(use="left"),)
    ).problem
    for image in problem.images:
        assert image.keypoints[:, 0].max() <= 80 and image.keypoints[:, 1].min() >= 60
        assert image.depth.valid.mean() == pytest.approx(0.25, abs=0.02)


def test_dense_matches_in_masked_areas_are_removed(world) -> None:
    problem = world.extract(
        features=None,
        matcher=None,
        dense_matcher=ProviderConfig(use="dense"),
        masks=(ProviderConfig(use="left"),),
    ).problem
    assert problem.pairs
    assert max(image.keypoints[:, 0].max() for image in problem.images) <= 80


def test_retrieval_mode_matches_similar_images(world) -> None:
    options = PairOptions(mode="retrieval", top_k=1)
    extraction = world.extract(pairs=options, retrieval=ProviderConfig(use="truth"))
    assert pairs_of(extraction.problem) == {(0, 1), (1, 2), (2, 3)}
    with pytest.raises(ConfigError, match=r"set retrieval\.use"):
        world.extract(pairs=options)


def test_auto_mode_with_few_images_matches_all_pairs(world) -> None:
    assert world.extract(pairs=PairOptions(mode="auto", partners=3)).report["pairs_matched"] == 6


def test_auto_mode_uses_similarity(world) -> None:
    """All views share points, neighbors most; the similarity is cached for the second run."""
    options = PairOptions(mode="auto", partners=1, overlap=1)
    first = world.extract(pairs=options)
    assert pairs_of(first.problem) == {(0, 1), (1, 2), (2, 3)}
    assert len(list((world.cache / "extraction" / "pair-similarity").rglob("*.npz"))) == 1
    again = world.extract(pairs=options, runtime=RuntimeOptions(cache_dir=world.cache, workers=1))
    assert again.report["pairs"] == first.report["pairs"]


def test_auto_mode_uses_retrieval_if_configured(world) -> None:
    options = PairOptions(mode="auto", partners=1, overlap=1)
    extraction = world.extract(pairs=options, retrieval=ProviderConfig(use="truth"))
    assert pairs_of(extraction.problem) == {(0, 1), (1, 2), (2, 3)}
    assert world.asked()["retrieval"] == 4


def test_auto_mode_without_features_matches_all_pairs(world) -> None:
    changes = {"features": None, "matcher": None, "dense_matcher": ProviderConfig(use="dense")}
    extraction = world.extract(pairs=PairOptions(mode="auto", partners=1), **changes)
    assert extraction.report["pairs_matched"] == 6


def test_auto_mode_matches_pairs_between_components(world, monkeypatch) -> None:
    """Only images within each half are similar, and names have no numbers."""
    values = np.array([1, 1e-3, 0, 0, 1e-3, 1])  # of the pairs 01, 02, 03, 12, 13, 23
    monkeypatch.setattr(
        pair_similarity, "diffuse_similarity", lambda scores, count: scores._replace(values=values)
    )
    monkeypatch.setattr(pairs, "numbered_neighbor_pairs", lambda names, options: [])
    extraction = world.extract(pairs=PairOptions(mode="auto", partners=1))
    assert extraction.report["pairs_matched"] == 3
    assert {(0, 1), (2, 3)} < pairs_of(extraction.problem)


def test_pair_filters_of_plugins_remove_pairs(world) -> None:
    class OnlyNeighbours:
        @hookimpl
        def mpsfm_filter_pairs(self, pairs):
            return [(b, a) for a, b in pairs if int(b[4]) - int(a[4]) == 1]

    world.registry.register(OnlyNeighbours(), name="only-neighbours")
    extraction = world.extract()
    assert pairs_of(extraction.problem) == {(0, 1), (1, 2), (2, 3)}
    assert (extraction.report["pairs_proposed"], extraction.report["pairs_matched"]) == (6, 3)


def test_extract_runs_stages_in_order(world) -> None:
    class Recorder:
        def __init__(self) -> None:
            self.events: list[tuple[object, ...]] = []

        def stage_started(self, stage, total) -> None:
            self.events.append(("started", stage, total))

        def stage_progress(self, stage, done, total) -> None:
            self.events.append(("progress", stage, done, total))

        def stage_finished(self, stage, seconds) -> None:
            assert seconds >= 0
            self.events.append(("finished", stage))

    recorder = Recorder()
    world.extract(recorder, masks=(ProviderConfig(use="left"),), adjustment=AdjustmentOptions())
    started = [event[1:] for event in recorder.events if event[0] == "started"]
    assert started == [
        ("masks", 4),
        ("features", 4),
        ("matching", 6),
        ("verification", 6),
        ("adjustment", 6),
        ("depth", 4),
        ("normals", 4),
    ]
    progress = [event[2:] for event in recorder.events if event[:2] == ("progress", "depth")]
    assert progress == [(1, 4), (2, 4), (3, 4), (4, 4)]
    assert recorder.events[-1] == ("finished", "normals")


def test_normals_from_depth_get_the_calibrated_depth(world) -> None:
    problem = world.extract(normals=ProviderConfig(use="from-depth")).problem
    truth = world.scene.render(problem.images[0].camera, world.poses[world.names[0]])
    normals = problem.images[0].normals
    resized = cv2.resize(truth.normals, normals.shape[::-1], interpolation=cv2.INTER_LINEAR)
    cosine = (normals.normals * resized).sum(axis=-1)[normals.valid]
    assert normals.valid.mean() > 0.8 and np.median(np.degrees(np.arccos(cosine.clip(-1, 1)))) < 1


def test_error_of_broken_provider_names_the_provider(world) -> None:
    def fail() -> None:
        raise ZeroDivisionError("in the network")

    world.break_on["depth", "view2.png"] = fail
    with pytest.raises(ProviderRunError, match=r"'truth', image 'view2\.png': ZeroDivisionError"):
        world.extract()


def test_provider_output_with_nan_raises(world) -> None:
    def spoiled() -> DepthPrior:
        values = np.full((4, 4), 2.0, np.float32)
        prior = DepthPrior(values, None, np.ones((4, 4), np.bool_))
        values[1, 1] = np.nan  # the prior looks at the same memory
        return prior

    world.break_on["depth", "view1.png"] = spoiled
    with pytest.raises(ProviderOutputError, match=r"view1\.png.*depth: must be finite"):
        world.extract()
    assert world.asked()["features"] == 4
    world.break_on.clear()
    world.extract()
    assert world.asked()["features"] == 0  # earlier results are cached


def test_seed_is_passed_to_providers(world) -> None:
    seeds = []

    def factory(options, context):
        seeds.append((context.seed, context.threads, context.device))
        return type("Any", (), {"describe": lambda self, view: np.ones(2, np.float32)})()

    world.registry.add(ProviderSpec(kind="retrieval", name="seeded", factory=factory))
    runtime = RuntimeOptions(cache_dir=world.cache, workers=1, threads=3, seed=7, device="cpu")
    world.extract(
        runtime=runtime, pairs=PairOptions(mode="retrieval"), retrieval=ProviderConfig(use="seeded")
    )
    assert seeds == [(7, 3, "cpu")]


@pytest.mark.parametrize("kind", ["features", "depth", "normals"])
def test_on_error_skip_omits_image_of_failed_provider(world, kind: str) -> None:
    def fail() -> None:
        raise ZeroDivisionError("in the network")

    world.break_on[kind, "view2.png"] = fail
    runtime = RuntimeOptions(cache_dir=world.cache, workers=2, on_error="skip")
    found = world.extract(runtime=runtime)
    assert list(found.report["failed"]) == ["view2.png"]
    assert "'truth', image 'view2.png': ZeroDivisionError" in found.report["failed"]["view2.png"]
    image = found.problem.images[world.names.index("view2.png")]
    assert not (image.depth.valid.any() and image.normals.valid.any() and len(image.keypoints))
    # Failures are not cached, so the next run computes the missing results.
    world.break_on.clear()
    whole = world.extract(runtime=runtime)
    assert whole.report["failed"] == {}
    assert pairs_of(whole.problem) == ALL_PAIRS


def test_on_error_skip_raises_if_most_images_fail(world) -> None:
    def fail() -> None:
        raise ZeroDivisionError("in the network")

    for name in world.names[1:]:
        world.break_on["depth", name] = fail
    runtime = RuntimeOptions(cache_dir=world.cache, workers=1, on_error="skip")
    with pytest.raises(
        ProviderRunError, match=r"failed on 3 of 4 photos, most recently with: provider"
    ):
        world.extract(runtime=runtime)


@pytest.mark.parametrize("num_failing", [1, 4])
def test_on_error_skip_omits_failed_pairs_but_raises_if_most_pairs_fail(
    world, num_failing: int
) -> None:
    def fail() -> None:
        raise ZeroDivisionError("too many keypoints")

    for pair in list(combinations(world.names, 2))[:num_failing]:
        world.break_on["dense", " ".join(pair)] = fail
    runtime = RuntimeOptions(cache_dir=world.cache, workers=1, on_error="skip")
    settings = {"matcher": None, "dense_matcher": ProviderConfig(use="dense")}
    if num_failing == 1:
        found = world.extract(runtime=runtime, **settings)
        assert found.report["pairs_verified"] == 5
        return
    with pytest.raises(ProviderRunError, match=r"matchers failed on 4 of 6 pairs, .*keypoints"):
        world.extract(runtime=runtime, **settings)


def test_hanging_provider_raises_after_timeout(world) -> None:
    released = threading.Event()
    world.break_on["depth", "view2.png"] = lambda: released.wait(60) and None
    try:
        runtime = RuntimeOptions(cache_dir=world.cache, workers=2, timeout_s=1.0)
        with pytest.raises(ProviderRunError, match=r"'truth': no answer within 1 s"):
            world.extract(runtime=runtime)
    finally:
        released.set()


@pytest.mark.parametrize("timeout_s", [None, 60.0])
def test_timeout_error_of_provider_is_not_the_time_limit(world, timeout_s: float | None) -> None:
    def fail() -> None:
        raise TimeoutError("the server does not answer")

    world.break_on["depth", "view2.png"] = fail
    runtime = RuntimeOptions(cache_dir=world.cache, timeout_s=timeout_s)
    with pytest.raises(ProviderRunError, match="the server does not answer"):
        world.extract(runtime=runtime)


def test_matcher_of_features_decodes_no_image(world) -> None:
    first = world.extract().problem
    shutil.rmtree(world.cache / "extraction" / "matcher")
    images = load_images(world.root / "images", world.root / "intrinsics.yaml")
    shutil.rmtree(world.root / "images")  # decoding raises
    assert identical(extract(images, world.config(), world.registry).problem, first)
    assert (world.cache / "extraction" / "matcher").is_dir()


def test_scores_of_some_pairs_are_checked(world, monkeypatch: pytest.MonkeyPatch) -> None:
    checked = []
    monkeypatch.setattr(output_checks, "_MAX_PAIRS", 4)
    monkeypatch.setattr(
        output_checks, "find_meaningless_scores", lambda pairs, _: checked.append(len(pairs))
    )
    world.extract()
    assert checked == [3]  # every second of 6 pairs


def with_nan() -> DepthPrior:
    values = np.full((4, 4), 2.0, np.float32)
    prior = DepthPrior(values, None, np.ones((4, 4), np.bool_))
    values[1, 1] = np.nan  # the prior looks at the same memory
    return prior


def test_on_error_skip_omits_image_with_nan(world) -> None:
    world.break_on["depth", "view1.png"] = with_nan
    runtime = RuntimeOptions(cache_dir=world.cache, workers=2, on_error="skip")
    found = world.extract(runtime=runtime)
    assert list(found.report["failed"]) == ["view1.png"]
    assert (
        "'truth', image 'view1.png': depth: must be finite" in found.report["failed"]["view1.png"]
    )


def test_provider_that_writes_to_its_view_raises(world) -> None:
    """Views are read-only; the error names the provider that writes to a view."""
    seen: dict[str, np.ndarray] = {}

    class Scribbles:
        def describe(self, view):
            seen[view.name] = view.image.copy()
            if view.name == "view2.png":
                view.image[:10] = 0
            return np.eye(4, dtype=np.float32)[int(view.name[4])]

    factory = lambda options, context: Scribbles()  # noqa: E731
    world.registry.add(ProviderSpec(kind="retrieval", name="scribbles", factory=factory))
    options = PairOptions(mode="retrieval", top_k=1)
    changes = {"pairs": options, "retrieval": ProviderConfig(use="scribbles")}
    with pytest.raises(
        ProviderRunError, match=r"'scribbles', image 'view2\.png': ValueError: .*read-only"
    ):
        world.extract(**changes)
    runtime = RuntimeOptions(cache_dir=world.cache, workers=1)
    before = seen["view2.png"]
    with pytest.raises(ProviderRunError):
        world.extract(runtime=runtime, **changes)
    assert np.array_equal(before, seen["view2.png"]) and before[:10].any()


def test_predict_priors_again_replaces_priors_and_keeps_matches(world) -> None:
    extraction = world.extract()
    world.asked()
    images = load_images(world.root / "images", world.root / "intrinsics.yaml")
    camera = pycolmap.Camera(
        model="SIMPLE_RADIAL", width=160, height=120, params=[140, 80, 60, -0.2], camera_id=1
    )
    refined = images.with_cameras({images[0].name: camera})
    problem = predict_priors_again(refined, world.config(), world.registry, extraction.problem)
    assert world.asked() == {"depth": 1, "normals": 1}  # other views have cached priors
    for new, old in zip(problem.images, extraction.problem.images, strict=True):
        np.testing.assert_array_equal(new.keypoints, old.keypoints)
    assert problem.pairs is extraction.problem.pairs
    assert problem.images[0].depth.shape != extraction.problem.images[0].depth.shape
