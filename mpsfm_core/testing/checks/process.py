"""Contract checks of what a provider does to the process in which it runs.

A reconstruction calls many providers in one process, in several threads and in worker processes. A
provider must therefore neither change process state that other providers use nor depend on it.
"""

from __future__ import annotations

import gc
import pickle
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from mpsfm_core.testing.contract_case import ContractCase, describe_difference
from mpsfm_core.testing.examples import Example
from mpsfm_core.testing.leak_probe import read_usage
from mpsfm_core.testing.outcome import CheckFailed, CheckSkipped
from mpsfm_core.testing.process_state import read_process_settings
from mpsfm_core.testing.second_process import run_in_second_process

MAX_CONSTRUCTION_S = 20.0
"""Time limit in seconds to construct a provider. Networks with 1 GB of weights need 5 s on a CPU;
the limit allows for a busy machine. A plugin whose provider needs more time declares an expected
failure in ``expected_failures``."""
MAX_CALL_S = 20.0
"""Time limit in seconds for one call with a view of 192 x 144 pixels. The largest networks need 5 s
on a CPU."""
_NUM_MEMORY_CALLS = 28
_MEMORY_TIME_S = 0.1
"""CPU time in seconds after which one half of the check ``memory-released`` makes no further
calls."""
_MAX_RETAINED_BYTES = 20_000
"""Bytes of Python and numpy memory that a call of a provider may retain. The pixels of a view have
at least 83 kB, so a retained view is detected. Caches of the Python interpreter grow by less than 4
kB."""
_MAX_NATIVE_MB = 40.0
"""Growth of the resident memory in MB during all calls after which a native leak is reported. The
memory pools of onnxruntime and torch grow by less than 20 MB after the first three calls of an
instance."""


def check_second_process(case: ContractCase) -> str:
    """Require the same output in another process, with another seed of Python's hash function.

    Workers of an executor and repeated reconstructions are other processes. The check is skipped if
    another process cannot import the factory of the provider. Both processes use one BLAS thread,
    because the rounding of a matrix product depends on the number of threads.
    """
    example = case.small_example
    case.prepare(example, example.partner)
    auxiliary = case.make_auxiliary_input(example.view, example)
    with threadpool_limits(1, user_api="blas"):
        expected = case.run_on_view(example.view, example, case.provider, auxiliary)
    try:
        data = pickle.dumps((case.to_pickle(), example, auxiliary))
    except Exception as error:
        raise CheckSkipped(f"the provider cannot be sent to a process: {error}") from error
    answer, seconds = pickle.loads(run_in_second_process(data))
    if isinstance(answer, str):
        raise CheckSkipped(answer)
    difference = describe_difference(expected, answer)
    if difference:
        raise CheckFailed(f"the output in a second process differs: {difference}")
    return f"{seconds:.2f} s to import and construct"


def check_global_state(case: ContractCase) -> None:
    """Require that a provider does not change the global state of the process.

    Other providers in the process use the same global state. The global state includes the random
    numbers of Python, numpy and torch, environment variables, the working directory, threads,
    logging, warning filters and error handling of numpy.
    """
    case.run(case.example)  # imports the provider's libraries
    imported = case.process_before.changes(read_process_settings())
    for what, changed in {"the provider": imported, **case.observed.changes}.items():
        if changed:
            raise CheckFailed(f"{what} changes {changed}")


def check_standard_output(case: ContractCase) -> None:
    """Require that a provider prints nothing on standard output.

    Standard output is reserved for the output of commands, which may be JSON. Messages belong in
    Python's ``logging`` or on standard error.
    """
    if case.observed.printed:
        raise CheckFailed(
            f"the provider prints on standard output: {case.observed.printed[0][:80]!r}"
        )


