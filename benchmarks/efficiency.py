"""CPU time and memory of the steps of mapping, compared with the table of the paper.

    python -m benchmarks.efficiency [--views 25 49 100 250 505]

The scenes are the synthetic halls of :mod:`benchmarks.everyday`, with calibrated depth priors and
prior maps as large as those of photos. The time of a mapping step includes all functions that the
step calls. The paper's times of global and local steps are summed. The paper's times are of ETH3D
on the authors' machine, so compare the growth with the number of images. All scenes run in one
process, from few to many images, so the largest scene so far determines the peak memory.
"""

from __future__ import annotations

import argparse
import cProfile
import time
from collections.abc import Mapping
from pathlib import PurePath
from types import MappingProxyType
from typing import NamedTuple

from threadpoolctl import threadpool_limits

from mpsfm_core.mapping import mapper
from mpsfm_core.pipeline.stages import peak_memory_mb
from mpsfm_core.testing.synthetic.halls import CALIBRATED_PRIORS, make_hall_problem

MAP_WIDTH = 387
"""Width of the prior maps in pixels (``extraction.integration_size``)."""
WHOLE = "mapping"


class Step(NamedTuple):
    """Step of the mapper: its functions (file, name), and the paper's seconds by image number."""

    functions: frozenset[tuple[str, str]]
    paper: Mapping[int, float]


def _step(*functions: tuple[str, str], paper: tuple[float, ...] = ()) -> Step:
    sizes = (25, 44, 110, 505) if paper else ()
    return Step(frozenset(functions), dict(zip(sizes, paper, strict=True)))


STEPS: Mapping[str, Step] = MappingProxyType(
    {
        "global initialization": _step(("global_initialization.py", "estimate_global_poses")),
        "bundle adjustment": _step(
            ("bundle_adjustment.py", "adjust_bundle"), paper=(3.43, 21.34, 48.59, 636.6)
        ),
        "depth refinement, with covariances": _step(
            ("refinement.py", "integrate"), paper=(9.19, 34.1, 81.33, 472.54)
        ),
        "of which point covariances": _step(
            ("refinement.py", "_measure_points"), paper=(2.26, 11.06, 19.94, 153.8)
        ),
        "depth check": _step(
            ("maintenance.py", "_find_conflicts"),
            ("maintenance.py", "check_depth"),
            paper=(0.44, 0.73, 2.01, 13.9),
        ),
        "tracks": _step(
            ("triangulation.py", "triangulate_image"),
            ("triangulation.py", "complete_and_merge_tracks"),
            ("triangulation.py", "lift_low_parallax"),
            ("filtering.py", "filter_points"),
        ),
        WHOLE: _step(("mapper.py", "reconstruct")),
    }
)


def main() -> None:
    """Parse the command line, map synthetic halls, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--views", type=int, nargs="+", default=[25, 49, 100, 250, 505])
    sizes = sorted(parser.parse_args().views)
    _measured(9)  # loads compiled code
    columns = {views: _measured(views) for views in sizes}
    print(f"| CPU seconds | {' | '.join(map(str, sizes))} | paper: 25 | 44 | 110 | 505 |")
    print("|---" * (len(sizes) + 5) + "|")
    for name, step in STEPS.items():
        ours = [f"{columns[views][name]:.2f}" for views in sizes]
        theirs = [f"{step.paper[n]:g}" if step.paper else "" for n in (25, 44, 110, 505)]
        print(f"| {' | '.join([name, *ours, *theirs])} |")
    peaks = [f"{columns[views]['peak']:.0f}" for views in sizes]
    print(f"| {' | '.join(['peak memory, MiB', *peaks])} | | | | |")


def _measured(views: int) -> dict[str, float]:
    """Measure CPU seconds of each mapping step over all threads, and peak memory in MiB."""
    problem = make_hall_problem(views, CALIBRATED_PRIORS, map_width=MAP_WIDTH).problem
    profile = cProfile.Profile(time.process_time)
    with threadpool_limits(1):
        profile.enable()
        mapper.reconstruct(problem)
        profile.disable()
    profile.create_stats()
    seconds_by_step = dict.fromkeys(STEPS, 0.0)
    for (file, _, function), (*_, seconds, _) in profile.stats.items():
        for name, step in STEPS.items():
            if (PurePath(file).name, function) in step.functions:
                seconds_by_step[name] += seconds
    return {**seconds_by_step, "peak": peak_memory_mb()}


if __name__ == "__main__":
    main()
