"""Contract checks that apply to every kind of provider.

A contract check is a function whose only argument, the
:class:`~mpsfm_core.testing.contract_case.ContractCase`, contains the provider under test. A
contract check returns nothing or a remark if the provider passes, and otherwise raises
``CheckFailed`` or ``CheckSkipped`` with the reason. The id of a contract check is the function name
without ``check_`` and with dashes. The first line of a check's docstring states what the check
requires of the provider; the rest gives the reason or the limits of the check.

Most contract checks use one view of 192 x 144 pixels, so that a small network needs only a fraction
of a second. Outputs of a provider are compared bit for bit, because a run reuses cached outputs.
"""

from __future__ import annotations

import pickle
import sys
import threading
import time
from dataclasses import fields, replace
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from mpsfm_core.data import (
    DepthPrior,
    Features,
    MultiViewPrior,
    NormalPrior,
    PairMatches,
    UInt8,
    View,
)
from mpsfm_core.providers import ENTRY_POINT_GROUP
from mpsfm_core.providers.discovery import find_spec_fault
from mpsfm_core.testing.accuracy import (
    DEPTH_TOLERANCE,
    NORMALS_TOLERANCE_DEG,
    compare_with_truth,
    require_correct_matches,
)
from mpsfm_core.testing.checks.process import PROCESS_CHECKS
from mpsfm_core.testing.contract_case import CALL_TIMEOUT_S, ContractCase, describe_difference
from mpsfm_core.testing.examples import Example
from mpsfm_core.testing.map_errors import error_quantile
from mpsfm_core.testing.outcome import CheckFailed, CheckSkipped
from mpsfm_core.testing.second_process import measure_import

HEAVY_MODULES = (
    *("torch", "torchvision", "onnxruntime", "tensorflow", "jax", "kornia", "transformers"),
    *("cv2", "scipy", "pycolmap", "pandas", "sklearn", "skimage", "matplotlib", "numba"),
)
"""Libraries that a plugin module must not import, because each import takes seconds at every
start."""
MAX_IMPORT_S = 2.0
"""Time limit in seconds to import a plugin module and list its providers. A plugin module without
slow imports takes milliseconds; the time limit allows for a busy machine."""
_MAX_ROUNDS = 20
"""Largest number of parallel calls in the check ``threads``."""
_STEP_OF_EQUAL_PIXELS = 8
"""Distance of the rows and columns at which two different views in the check ``no-state`` have
equal pixels."""
_FLOOR = (0, 112, 48, 32)
"""Left, top, width and height in pixels of a part of the example view that shows the floor only."""
_PANORAMA_RATIO = 5
"""Ratio between the sides of the views in the check ``panorama``."""
_LARGE_PORTRAIT_SIZE = (800, 1280)
"""Width and height in pixels of a painted view of more than one megapixel, whose width limits the
run time."""
_THREADS_TIME_S = 0.2
"""Time in seconds after which the check ``threads`` makes no further calls."""


def check_specification(case: ContractCase) -> str:
    """Require that the registry accepts the specification and the options of the ContractSetup."""
    fault, hint = find_spec_fault(case.spec)
    if fault:
        raise CheckFailed(f"the provider specification {fault}; {hint}")
    if (
        case.spec.kind == "wrapper"
        and not {"wraps-depth", "wraps-normals"} & case.spec.capabilities
    ):
        raise CheckFailed("a wrapper has to declare 'wraps-depth' or 'wraps-normals'")
    case.registry.validate_options(case.spec.kind, case.name, case.setup.options)
    if case.spec.code_license == "unknown":
        return "declare code_license, which users need to know"
    return ""


def check_construction(case: ContractCase) -> None:
    """Require that the factory constructs the provider with the options of the ContractSetup.

    Constructor or first call have to open the weights files of the specification by
    ``context.resolve_weights``. Only this function downloads files and compares their SHA-256.
    """
    assert case.provider is not None
    case.require_resolved_weights()


