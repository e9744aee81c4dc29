"""Checks of every provider, whatever its kind.

A check is a function of a :class:`~mpsfm_core.testing.contract_case.ContractCase`. It returns nothing or a remark,
and raises ``CheckFailed`` or ``CheckSkipped`` with the reason. Its id is its name without
``check_``, with dashes.
"""

from __future__ import annotations

import gc
import pickle
import socket
import subprocess
import sys
import threading
import time
import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from mpsfm_core.data import NormalPrior, UInt8, View
from mpsfm_core.providers import ENTRY_POINT_GROUP
from mpsfm_core.providers.discovery import find_spec_fault
from mpsfm_core.testing.accuracy import compare_with_truth
from mpsfm_core.testing.contract_case import ContractCase, describe_difference
from mpsfm_core.testing.examples import Example
from mpsfm_core.testing.outcome import CheckFailed, CheckSkipped

HEAVY = ("torch", "onnxruntime", "tensorflow", "jax", "kornia", "cv2", "scipy", "pycolmap")
"""What listing plugins must not import: together seconds on every start."""

_CALLS = 4
_KEPT_BYTES = 20_000
"""A call, of what Python and numpy allocate. Ours: a view of the check has 83 kB or more, while
caches of the interpreter grow by less than 4 kB."""


def check_specification(case: ContractCase) -> str:
    """The registry accepts the specification, and the options of the setup are valid."""
    fault, hint = find_spec_fault(case.spec)
    if fault:
        raise CheckFailed(f"the specification {fault}; {hint}")
    if (
        case.spec.kind == "wrapper"
        and not {"wraps-depth", "wraps-normals"} & case.spec.capabilities
    ):
        raise CheckFailed("a wrapper has to declare 'wraps-depth' or 'wraps-normals'")
    case.registry.validate_options(case.spec.kind, case.spec.name, case.setup.options)
    if case.spec.code_license == "unknown":
        return "code_license is not given: users will ask"
    return ""


def check_construction(case: ContractCase) -> None:
    """The provider can be constructed with the options of its setup."""
    assert case.provider is not None


def check_light_import(case: ContractCase) -> None:
    """Importing the plugin's module, as every listing does, imports no heavy library."""
    modules = _plugin_modules(case)
    if not modules:
        raise CheckSkipped("registered in this process, not by an entry point")
    script = (
        "import importlib, sys\n"
        f"import mpsfm_core.providers.registry\nbefore = set(sys.modules)\n"
        f"[importlib.import_module(name).mpsfm_providers() for name in {modules!r}]\n"
        f"print(*sorted(set({HEAVY!r}) & (set(sys.modules) - before)))"
    )
    paths = f"import sys; sys.path[:] = {sys.path!r}\n"
    run = subprocess.run([sys.executable, "-c", paths + script], capture_output=True, text=True)
    if run.returncode:
        raise CheckFailed(f"importing it fails: {run.stderr.strip().splitlines()[-1]}")
    if run.stdout.strip():
        raise CheckFailed(f"importing {modules[0]!r} imports {run.stdout.strip()}")


def check_output_rules(case: ContractCase) -> None:
    """The answer passes the validator: type, dtype, shape, finite, positive, unit, inside of the
    view, and all that the capabilities promise. Without this no other check asks anything."""
    case.run(case.example)


def check_deterministic(case: ContractCase) -> None:
    """The same view gives the same answer, bit by bit, from one instance and from another: results
    are cached, and a run with a seed can be repeated."""
    first = case.run(case.example)
    _same(first, case.run(case.example), "asked twice")
    _same(first, case.run(case.example, case.create_provider()), "asked a second instance")


def check_no_state(case: ContractCase) -> None:
    """An answer does not depend on the views seen before: a batch, in any order, gives what single
    views give (the interface has no batches; this is what they would have to obey)."""
    others = [case.example.sized(104, 120), case.example.partner]
    alone = case.run(case.example, case.create_provider())
    for other in others:
        case.run(other)
    _same(alone, case.run(case.example), "asked after other views")


def check_inputs_unchanged(case: ContractCase) -> None:
    """The view, and depth or features that come with it, are the same afterwards: other providers
    see them too."""
    example = case.example.sized(*case.example.camera.size)
    image = np.array(example.view.image)
    view = View(example.name, image, example.camera, np.ones(image.shape[:2], np.bool_))
    case.prepare(example)
    extra = case.make_auxiliary_input(view, example)
    before = pickle.loads(pickle.dumps((image, view.mask, extra)))
    case.run_on_view(view, example, extra=extra)
    for what, old, new in zip(
        ("image", "mask", "depth or features"), before, (image, view.mask, extra), strict=True
    ):
        changed = describe_difference(old, new)
        if changed:
            raise CheckFailed(f"changes the {what} it is given: {changed}")


