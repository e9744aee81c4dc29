"""Create all pictures of the documentation with ``python -m benchmarks.pictures``.

Reconstructs the sample scene on a pseudo terminal. Also reconstructs two photos without overlap to
get the report of a failed run. Then captures both reports and the viewer in headless Chromium.
Needs chromium, chromedriver, selenium and mpsfm-viser.
"""

from __future__ import annotations

import argparse
import base64
import json
import os
import pty
import re
import shutil
import signal
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rich.console import Console
from rich.text import Text

from benchmarks._browser import capture_png, start_browser
from benchmarks._scenes import MPSFM

ROOT = Path(__file__).resolve().parents[1]
PICTURES = ROOT / "docs" / "pictures"
WIDTH = 1100
"""Width of a picture of the documentation in pixels."""
_APART = ("view_0.jpg", "view_4.jpg")
"""Two photos of the sample scene without overlap, on opposite walls."""
_COLUMNS = 118
_MAPS = ("photo", "prior", "refined", "std", "normals")


def on_terminal(*arguments: str, code: int = 0) -> str:
    """Run a command on a pseudo terminal, and return its output."""
    ours, theirs = pty.openpty()
    environment = {**os.environ, "COLUMNS": str(_COLUMNS), "TERM": "xterm-256color"}
    process = subprocess.Popen(
        [*MPSFM, *arguments], stdin=theirs, stdout=theirs, stderr=theirs, env=environment
    )
    os.close(theirs)
    output = b""
    while True:
        try:
            part = os.read(ours, 65536)
        except OSError:  # on Linux, after the command closed the terminal
            break
        if not part:
            break
        output += part
    if process.wait() != code:
        raise SystemExit(f"mpsfm {' '.join(arguments)} ended with exit code {process.returncode}")
    return output.decode("utf-8", errors="replace")


def draw_terminal(output: str, command: str, path: Path) -> None:
    """Render terminal output as SVG with rich; progress bars appear once, in their final state."""
    lines = [""]
    for part in re.split(r"(\x1b\[1A|\x1b\[2K|\r|\n)", output):
        if part == "\x1b[1A":
            lines.pop()
        elif part == "\x1b[2K":
            lines[-1] = ""
        elif part == "\n":
            lines.append("")
        elif part != "\r":
            lines[-1] += part
    with Path(os.devnull).open("w") as nowhere:
        console = Console(record=True, width=_COLUMNS, file=nowhere, force_terminal=True)
        console.print(Text(f"$ {command}", style="bold"))
        console.print(Text.from_ansi("\n".join(lines).rstrip()))
    drawn = console.export_svg(title="mpsfm", unique_id="mpsfm")
    drawn = re.sub(r"@font-face \{.*?\}", "", drawn, flags=re.DOTALL)  # fetched from elsewhere
    path.write_text(drawn, encoding="utf-8")


def shoot(browser: Any, name: str) -> None:
    """Capture the browser window as a JPEG picture."""
    png = np.frombuffer(capture_png(browser), np.uint8)
    picture = cv2.imdecode(png, cv2.IMREAD_COLOR)
    size = (WIDTH, round(picture.shape[0] * WIDTH / picture.shape[1]))
    picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    _write(name, picture)


def _write(name: str, picture: np.ndarray) -> None:
    encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 85])[1]
    (PICTURES / name).write_bytes(encoded.tobytes())


def wait_for(browser: Any, script: str) -> None:
    """Wait until a JavaScript expression is true in the browser."""
    end = time.monotonic() + 300
    while not browser.execute_script(f"return {script}"):
        if time.monotonic() > end:
            raise SystemExit(f"never true: {script}")
        time.sleep(0.2)


def shoot_report(browser: Any, folder: Path) -> None:
    """Capture the first screen of a report, one photo, and the points in each color mode."""
    browser.get((folder / "report.html").resolve().as_uri())
    wait_for(browser, "window.report !== undefined")
    time.sleep(3)  # textures
    shoot(browser, "report.jpg")
    browser.execute_script("document.getElementById('view').scrollIntoView({behavior: 'instant'})")
    browser.execute_script("document.querySelectorAll('#strip button')[2].click()")
    for color, name in (("std", "colour_std.jpg"), ("error", "colour_error.jpg")):
        _colour(browser, color)
        shoot(browser, name)
    _colour(browser, "views")
    browser.execute_script("document.querySelectorAll('.tabs button')[2].click()")
    time.sleep(1)
    shoot(browser, "photo.jpg")
    browser.execute_script(
        "document.getElementById('matches').scrollIntoView({behavior: 'instant'})"
    )
    time.sleep(1)
    shoot(browser, "matches.jpg")


def _colour(browser: Any, color: str) -> None:
    browser.execute_script(
        "const choice = document.getElementById('colour'); choice.value = arguments[0];"
        "choice.dispatchEvent(new Event('change'))",
        color,
    )
    time.sleep(2)


def draw_maps(folder: Path, row: int = 5) -> None:
    """Draw photo, depth and normal maps of one image side by side, from the data of the report."""
    text = (folder / "report.html").read_text(encoding="utf-8")
    match = re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL)
    assert match is not None
    pictures = json.loads(match[1])["photos"][row]["pictures"]
    strip = []
    for name in _MAPS:
        data = base64.b64decode(pictures[name]["src"].partition(",")[2])
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        strip.append(cv2.resize(picture, (320, 240), interpolation=cv2.INTER_AREA))
    _write("maps.jpg", np.hstack(strip))


def shoot_viewer(browser: Any, folder: Path) -> None:
    """Capture ``mpsfm view``."""
    environment = {**os.environ, "MPSFM_VIEWER_PORT": "18790", "PYTHONUNBUFFERED": "1"}
    process = subprocess.Popen(
        [*MPSFM, "view", str(folder)], stdout=subprocess.PIPE, text=True, env=environment
    )
    try:
        assert process.stdout is not None
        address = next(filter(None, (re.search(r"http://\S+", line) for line in process.stdout)))
        browser.get(address[0])
        wait_for(browser, "location.protocol === 'http:' && document.querySelector('canvas')")
        time.sleep(20)  # the 3D scene appears later than the page

        # Close viser's warning about browsers without a GPU.
        close = "document.querySelectorAll('.mantine-Notification-closeButton')"
        browser.execute_script(f"{close}.forEach((button) => button.click())")
        time.sleep(2)
        shoot(browser, "viewer.jpg")
    finally:
        process.send_signal(signal.SIGINT)
        process.wait()


def main() -> None:
    """Create all pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--output", type=Path, help="keeps results; those that are there are not made again"
    )
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.output or Path(scratch)
        out, failed, photos = folder / "out", folder / "failed", folder / "photos"
        photos.mkdir(parents=True, exist_ok=True)
        for name in _APART:
            shutil.copy(ROOT / "examples" / "sample_scene" / "images" / name, photos)
        shown = "mpsfm demo --output out"
        if not (out / "report.html").is_file():
            output = on_terminal("demo", "--offline", "--output", str(out))
            draw_terminal(output.replace(str(out), "out"), shown, PICTURES / "terminal.svg")
        if not (failed / "report.html").is_file():
            ours = ("--offline", "--set", "depth.use=compact")
            on_terminal("reconstruct", str(photos), *ours, "-o", str(failed), code=3)
        draw_maps(out)
        with start_browser() as browser:
            browser.get((failed / "report.html").resolve().as_uri())
            wait_for(browser, "document.querySelector('#photo img.main') !== null")
            time.sleep(1)
            shoot(browser, "failed.jpg")
            shoot_report(browser, out)
            shoot_viewer(browser, out)


if __name__ == "__main__":
    main()
