"""Time of a new user's first run: from a video to a report and to splatting input.

    python -m benchmarks.first_run [--gsplat FOLDER]

Encodes hololens_room (123 photos of a head-mounted camera, with motion blur) as an H.264 video of
twelve seconds (needs ``pip install av``). Runs the commands of docs/first-run.md, and opens the
report in headless Chromium. If FOLDER is the ``examples`` folder of gsplat's repository, gsplat's
loader reads the exported folder (needs ``pip install imageio piexif tqdm``). Prints a table.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from benchmarks._browser import capture_png, start_browser
from benchmarks._scenes import MPSFM, shared_folder

FPS = 10
VIDEO = "room.mp4"
SPLATS = "out/exports/gsplat"
_LOADER = """
import sys
import torch
sys.path.insert(0, sys.argv[1])
from datasets.colmap import Dataset, Parser
parser = Parser(data_dir=sys.argv[2], normalize=True)
for split in ("train", "val"):
    for item in Dataset(parser, split=split, load_depths=True):
        assert item["image"].shape[-1] == 3 and torch.isfinite(item["camtoworld"]).all()
        assert len(item["points"]) > 0 and (item["depths"] > 0).all()
print(len(parser.image_names), "images and", len(parser.points), "points")
"""


def film(photos: Sequence[Path], video: Path) -> None:
    """Encode photos as an H.264 video."""
    try:
        import av
    except ImportError as error:
        raise SystemExit("pip install av") from error
    import cv2

    with av.open(str(video), "w") as container:
        stream = container.add_stream("libx264", rate=FPS)
        pictures = [cv2.imread(str(photo)) for photo in photos]
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="bgr24")))
        container.mux(stream.encode())


def timed(command: Sequence[str], folder: Path) -> tuple[float, float, str]:
    """Run a command; return CPU seconds, wall seconds and the command's output."""
    before, started = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    ended = subprocess.run(command, cwd=folder, stdout=subprocess.PIPE, text=True, check=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if ended.returncode:
        raise SystemExit(f"{' '.join(command)} failed with exit code {ended.returncode}")
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return used, time.perf_counter() - started, ended.stdout


def look(page: Path) -> tuple[float, str]:
    """Open a report; return the seconds until its 3D scene is drawn, and its first sentence."""
    with start_browser() as browser:
        started = time.perf_counter()
        browser.get(page.resolve().as_uri())
        while not browser.execute_script("return window.report !== undefined"):
            if time.perf_counter() - started > 300:
                raise SystemExit(f"{page}: the 3D scene did not appear within 300 s")
            time.sleep(0.1)
        clock = time.perf_counter() - started
        faults = [line for line in browser.get_log("browser") if line["level"] == "SEVERE"]
        if faults:
            raise SystemExit(f"{page}: {faults[0]['message']}")
        page.with_name("report.png").write_bytes(capture_png(browser))
        verdict = browser.execute_script("return document.getElementById('verdict').innerText")
        return clock, str(verdict)


def main() -> None:
    """Parse the command line, run the commands of docs/first-run.md, and print their times."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, default=Path("first-run"))
    parser.add_argument("--frames", type=int, default=30, help="as many are taken from the video")
    parser.add_argument("--gsplat", type=Path, help="examples/ of gsplat's repository")
    options = parser.parse_args()
    folder = options.output.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    film(sorted((shared_folder() / "data" / "hololens_room" / "images").iterdir()), folder / VIDEO)
    os.environ.setdefault("MPSFM_CACHE", str(folder / "cache"))
    max_frames = ["--set", f"inputs.video.max_frames={options.frames}"]
    rows: list[tuple[str, float | None, float, str]] = []
    for arguments in (
        ["reconstruct", VIDEO, "-o", "out", *max_frames],
        ["export", "out", "--to", "gsplat"],
    ):
        used, clock, output = timed([*MPSFM, *arguments], folder)
        rows.append((f"`mpsfm {' '.join(arguments)}`", used, clock, output.splitlines()[0]))
    clock, output = look(folder / "out" / "report.html")
    rows.append(("`out/report.html` in Chromium", None, clock, output))
    if options.gsplat is not None:
        loader = [sys.executable, "-c", _LOADER, str(options.gsplat.resolve()), SPLATS]
        used, clock, output = timed(loader, folder)
        rows.append(("gsplat's own loader", used, clock, output.splitlines()[-1]))
    print("| step | processor s | clock s | it says |\n| --- | ---: | ---: | --- |")
    for step, used, clock, output in rows:
        numbers = ["" if value is None else f"{value:.0f}" for value in (used, clock)]
        print(f"| {step} | {numbers[0]} | {numbers[1]} | {output} |")


if __name__ == "__main__":
    main()