def check_memory_released(case: ContractCase) -> str:
    """Require that memory, open files and threads do not grow with the number of views.

    The check ``memory-released`` makes up to 28 calls of the provider, fewer if a call takes long.
    The last call has to give the output of the first one.
    The measured memory is that of Python and numpy. Growth of the memory of the whole process is
    reported above 40 MB only.
    """
    case.prepare(case.example, case.example.partner)
    examples = [_rename_example(case.example, f"memory/{i}.png") for i in range(_NUM_MEMORY_CALLS)]
    case.prepare(*examples)
    auxiliary = case.make_auxiliary_input(case.example.view, case.example)
    provider = case.observed.provider

    def run(example: Example) -> Any:
        return case.run_on_view(example.view, case.example, provider, auxiliary)

    gc.freeze()  # Collecting the objects of all imported libraries takes long.
    tracemalloc.start()
    try:
        run(examples[0])
        half = len(examples) // 2
        usage, counts, sizes = [read_usage()], [], []
        for part in (examples[1:half], examples[half:]):
            count, size = _measure_retained(run, part)
            counts.append(count)
            sizes.append(size)
            usage.append(read_usage())
    finally:
        tracemalloc.stop()
        gc.unfreeze()
    # A library may allocate memory or start its threads once. A leak occurs in both halves.
    count, retained = sum(counts), min(sizes)
    if retained > _MAX_RETAINED_BYTES:
        raise CheckFailed(f"the provider retains {retained / 1000:.0f} kB per view")
    for name in ("files", "threads"):
        opened = np.diff([getattr(measured, name) for measured in usage])
        if np.all(opened >= counts):
            raise CheckFailed(f"{count} calls leave {opened.sum()} {name} open")
    growth = usage[-1].memory_mb - usage[0].memory_mb
    if growth > _MAX_NATIVE_MB:
        raise CheckFailed(f"{count} calls let the memory of the process grow by {growth:.0f} MB")
    if not case.declares("uncached"):
        difference = describe_difference(case.run(case.example), run(examples[0]))
        if difference:
            raise CheckFailed(f"the output after {count} calls differs: {difference}")
    return f"retains {max(retained, 0) / 1000:.1f} kB per view in {count} calls"


def check_speed(case: ContractCase) -> str:
    """Require that construction and calls take less than 20 s, and report their time.

    A reconstruction constructs one provider per thread and calls the provider for every image. If a
    provider needs more time, declare an expected failure with the reason.
    """
    construction_s, (first_s, last_s) = case.observed.construction_s, case.observed.call_s
    width, height = case.example.camera.size
    text = (
        f"{construction_s:.3f} s to construct, {first_s:.3f} s for the first call and "
        f"{last_s:.3f} s for a call with {width} x {height} pixels"
    )
    if construction_s > MAX_CONSTRUCTION_S:
        raise CheckFailed(f"{text}: construction takes more than {MAX_CONSTRUCTION_S:.0f} s")
    if max(first_s, last_s) > MAX_CALL_S:
        raise CheckFailed(f"{text}: a call takes more than {MAX_CALL_S:.0f} s")
    return text


PROCESS_CHECKS = (
    check_second_process,
    check_global_state,
    check_standard_output,
    check_memory_released,
    check_speed,
)
"""Contract checks of side effects, in the order to run them."""


def _measure_retained(run: Callable[[Example], Any], examples: list[Example]) -> tuple[int, float]:
    """Run a provider on several views; return the number of calls and retained bytes per call."""
    traced, started, count = tracemalloc.get_traced_memory()[0], time.process_time(), 0
    for example in examples:
        run(example)
        count += 1
        if time.process_time() - started > _MEMORY_TIME_S:
            break
    gc.collect()
    return count, (tracemalloc.get_traced_memory()[0] - traced) / count


def _rename_example(example: Example, name: str) -> Example:
    renamed = replace(example, name=name)
    # Keep the rendered images of the example, which do not depend on the example's name.
    renamed.__dict__.update(view=replace(example.view, name=name), partner=example.partner)
    return renamed
