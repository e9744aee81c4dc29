"""A reconstruction that is killed and resumed repeatedly, compared with an undisturbed one.

    python -m benchmarks.soak [--photos 300] [--kills 10] [--gap 30] [--seed 0] [--output DIR]

The photos are noisy copies of the frames of hololens_room. Both reconstructions use SIFT features,
pairs of neighboring frames, and depth and normals of `compact`. The interrupted and the undisturbed
reconstruction run at the same time. One reconstruction gets SIGKILL after a random CPU time,
uniform up to twice `--gap` seconds, and is restarted with the same command, `--kills` times. The
benchmark compares all result files, and CPU time including child processes. Writes
benchmarks/results/soak.md. Linux only.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import yaml

from benchmarks._scenes import MPSFM, RESULTS, shared_folder
from tests.support.result_files import content

SCENE = "hololens_room"
NOISE = 4.0
"""Std of the noise that is added to each photo, in gray values (0 to 255)."""
POLL_S = 0.05
CONFIG = """
features: {{use: sift, options: {{max_keypoints: 2048}}}}
matcher: {{use: mutual-nearest}}
depth: {{use: compact}}
normals: {{use: same-network}}
pairs: {{mode: sequential, overlap: 4, quadratic: true}}
extraction: {{integration_size: 160}}
runtime: {{workers: {workers}, cache_dir: {cache}}}
"""


@dataclass(frozen=True)
class Life:
    """Process of an interrupted reconstruction, with CPU seconds, return code and output lines."""

    seconds: float
    code: int
    said: list[str]

    @property
    def doing(self) -> str:
        """Return the last stage that the process completed before SIGKILL."""
        finished = [line.partition(":")[0] for line in self.said if line.endswith(" s")]
        return f"after {finished[-1]}" if finished else "at the start"


def main() -> None:
    """Run the interrupted and the undisturbed reconstruction, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--photos", type=int, default=300)
    parser.add_argument("--width", type=int, default=400, help="Of the photos, pixels.")
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--gap", type=float, default=30.0, help="Mean CPU seconds of a life.")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--output", type=Path, default=Path("build/benchmarks/soak"))
    arguments = parser.parse_args()
    folder = arguments.output.resolve()
    shutil.rmtree(folder, ignore_errors=True)
    make_photos(folder, arguments.photos, arguments.width, arguments.seed)
    subprocess.run([sys.executable, "-m", "mpsfm_core.pipeline.precompile"], check=True)
    rng = np.random.default_rng(arguments.seed)
    limits = (2 * arguments.gap * rng.random(arguments.kills)).tolist()
    with ThreadPoolExecutor(2) as pool:
        alone = pool.submit(run, folder, "alone", [], arguments.workers)
        disturbed = pool.submit(run, folder, "disturbed", limits, arguments.workers)
        lives, reference = disturbed.result(), alone.result()
    text = report(folder, reference[0], lives, arguments)
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "soak.md").write_text(text, encoding="utf-8")
    print(text)


def make_photos(folder: Path, count: int, width: int, seed: int) -> None:
    """Write photos (repeated frames with different noise) and their intrinsics."""
    scene = shared_folder() / "data" / SCENE
    frames = sorted((scene / "images").iterdir())
    rng = np.random.default_rng(seed)
    (folder / "images").mkdir(parents=True)
    for number in range(count):
        frame = cv2.imread(str(frames[number * len(frames) // count]))
        assert frame is not None
        factor = width / frame.shape[1]
        frame = cv2.resize(frame, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
        noisy = np.clip(frame + rng.normal(0, NOISE, frame.shape), 0, 255).astype(np.uint8)
        name = folder / "images" / f"{number:03d}.jpg"
        cv2.imwrite(str(name), noisy, [cv2.IMWRITE_JPEG_QUALITY, 95])
    known = next(iter(yaml.safe_load((scene / "intrinsics.yaml").read_text()).values()))
    params = [factor * value for value in known["params"]]
    (folder / "intrinsics.yaml").write_text(f"1: {{params: {params}, images: all}}\n")


def run(folder: Path, name: str, limits: list[float], workers: int) -> list[Life]:
    """Restart the command until it completes; all processes but the last have a CPU time limit."""
    cache, output = folder / name / "cache", folder / name / "out"
    cache.mkdir(parents=True)
    config = folder / name / "config.yaml"
    config.write_text(CONFIG.format(workers=workers, cache=cache))
    command = [*MPSFM, "reconstruct", str(folder / "images"), "--output", str(output)]
    command += ["--config", str(config)]
    command += ["--intrinsics", str(folder / "intrinsics.yaml")]
    lives: list[Life] = []
    for number in range(len(limits) + 1):
        limit = limits[number] if number < len(limits) else np.inf
        lives.append(live(command, folder / name / f"{number}.log", limit))
        print(f"{name}: {lives[-1].seconds:.1f} s, {lives[-1].doing}", file=sys.stderr)
        if lives[-1].code != -signal.SIGKILL:
            break
    if lives[-1].code:
        raise SystemExit("\n".join(lives[-1].said))
    return lives


def live(command: list[str], log: Path, limit: float) -> Life:
    """Run the command in a process, and kill the process after ``limit`` CPU seconds."""
    with log.open("w") as file:
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=file)
        while cpu_seconds(process.pid) < limit:
            ended, status, usage = os.wait4(process.pid, os.WNOHANG)
            if ended:
                break
            time.sleep(POLL_S)
        else:
            process.kill()
            _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    return Life(usage.ru_utime + usage.ru_stime, process.returncode, log.read_text().splitlines())


def cpu_seconds(pid: int) -> float:
    """Return user plus system time in seconds of a process and its finished child processes."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")


def report(folder: Path, alone: Life, lives: list[Life], arguments: argparse.Namespace) -> str:
    """Format the table of processes, and the differences between the result files."""
    expected, actual = (content(folder / name / "out") for name in ("alone", "disturbed"))
    names = expected.keys() | actual.keys()
    different = sorted(name for name in names if expected.get(name) != actual.get(name))
    leftovers = [
        p.name for p in (folder / "disturbed" / "cache" / "mapping").rglob("*") if p.is_file()
    ]
    leftovers += [p.name for p in (folder / "disturbed" / "out").glob(".mpsfm-*")]
    total = sum(life.seconds for life in lives)
    verdict = "all identical" if not different else f"different: {', '.join(different[:10])}"
    processes = ", ".join(
        f"{life.seconds:.0f} ({life.doing if life.code else 'finished'})" for life in lives
    )
    lines = [
        "# Killed and resumed",
        "",
        f"`python -m benchmarks.soak --photos {arguments.photos} --width {arguments.width} "
        f"--kills {arguments.kills} --gap {arguments.gap:g} --seed {arguments.seed} "
        f"--workers {arguments.workers}`: {arguments.photos} photos, killed "
        f"{len(lives) - 1} times. CPU seconds include child processes.",
        "",
        f"* The undisturbed reconstruction takes {alone.seconds:.0f} s, and the killed and resumed "
        f"one {total:.0f} s, **{total / alone.seconds:.2f} times** as much.",
        f"* The result has {len(expected)} files, {verdict}. Leftover files: "
        f"{', '.join(leftovers) or 'none'}.",
        f"* CPU seconds of the processes, with what each did when it was killed: {processes}.",
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