def check_missing_file(case: ContractCase) -> str:
    """Require an error that names the file if an option names a file that does not exist.

    The check replaces each option of the ContractSetup that names a file, such as the weights of
    the test network. A provider with random weights returns maps that look like predictions.
    """
    files = case.file_options()
    if not files:
        raise CheckSkipped("no option of the ContractSetup names a file")
    for option, path in files.items():
        missing = path.with_name(f"missing-{path.name}")
        try:
            case.with_options(**{option: str(missing)}).run(case.example)
        except Exception as error:
            if missing.name not in str(error):
                reason = f"{type(error).__name__}: {error}"
                raise CheckFailed(
                    f"the error does not name the missing file of option {option!r}: {reason}"
                ) from error
        else:
            raise CheckFailed(f"the provider returns an output without the file of {option!r}")
    return ", ".join(files)


def check_light_import(case: ContractCase) -> str:
    """Require that importing the plugin's module is fast and imports no heavy library.

    Every start of MP-SfM imports the modules of all plugins.
    """
    modules = _find_plugin_modules(case)
    if not modules:
        raise CheckSkipped("the provider was registered in this process, not by an entry point")
    seconds, heavy = measure_import(tuple(sys.path), tuple(modules), HEAVY_MODULES)
    if heavy:
        raise CheckFailed(f"the plugin module {modules[0]!r} imports {' '.join(heavy)}")
    if seconds > MAX_IMPORT_S:
        raise CheckFailed(f"importing the plugin module {modules[0]!r} takes {seconds:.1f} s")
    return f"{seconds:.3f} s to import"


def check_output_rules(case: ContractCase) -> None:
    """Require that the provider's output passes the validator.

    The output validator checks type, dtype, shape and values, and the fields that the provider's
    capabilities require. If ``output-rules`` fails, all checks that call the provider are skipped.
    """
    case.run(case.example)


def check_deterministic(case: ContractCase) -> None:
    """Require bitwise equal output from repeated calls and from two instances.

    Outputs of providers are cached, and a run with a fixed seed must be repeatable.
    """
    first = case.run(case.example)
    _require_same(first, case.run(case.example, case.provider), "in a second call")
    _require_same(first, case.observed.answers[-1], "of a second instance")


def check_no_state(case: ContractCase) -> None:
    """Require that the output for a view does not depend on earlier or later calls.

    A reconstruction calls a provider for the images in any order. An output array must not share
    memory with a buffer that later calls overwrite.
    """
    # The shared instance predicts in the reverse order, so that each view has other predecessors.
    # Outputs are copied, because a later call could overwrite the output of an earlier call.
    reverse = [
        pickle.loads(pickle.dumps(case.run(example))) for example in case.example_sequence[::-1]
    ]
    for expected, answer in zip(reverse[::-1], case.observed.answers, strict=True):
        _require_same(expected, answer, "after other views, or of an earlier call,")
    _require_no_stale_output(case)


def check_inputs_unchanged(case: ContractCase) -> None:
    """Require that the provider does not modify the view, depth or features that it receives.

    Other providers of the same run use the same arrays. A second view has a small range of colors,
    because a provider may stretch the contrast of a view in place.
    """
    image = np.array(case.small_example.view.image)
    _require_inputs_unchanged(case, image)
    if case.setup.prepare is None:
        _require_inputs_unchanged(case, (80 + 0.25 * image).astype(np.uint8))