def check_name_does_not_matter(case: ContractCase) -> None:
    """The answer does not depend on the view's name, as the cache goes by pixels; providers that
    read files declare the capability ``uncached``."""
    if case.declares("uncached"):
        raise CheckSkipped("declares 'uncached'")
    if case.setup.prepare is not None:
        raise CheckSkipped("is told about views by their names")
    expected = case.run(case.example)
    renamed = replace(case.example.view, name="another/name.jpg")
    _same(expected, case.run_on_view(renamed, case.example), "asked about a renamed view")


def check_intrinsics_declared(case: ContractCase) -> None:
    """The answer changes with the focal length only if the provider declares
    ``intrinsics-aware``: otherwise the cache would return what was made for another camera."""
    if case.declares("intrinsics-aware"):
        raise CheckSkipped("declares 'intrinsics-aware'")
    if case.declares("uncached"):
        raise CheckSkipped("declares 'uncached'")
    expected = case.run(case.example)
    camera = replace(
        case.example.camera, fx=1.3 * case.example.camera.fx, fy=1.3 * case.example.camera.fy
    )
    found = case.run_on_view(replace(case.example.view, camera=camera), case.example)
    if isinstance(expected, NormalPrior):  # which normals face the camera depends on it, no more
        expected, found = _valid_in_both(expected, found)
    changed = describe_difference(expected, found)
    if changed:
        raise CheckFailed(f"depends on the focal length and does not declare it: {changed}")


