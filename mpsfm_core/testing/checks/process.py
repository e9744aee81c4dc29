"""Contract checks of what a provider does to the process in which it runs.

A reconstruction calls many providers in one process, in several threads and in worker processes. A
provider must therefore neither change process state that other providers use nor depend on it.
"""

from __future__ import annotations

import gc
import os
import pickle
import sys
import tempfile
import time
import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from mpsfm_core.testing.contract_case import ContractCase, describe_difference
from mpsfm_core.testing.examples import Example
from mpsfm_core.testing.leak_probe import measure_usage
from mpsfm_core.testing.outcome import CheckFailed, CheckSkipped
from mpsfm_core.testing.process_state import (
    known_process_state,
    read_process_settings,
    read_process_state,
)
from mpsfm_core.testing.second_process import run_in_second_process

MAX_CONSTRUCTION_S = 20.0
"""Time limit in seconds to construct a provider. Networks with 1 GB of weights need 5 s on a CPU;
the limit allows for a busy machine. A plugin whose provider needs more time declares an expected
failure in ``expected_failures``."""
MAX_CALL_S = 20.0
"""Time limit in seconds for one call with a view of 192 x 144 pixels. The largest networks need 5 s
on a CPU."""
_NUM_WARM_CALLS = 3
_NUM_MEMORY_CALLS = 27
_MEMORY_TIME_S = 1.5
"""Time in seconds after which the check ``memory-released`` makes no further calls, after at least
4 calls."""
_MAX_RETAINED_BYTES = 20_000
"""Bytes of Python and numpy memory that a call of a provider may retain. The pixels of a view have
at least 83 kB, so a retained view is detected. Caches of the Python interpreter grow by less than 4
kB."""
_MAX_NATIVE_MB = 40.0
"""Growth of the resident memory in MB during all calls after which a native leak is reported. The
memory pools of onnxruntime and torch grow by less than 20 MB after the first three calls."""