def _require_inputs_unchanged(case: ContractCase, image: UInt8) -> None:
    """Require that a call with a masked view of the given image modifies no input."""
    example = case.small_example
    mask = np.ones(image.shape[:2], np.bool_)
    mask[:, : image.shape[1] // 3] = False
    view = View(example.name, image, example.camera, mask)
    case.prepare(example)
    auxiliary = case.make_auxiliary_input(view, example)
    before = pickle.loads(pickle.dumps((image, view.mask, auxiliary)))
    case.run_on_view(view, example, case.provider, auxiliary)
    after = (image, view.mask, auxiliary)
    for name, old, new in zip(("image", "mask", "depth or features"), before, after, strict=True):
        difference = describe_difference(old, new)
        if difference:
            raise CheckFailed(f"the provider modifies its input {name}: {difference}")


def check_name_does_not_matter(case: ContractCase) -> None:
    """Require that the output does not depend on the name and the EXIF orientation of the view.

    The cache of a run identifies an image by its pixels, which are upright. Providers that read a
    file per image declare the capability ``uncached``.
    """
    if case.declares("uncached"):
        raise CheckSkipped("declares 'uncached'")
    if case.setup.prepare is not None:
        raise CheckSkipped("the provider reads one prepared file per view name")
    example = case.small_example
    # The new name sorts after the name of the partner, the old one before.
    for orientation in (6, 3, 8):
        renamed = replace(example.view, name="zoo/another-name.jpg", orientation=orientation)
        _require_same(case.run(example), case.run_on_view(renamed, example), "of a renamed view")
    same_name = replace(example.partner.view, name=example.name)
    auxiliary = case.make_auxiliary_input(same_name, example.partner)
    _require_same(
        case.run_on_view(same_name, example.partner, auxiliary=auxiliary),
        case.run_on_view(
            replace(same_name, name="zoo/third-name.jpg"), example.partner, auxiliary=auxiliary
        ),
        "for another view of the same name",
    )


def check_intrinsics_declared(case: ContractCase) -> None:
    """Require the capability ``intrinsics-aware`` if the output depends on the intrinsics.

    Without the capability ``intrinsics-aware``, the cache of a run would return the output for a
    camera with another focal length or principal point.
    """
    if case.declares("intrinsics-aware"):
        raise CheckSkipped("declares 'intrinsics-aware'")
    if case.declares("uncached"):
        raise CheckSkipped("declares 'uncached'")
    example = case.small_example
    expected, camera = case.run(example), example.camera
    longer = replace(
        camera, fx=1.3 * camera.fx, fy=1.4 * camera.fy, cx=0.9 * camera.cx, cy=1.1 * camera.cy
    )
    answer = case.run_on_view(replace(example.view, camera=longer), example)
    # Another focal length may only change which normals face the camera, not the normals
    # themselves.
    if isinstance(expected, NormalPrior):
        expected, answer = _select_valid_in_both(expected, answer)
    difference = describe_difference(expected, answer)
    if difference:
        raise CheckFailed(
            f"the output depends on the intrinsics, but the provider does not declare "
            f"'intrinsics-aware': {difference}"
        )


def check_threads(case: ContractCase) -> None:
    """Require that two instances in two threads give the same output as each instance alone.

    A run creates one instance of a provider per thread. The views of both threads have different
    sizes.
    """
    examples = [case.example, case.small_example]
    alone = [case.run(example) for example in examples]
    instances = [case.provider, case.observed.provider]
    parallel: list[Any] = [None] * len(examples)
    started, num_rounds, is_done = time.perf_counter(), 0, False

    def start_round() -> None:
        nonlocal num_rounds, is_done
        is_late = num_rounds > 0 and time.perf_counter() - started > _THREADS_TIME_S
        is_done = is_late or num_rounds >= _MAX_ROUNDS
        num_rounds += 1

    # Both threads start each call together, so that the calls overlap.
    barrier = threading.Barrier(len(examples), start_round, timeout=600)

    def work(index: int) -> None:
        while barrier.wait() >= 0 and not is_done:
            try:
                answer = case.run(examples[index], instances[index])
            except Exception as error:
                answer = error
            differs = isinstance(answer, Exception) or describe_difference(alone[index], answer)
            if parallel[index] is None or differs:
                parallel[index] = answer

    # Daemon threads do not keep the process alive if the provider waits for a lock forever.
    threads = [
        threading.Thread(target=work, args=(index,), daemon=True) for index in range(len(examples))
    ]
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    try:
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(2 * CALL_TIMEOUT_S)
    finally:
        sys.setswitchinterval(interval)
    if any(thread.is_alive() for thread in threads):
        raise CheckFailed("calls of the provider in two parallel threads do not return")
    for expected, answer in zip(alone, parallel, strict=True):
        if isinstance(answer, Exception):
            raise CheckFailed(f"the provider fails in two parallel threads: {answer}") from answer
        _require_same(expected, answer, "in two parallel threads")


def check_pickles(case: ContractCase) -> None:
    """Require that factory, options and output of the provider can be pickled.

    Process pools and other executors send factory, options and output between processes.
    """
    options = case.registry.validate_options(case.spec.kind, case.name, case.setup.options)
    answer = case.run(case.example)
    for name, value in (("factory", case.spec.factory), ("options", options), ("answer", answer)):
        try:
            copy = pickle.loads(pickle.dumps(value))
        except Exception as error:
            reason = f"{type(error).__name__}: {error}"
            raise CheckFailed(f"the {name} cannot be pickled: {reason}") from error
    _require_same(answer, copy, "after pickling")


def check_offline(case: ContractCase) -> None:
    """Require that a provider opens no network connection once its weights are local.

    The check ``offline`` detects sockets opened by Python code, not sockets of native libraries.
    """
    if case.observed.connections:
        raise CheckFailed(
            f"the provider opens a network connection: {case.observed.connections[0]}"
        )


def check_odd_size(case: ContractCase) -> str:
    """Require accurate output for a view with odd width and height (149 x 107 pixels).

    Both sizes are prime numbers, so that the stride of no network divides the image size.
    """
    return _run_and_compare(case, case.example.sized(149, 107))


def check_portrait(case: ContractCase) -> str:
    """Require accurate output for a view in portrait format."""
    width, height = case.example.camera.size
    return _run_and_compare(case, case.example.sized(height, width))


def check_panorama(case: ContractCase) -> str:
    """Require accurate maps of views with an aspect ratio of 5:1 and 1:5.

    A network may stretch a panorama to its input size, but its map has to cover the whole view.
    """
    if not case.description.predicts_maps:
        raise CheckSkipped("the check applies to providers of maps only")
    width, height = case.example.camera.size
    wide = case.example.crop(0, 3 * height // 8, width, width // _PANORAMA_RATIO)
    tall = case.example.crop(width // 4, 0, height // _PANORAMA_RATIO, height)
    return " and ".join(_run_and_compare(case, example) for example in (wide, tall))


def check_few_colors(case: ContractCase) -> str:
    """Require an accurate map of a part of a view that has a small range of colors.

    A network must not receive colors that are stretched to the range from 0 to 1, or normalized by
    the mean and std of each image.
    """
    if not case.description.predicts_maps:
        raise CheckSkipped("the check applies to providers of maps only")
    case.require_truth("painted")
    return _run_and_compare(case, case.example.crop(*_FLOOR))


def check_large_view(case: ContractCase) -> str:
    """Require accurate output for a view of 12.2 megapixels (masks) or 2.2 megapixels (others).

    Photos of users are usually larger than the input of a network. The large view repeats the
    pixels of a small view, so that the ground truth is known. A painted view in portrait format
    does not repeat pixels and has 1.0 megapixels for depth, 0.7 megapixels for others. Wrappers and
    providers that read files receive a view of 0.4 megapixels.
    """
    width, height = case.example.camera.size
    if case.kind in ("features", "matcher", "retrieval"):
        raise CheckSkipped(f"providers of the kind {case.kind} have a check of their own")
    if case.setup.prepare is not None or case.spec.kind == "wrapper":
        return _run_and_compare(case, case.example.sized(4 * width, 4 * height))
    # The portrait view first, because a failure of the larger view has the same cause.
    if case.truth_source == "painted":
        is_depth = case.kind in ("depth", "multiview")
        size = _LARGE_PORTRAIT_SIZE if is_depth else (5 * height, 5 * width)
        _run_and_compare(case, case.example.sized(*size))
    factor = 21 if case.kind == "mask" else 9
    small, auxiliary = case.example, case.make_auxiliary_input(case.example.view, case.example)
    image = small.view.image.repeat(factor, axis=0).repeat(factor, axis=1)
    camera = small.camera.resized(image.shape[1], image.shape[0])
    view = View("large.png", image, camera)
    answer = case.run_on_view(view, small, auxiliary=auxiliary)
    if not case.description.predicts_maps:
        return compare_with_truth(case, replace(small, camera=camera), answer)
    return compare_with_truth(case, small, _reduce_map(answer, small))


def check_one_pixel(case: ContractCase) -> None:
    """Require valid output for a view of one pixel."""
    case.run(case.example.sized(1, 1))


def check_thin_view(case: ContractCase) -> None:
    """Require valid output for a view of 5 x 120 pixels."""
    case.run(case.example.sized(5, 120))


def check_grayscale(case: ContractCase) -> None:
    """Require valid output for a grayscale image that is passed as three equal channels."""
    gray = np.asarray(case.small_example.view.image).mean(axis=-1, keepdims=True)
    shape = case.small_example.view.image.shape
    _run_on_image(case, np.broadcast_to(gray.astype(np.uint8), shape))


def check_sixteen_bit(case: ContractCase) -> None:
    """Require valid output for a 16-bit grayscale image.

    The core converts the image to 8 bit and three channels before it calls the provider.
    """
    import cv2  # The import is local, because pytest loads this module when it collects tests.

    from mpsfm_core.inputs.image_decoding import decode_rgb
    from mpsfm_core.inputs.image_header import ImageHeader

    wide = case.small_example.view.image[..., 0].astype(np.uint16) * 257
    data = cv2.imencode(".png", wide)[1].tobytes()
    _run_on_image(case, decode_rgb(data, ImageHeader(None, 1, {}), Path("gray16.png")))


def check_flat(case: ContractCase) -> None:
    """Require valid output for black and white views without texture."""
    for value in (0, 255):
        _run_on_image(case, np.full(case.small_example.view.image.shape, value, np.uint8))


def check_masked(case: ContractCase) -> None:
    """Require valid output for a view whose mask is partly or completely False.

    A depth, normal or mask map must keep at least half of its valid pixels where the mask is True,
    and a detector half of its keypoints. Matches must remain correct. Depth and normals must not
    move: a provider that crops the view to the mask has to return a map of the whole view.
    """
    whole = case.run(case.example)
    for num_visible_columns in (case.example.camera.width // 2, 0):
        mask = np.zeros(case.example.view.image.shape[:2], np.bool_)
        mask[:, :num_visible_columns] = True
        answer = case.run_on_view(replace(case.example.view, mask=mask), case.example)
        if isinstance(answer, PairMatches):
            require_correct_matches(case, answer)
        if isinstance(answer, Features):
            _require_visible_keypoints(answer, whole, num_visible_columns)
        if isinstance(answer, (DepthPrior, NormalPrior)) and case.truth_source != "none":
            _require_equal_columns(case.example, answer, whole, num_visible_columns)
        valid, valid_before = (getattr(output, "valid", output) for output in (answer, whole))
        if not isinstance(valid, np.ndarray) or valid.dtype != np.bool_:
            continue
        if valid.shape != valid_before.shape:
            continue
        columns = valid.shape[1] * num_visible_columns // case.example.camera.width
        kept, before = valid[:, :columns].sum(), valid_before[:, :columns].sum()
        if kept < before / 2:
            raise CheckFailed("most values are invalid at pixels where the mask is True")


def _require_equal_columns(example: Example, masked: Any, whole: Any, num_columns: int) -> None:
    """Require similar depth or normals in the first columns of a masked and of a whole view."""
    a, b = (_sample_map(prior, *example.camera.size) for prior in (masked, whole))
    where = a.valid & b.valid
    where[:, num_columns:] = False
    if not where.any():
        return
    if isinstance(whole, DepthPrior):
        ratios = np.log(a.depth[where].astype(np.float64) / b.depth[where])
        differences = np.abs(ratios if whole.metric else ratios - np.median(ratios))
        limit = DEPTH_TOLERANCE
    else:
        cosines = (a.normals[where].astype(np.float64) * b.normals[where]).sum(axis=1)
        differences = np.rad2deg(np.arccos(np.clip(cosines, -1, 1)))
        limit = NORMALS_TOLERANCE_DEG
    if error_quantile(differences) > limit:
        raise CheckFailed("a mask changes the output at pixels where the mask is True")


STANDALONE = (check_specification, check_construction, check_light_import)
"""Contract checks that do not call the provider under test."""

COMMON = (
    check_missing_file,
    check_deterministic,
    check_no_state,
    check_inputs_unchanged,
    check_name_does_not_matter,
    check_intrinsics_declared,
    check_threads,
    check_pickles,
    check_offline,
    *PROCESS_CHECKS,
    check_odd_size,
    check_portrait,
    check_panorama,
    check_few_colors,
    check_one_pixel,
    check_thin_view,
    check_large_view,
    check_grayscale,
    check_sixteen_bit,
    check_flat,
    check_masked,
)
"""Contract checks that call the provider under test, in the order to run them."""


def _require_visible_keypoints(
    features: Features, before: Features, num_visible_columns: int
) -> None:
    """Require half of the keypoints of the unmasked view in the columns where the mask is True."""
    kept, expected = ((f.keypoints[:, 0] < num_visible_columns).sum() for f in (features, before))
    if kept < expected / 2:
        raise CheckFailed(f"only {kept} of {expected} keypoints remain where the mask is True")


def _require_same(expected: object, answer: object, when: str) -> None:
    difference = describe_difference(expected, answer)
    if difference:
        raise CheckFailed(f"the output {when} differs: {difference}")


def _select_valid_in_both(first: NormalPrior, second: NormalPrior) -> tuple[object, object]:
    """Return the normals and variances of the pixels that are valid in both normal priors."""
    if first.shape != second.shape:
        return first, second
    where = first.valid & second.valid
    pairs = ((p.normals[where], p.variance) for p in (first, second))
    a, b = ((n, None if v is None else v[where]) for n, v in pairs)
    return a, b


def _require_no_stale_output(case: ContractCase) -> None:
    """Require another output for a mirrored view, and for a view with some equal pixels only.

    A provider may take both for the same view if it compares their sizes and a few pixels or the
    sum of all pixels. The output of retrieval and masks may be the same for the mirrored view.
    """
    if case.setup.prepare is not None or case.declares("uncached") or case.declares("needs-depth"):
        return
    example, other = case.example, case.example.partner
    before = case.run(example, case.provider)
    if not describe_difference(before, case.run(other)):
        return
    image = np.array(example.view.image)
    image[2:-2, 2:-2] = other.view.image[2:-2, 2:-2]
    image[::_STEP_OF_EQUAL_PIXELS, ::_STEP_OF_EQUAL_PIXELS] = example.view.image[
        ::_STEP_OF_EQUAL_PIXELS, ::_STEP_OF_EQUAL_PIXELS
    ]
    answer = case.run_on_view(replace(other.view, image=image), example, case.provider)
    if not describe_difference(before, answer):
        raise CheckFailed("the output is that of another view with some equal pixels")
    if case.kind == "features" or case.description.predicts_maps:
        mirrored = replace(other.view, image=np.ascontiguousarray(example.view.image[:, ::-1]))
        case.run(example, case.provider)
        answer = case.run_on_view(mirrored, example, case.provider)
        if not describe_difference(before, answer):
            raise CheckFailed("the output for the mirrored view is that of the view")


def _run_and_compare(case: ContractCase, example: Example) -> str:
    return compare_with_truth(case, example, case.run(example))


def _reduce_map(answer: Any, example: Example) -> Any:
    """Sample a depth, normal or mask map at the pixel centers of a smaller view."""
    if isinstance(answer, MultiViewPrior):
        answer = answer.depth[0]
    width, height = example.camera.size
    rows, columns = answer.shape
    return answer if rows <= height and columns <= width else _sample_map(answer, width, height)


def _sample_map(answer: Any, width: int, height: int) -> Any:
    """Sample a depth, normal or mask map at the pixel centers of another size."""
    rows, columns = answer.shape
    row = ((np.arange(height) + 0.5) * rows / height).astype(int)[:, None]
    column = ((np.arange(width) + 0.5) * columns / width).astype(int)
    if isinstance(answer, np.ndarray):
        return answer[row, column]
    maps = {
        part.name: np.ascontiguousarray(value[row, column])
        for part in fields(answer)
        if isinstance(value := getattr(answer, part.name), np.ndarray)
    }
    return replace(answer, **maps)


def _run_on_image(case: ContractCase, image: UInt8) -> None:
    example = case.small_example
    case.prepare(example)
    case.run_on_view(replace(example.view, image=np.ascontiguousarray(image)), example)


def _find_plugin_modules(case: ContractCase) -> list[str]:
    """Return the entry points of the installed distribution that contains the provider."""
    distribution = case.registry.version(case.spec.kind, case.name).partition(" ")[0]
    entries = metadata.entry_points(group=ENTRY_POINT_GROUP)
    return [e.value for e in entries if e.dist is not None and e.dist.name == distribution]