def check_threads(case: ContractCase) -> None:
    """Two instances in two threads at once answer as they do alone: a run has one in each."""
    examples = [case.example, case.example.sized(*case.example.camera.size).partner]
    alone = [case.run(example) for example in examples]
    instances = [case.create_provider() for _ in examples]
    start = threading.Barrier(len(examples))
    together: list[Any] = [None] * len(examples)

    def work(index: int) -> None:
        start.wait()
        for _ in range(2):
            try:
                together[index] = case.run(examples[index], instances[index])
            except Exception as error:
                together[index] = error
            if isinstance(together[index], Exception) or describe_difference(
                alone[index], together[index]
            ):
                return

    threads = [threading.Thread(target=work, args=(index,)) for index in range(len(examples))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for expected, found in zip(alone, together, strict=True):
        if isinstance(found, Exception):
            raise CheckFailed(f"in two threads at once: {found}") from found
        _same(expected, found, "asked in two threads at once")


def check_pickles(case: ContractCase) -> None:
    """Factory, options and answers survive pickling, so that process pools can work with them."""
    options = case.registry.validate_options(case.spec.kind, case.spec.name, case.setup.options)
    answer = case.run(case.example)
    for what, value in (("factory", case.spec.factory), ("options", options), ("answer", answer)):
        try:
            copy = pickle.loads(pickle.dumps(value))
        except Exception as error:
            reason = f"{type(error).__name__}: {error}"
            raise CheckFailed(f"its {what} cannot be pickled: {reason}") from error
    _same(answer, copy, "pickled")


def check_offline(case: ContractCase) -> None:
    """Constructing the provider and asking it opens no socket once its weights are here. Sees what
    goes through Python's sockets; a library that makes its own is not seen."""
    case.provider  # noqa: B018 - fetches the weights, where they are not here yet
    with _no_sockets() as attempts:
        try:
            case.run(case.example, case.create_provider())
        except Exception as error:
            if not attempts:
                raise
            raise CheckFailed(f"fails without network: {error}") from error
    if attempts:
        raise CheckFailed(f"goes to the network: {attempts[0]}")


def check_memory_released(case: ContractCase) -> str:
    """Views and answers are not kept: what Python and numpy allocate does not grow with the number
    of views (the memory of native libraries is not seen)."""
    examples = [_renamed(case.example, f"memory/{number}.png") for number in range(_CALLS + 2)]
    for example in examples:
        case.prepare(example)
    questions = [(e.view, case.make_auxiliary_input(e.view, case.example)) for e in examples]
    provider = case.create_provider()
    tracemalloc.start()
    try:
        for view, extra in questions[:2]:
            case.run_on_view(view, case.example, provider, extra)
        gc.collect()
        before = tracemalloc.get_traced_memory()[0]
        for view, extra in questions[2:]:
            case.run_on_view(view, case.example, provider, extra)
        gc.collect()
        kept = (tracemalloc.get_traced_memory()[0] - before) / _CALLS
    finally:
        tracemalloc.stop()
    if kept > _KEPT_BYTES:
        raise CheckFailed(f"keeps {kept / 1000:.0f} kB of each view")
    return f"keeps {max(kept, 0) / 1000:.1f} kB a view"


def check_speed(case: ContractCase) -> str:
    """How long it takes; never fails."""
    started = time.perf_counter()
    provider = case.create_provider()
    constructed = time.perf_counter()
    case.run(case.example, provider)
    first = time.perf_counter()
    case.run(case.example, provider)
    again = time.perf_counter() - first
    width, height = case.example.camera.size
    times = (constructed - started, first - constructed, again)
    return "{:.3f} s to construct, {:.3f} s for the first and {:.3f} s for the next {} x {}".format(
        *times, width, height
    )


def check_odd_size(case: ContractCase) -> str:
    """A view whose sides no network likes, 149 x 107, is answered, and as well as any other."""
    return _judged(case, case.example.sized(149, 107))


def check_portrait(case: ContractCase) -> str:
    """A view that is higher than wide is answered, and as well as any other."""
    width, height = case.example.camera.size
    return _judged(case, case.example.sized(height, width))


def check_one_pixel(case: ContractCase) -> None:
    """A view of one pixel gives an answer, not a crash."""
    case.run(case.example.sized(1, 1))


def check_thin_view(case: ContractCase) -> None:
    """A view of 5 x 120 pixels gives an answer, not a crash."""
    case.run(case.example.sized(5, 120))


def check_grayscale(case: ContractCase) -> None:
    """A gray photo gives an answer; it comes as three equal channels."""
    gray = np.asarray(case.example.view.image).mean(axis=-1, keepdims=True)
    _ask_about_image(case, np.broadcast_to(gray.astype(np.uint8), case.example.view.image.shape))


def check_sixteen_bit(case: ContractCase) -> None:
    """A gray photo of 16 bit gives an answer; the core makes 8 bit and three channels of it."""
    import cv2  # not at the top: pytest loads this module when it collects

    from mpsfm_core.inputs.image_decoding import decode_rgb
    from mpsfm_core.inputs.image_header import ImageHeader

    wide = case.example.view.image[..., 0].astype(np.uint16) * 257
    data = cv2.imencode(".png", wide)[1].tobytes()
    _ask_about_image(case, decode_rgb(data, ImageHeader(None, 1, {}), Path("gray16.png")))


def check_flat(case: ContractCase) -> None:
    """Black, white and gray views without any content give an answer."""
    for value in (0, 128, 255):
        _ask_about_image(case, np.full(case.example.view.image.shape, value, np.uint8))


def check_masked(case: ContractCase) -> None:
    """A view with a mask, partly or wholly False, gives an answer."""
    for visible in (case.example.camera.width // 2, 0):
        mask = np.zeros(case.example.view.image.shape[:2], np.bool_)
        mask[:, :visible] = True
        case.prepare(case.example)
        case.run_on_view(replace(case.example.view, mask=mask), case.example)


STANDALONE = (check_specification, check_construction, check_light_import)
"""Checks that ask the provider nothing."""

COMMON = (
    check_deterministic,
    check_no_state,
    check_inputs_unchanged,
    check_name_does_not_matter,
    check_intrinsics_declared,
    check_threads,
    check_pickles,
    check_offline,
    check_memory_released,
    check_speed,
    check_odd_size,
    check_portrait,
    check_one_pixel,
    check_thin_view,
    check_grayscale,
    check_sixteen_bit,
    check_flat,
    check_masked,
)


def _same(expected: object, found: object, when: str) -> None:
    changed = describe_difference(expected, found)
    if changed:
        raise CheckFailed(f"{when}, the answer is another: {changed}")


def _valid_in_both(first: NormalPrior, second: NormalPrior) -> tuple[object, object]:
    """The normals and variances where both are valid."""
    if first.shape != second.shape:
        return first, second
    where = first.valid & second.valid
    pairs = ((p.normals[where], p.variance) for p in (first, second))
    a, b = ((n, None if v is None else v[where]) for n, v in pairs)
    return a, b


def _judged(case: ContractCase, example: Example) -> str:
    return compare_with_truth(case, example, case.run(example))


def _ask_about_image(case: ContractCase, image: UInt8) -> None:
    case.prepare(case.example)
    case.run_on_view(replace(case.example.view, image=np.ascontiguousarray(image)), case.example)


def _renamed(example: Example, name: str) -> Example:
    renamed = replace(example, name=name)
    # The renderings are the same: made once.
    renamed.__dict__.update(view=replace(example.view, name=name), partner=example.partner)
    return renamed


def _plugin_modules(case: ContractCase) -> list[str]:
    """The modules of the entry points of the provider's distribution."""
    distribution = case.registry.version(case.spec.kind, case.spec.name).partition(" ")[0]
    entries = metadata.entry_points(group=ENTRY_POINT_GROUP)
    return [e.module for e in entries if e.dist is not None and e.dist.name == distribution]


@contextmanager
def _no_sockets() -> Iterator[list[str]]:
    """Refuses connections and name look-ups, and lists what was tried."""
    attempts: list[str] = []

    def refuse(*arguments: Any, **_: Any) -> Any:
        attempts.append(str(next((a for a in arguments if not isinstance(a, socket.socket)), "")))
        raise OSError("the network is switched off by the contract kit")

    replaced: list[tuple[Any, str]] = [(socket.socket, "connect"), (socket.socket, "connect_ex")]
    replaced += [(socket.socket, "sendto"), (socket, "getaddrinfo"), (socket, "create_connection")]
    originals = [(owner, name, getattr(owner, name)) for owner, name in replaced]
    for owner, name, _ in originals:
        setattr(owner, name, refuse)
    try:
        yield attempts
    finally:
        for owner, name, original in originals:
            setattr(owner, name, original)