def check_second_process(case: ContractCase) -> str:
    """Require the same output in another process, with another seed of Python's hash function.

    Workers of an executor and repeated reconstructions are other processes. The check is skipped if
    another process cannot import the factory of the provider.
    """
    example = case.example
    expected = case.run(example)
    case.prepare(example, example.partner)
    auxiliary = case.make_auxiliary_input(example.view, example)
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

    The global state includes the random numbers of Python, numpy and torch, environment variables,
    the working directory, threads, warning filters and error handling of numpy. Other providers in
    the process depend on the global state.
    """
    case.prepare(case.example, case.example.partner)
    auxiliary = case.make_auxiliary_input(case.example.view, case.example)
    case.provider  # noqa: B018 - imports the provider's libraries, which may change the state
    case.run_on_view(case.example.view, case.example, auxiliary=auxiliary)
    _require_unchanged(case.process_before.changes(read_process_settings()), "the provider")
    with known_process_state(case.process_before):
        before = read_process_state()
        provider = case.create_provider()
        changes = before.changes(read_process_state(), without_torch_numbers=True)
        _require_unchanged(changes, "constructing the provider")
        before = read_process_state()
        case.run_on_view(case.example.view, case.example, provider, auxiliary)
        _require_unchanged(before.changes(read_process_state()), "a call of the provider")


def check_standard_output(case: ContractCase) -> None:
    """Require that a provider prints nothing on standard output.

    Standard output is reserved for the output of commands, which may be JSON. Messages belong in
    Python's ``logging`` or on standard error.
    """
    case.prepare(case.example, case.example.partner)
    case.make_auxiliary_input(case.example.view, case.example)
    with _capture_output() as lines:
        case.run(case.example, case.create_provider())
    if lines:
        raise CheckFailed(f"the provider prints on standard output: {lines[0][:80]!r}")


def check_memory_released(case: ContractCase) -> str:
    """Require that memory, open files and threads do not grow with the number of views.

    The check ``memory-released`` makes 30 calls of the provider, or fewer if a call takes long. The
    measured memory is that of Python and numpy. Growth of the memory of the whole process is
    reported above 40 MB only.
    """
    num_views = _NUM_WARM_CALLS + _NUM_MEMORY_CALLS
    examples = [_rename_example(case.example, f"memory/{i}.png") for i in range(num_views)]
    case.prepare(case.example, case.example.partner)
    for example in examples:
        case.prepare(example)
    auxiliary = case.make_auxiliary_input(case.example.view, case.example)
    inputs = [(e.view, auxiliary) for e in examples]
    provider = case.create_provider()

    def run(view: Any, given: Any) -> None:
        case.run_on_view(view, case.example, provider, given)

    tracemalloc.start()
    try:
        for view, given in inputs[:_NUM_WARM_CALLS]:
            run(view, given)
        before = next(measure_usage(lambda: None, 1))
        traced = tracemalloc.get_traced_memory()[0]
        started, count = time.perf_counter(), 0
        for view, given in inputs[_NUM_WARM_CALLS:]:
            run(view, given)
            count += 1
            if count >= 4 and time.perf_counter() - started > _MEMORY_TIME_S:
                break
        gc.collect()
        retained = (tracemalloc.get_traced_memory()[0] - traced) / count
        after = next(measure_usage(lambda: None, 1))
    finally:
        tracemalloc.stop()
    if retained > _MAX_RETAINED_BYTES:
        raise CheckFailed(f"the provider retains {retained / 1000:.0f} kB per view")
    for name in ("files", "threads"):
        growth = getattr(after, name) - getattr(before, name)
        if growth >= count:
            raise CheckFailed(f"{count} calls leave {growth} {name} open")
    if after.memory_mb - before.memory_mb > _MAX_NATIVE_MB:
        growth = after.memory_mb - before.memory_mb
        raise CheckFailed(f"{count} calls let the memory of the process grow by {growth:.0f} MB")
    return f"retains {max(retained, 0) / 1000:.1f} kB per view in {count} calls"


def check_speed(case: ContractCase) -> str:
    """Require that construction and calls take less than 20 s, and report their time.

    A reconstruction constructs one provider per thread and calls the provider for every image. If a
    provider needs more time, declare an expected failure with the reason.
    """
    started = time.perf_counter()
    provider = case.create_provider()
    constructed = time.perf_counter()
    case.run(case.example, provider)
    first = time.perf_counter()
    case.run(case.example, provider)
    second = time.perf_counter() - first
    width, height = case.example.camera.size
    times = (constructed - started, first - constructed, second)
    text = "{:.3f} s to construct, {:.3f} s for the first and {:.3f} s for the next {} x {}".format(
        *times, width, height
    )
    if times[0] > MAX_CONSTRUCTION_S:
        raise CheckFailed(f"{text}: construction takes more than {MAX_CONSTRUCTION_S:.0f} s")
    if max(times[1:]) > MAX_CALL_S:
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


def _rename_example(example: Example, name: str) -> Example:
    renamed = replace(example, name=name)
    # Keep the rendered images of the example, which do not depend on the example's name.
    renamed.__dict__.update(view=replace(example.view, name=name), partner=example.partner)
    return renamed


def _require_unchanged(changes: str, what: str) -> None:
    if changes:
        raise CheckFailed(f"{what} changes {changes}")


@contextmanager
def _capture_output() -> Iterator[list[str]]:
    """Collect the lines that Python or native code writes to standard output."""
    lines: list[str] = []
    sys.stdout.flush()
    saved = os.dup(1)
    with tempfile.TemporaryFile() as file:
        os.dup2(file.fileno(), 1)
        stdout = sys.stdout
        sys.stdout = open(1, "w", closefd=False)  # noqa: SIM115 - descriptor 1 must stay open
        try:
            yield lines
        finally:
            sys.stdout.flush()
            sys.stdout = stdout
            os.dup2(saved, 1)
            os.close(saved)
            file.seek(0)
            lines += file.read().decode(errors="replace").splitlines()
