"""Tests of the report in a real browser, opened as a file."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from mpsfm_core.data.result_layout import REPORT

Open = Callable[[Path], Any]


@pytest.fixture
def opened(browser: Any) -> Open:
    """Function that opens the report of a result folder and clears earlier logs."""

    def open_page(folder: Path) -> Any:
        browser.get("about:blank")
        for kind in ("browser", "performance"):
            browser.get_log(kind)
        browser.get((folder / REPORT).resolve().as_uri())
        return browser

    return open_page


def wait_for(browser: Any, script: str, *arguments: object, seconds: float = 60) -> Any:
    """Wait until a JavaScript expression is true, and return its value."""
    end = time.monotonic() + seconds
    while not (value := browser.execute_script(f"return {script}", *arguments)):
        assert time.monotonic() < end, f"never true: {script}"
        time.sleep(0.1)
    return value


def click(browser: Any, x: float, y: float) -> None:
    for kind in ("mousePressed", "mouseReleased"):
        place = {"x": x, "y": y, "button": "left", "clickCount": 1}
        browser.execute_cdp_cmd("Input.dispatchMouseEvent", {"type": kind, **place})


def requests_of(browser: Any) -> set[str]:
    messages = (json.loads(line["message"])["message"] for line in browser.get_log("performance"))
    return {
        message["params"]["request"]["url"]
        for message in messages
        if message["method"] == "Network.requestWillBeSent"
    }


COLORED = """(() => {
  const canvas = document.getElementById('scene');
  const gl = canvas.getContext('webgl2');
  const pixels = new Uint8Array(4 * canvas.width * canvas.height);
  gl.readPixels(0, 0, canvas.width, canvas.height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
  const seen = new Set();
  for (let i = 0; i < pixels.length; i += 4)
    seen.add((pixels[i] << 16) + (pixels[i + 1] << 8) + pixels[i + 2]);
  return seen.size;
})()"""


LOWEST_ADVICE = """Math.max(...[...document.querySelectorAll('.finding:not(.note) .do')].map(
  (advice) => advice.getBoundingClientRect().bottom))"""
SCREEN = 800
"""Height in pixels of the page that is visible without scrolling."""


def test_report_renders_without_network_requests(opened: Open, finished: Path) -> None:
    browser = opened(finished)
    wait_for(browser, "window.report !== undefined")
    wait_for(browser, f"{COLORED} > 100")
    assert [line for line in browser.get_log("browser") if line["level"] == "SEVERE"] == []
    page = (finished / REPORT).resolve().as_uri()
    foreign = {
        url
        for url in requests_of(browser)
        if not (url == page or url.startswith(("data:", "blob:")))
    }
    assert foreign == set()


def test_first_screen_shows_unregistered_photos_and_remedies(opened: Open, finished: Path) -> None:
    browser = opened(finished)
    assert wait_for(browser, "document.getElementById('badge').innerText").lower() == "partial"
    assert "1 photo missing: no verified matches" in browser.execute_script(
        "return document.querySelector('.finding.warning h3').innerText"
    )
    assert browser.execute_script(f"return {LOWEST_ADVICE}") < SCREEN


def test_hostile_names_are_shown_as_text(opened: Open, finished: Path) -> None:
    browser = opened(finished)
    names = wait_for(
        browser, "[...document.querySelectorAll('#table tbody tr')].map((row) => row.innerText)"
    )
    assert any("</script><b onload" in name for name in names)
    assert browser.execute_script("return document.querySelectorAll('b[onload]').length") == 0


def test_click_on_camera_shows_its_photo(opened: Open, finished: Path) -> None:
    browser = opened(finished)
    wait_for(browser, "window.report !== undefined")
    wait_for(browser, f"{COLORED} > 100")
    browser.execute_script("document.getElementById('view').scrollIntoView({behavior: 'instant'})")
    title = "document.querySelector('#photo h3').innerText"
    for name in ("1.png", "more/3.png", "2.png"):
        order = browser.execute_script(
            "return JSON.parse(document.getElementById('data').textContent)"
            ".photos.findIndex((photo) => photo.name === arguments[0])",
            name,
        )
        x, y = browser.execute_script("return window.report.screenOf(arguments[0])", order)
        click(browser, x, y)
        wait_for(browser, f"{title} === arguments[0]", name)


def test_report_shows_maps_matches_and_table(opened: Open, finished: Path) -> None:
    browser = opened(finished)
    wait_for(browser, "window.report !== undefined")
    browser.execute_script("document.querySelector('#strip button').click()")
    maps = "[...document.querySelectorAll('.tabs button')].map((button) => button.innerText)"
    assert wait_for(browser, maps) == ["Photo", "Prior", "Refined", "Std", "Normals"]
    for number in range(5):
        browser.execute_script(f"document.querySelectorAll('.tabs button')[{number}].click()")
        wait_for(browser, "document.querySelector('#photo img.main').naturalWidth > 0")
    wait_for(browser, "Number(document.querySelector('#photo .pair canvas').dataset.lines) > 20")
    head = "document.querySelectorAll('#table th button')[4].click()"
    points = (
        "[...document.querySelectorAll('#table tbody tr')].map((row) => row.cells[4].innerText)"
    )
    browser.execute_script(head)
    assert browser.execute_script(f"return {points}")[0] == "0"  # the photo of noise
    browser.execute_script(head)
    assert browser.execute_script(f"return {points}")[-1] == "0"
    for color in ("error", "std", "views"):
        browser.execute_script(
            "const choice = document.getElementById('colour'); choice.value = arguments[0];"
            "choice.dispatchEvent(new Event('change'))",
            color,
        )
        assert wait_for(browser, "!document.getElementById('legend').hidden")
    edges = browser.execute_script("return document.querySelectorAll('#graph line').length")
    assert edges >= 3
    browser.execute_script(
        "document.querySelector('#graph line').dispatchEvent(new Event('click'))"
    )
    assert wait_for(browser, "document.getElementById('large').open")
    assert [line for line in browser.get_log("browser") if line["level"] == "SEVERE"] == []


def test_slider_moves_the_camera_of_a_video(opened: Open, walked: Path) -> None:
    browser = opened(walked)
    wait_for(browser, "window.report !== undefined")
    shown_time = "document.querySelector('.tools output').innerText"
    assert browser.execute_script(f"return {shown_time}") == "0.0 s"
    picture = "document.getElementById('scene').toDataURL()"
    before = wait_for(browser, picture)
    browser.execute_script(
        "const slider = document.querySelector('input.video'); slider.value = 2;"
        "slider.dispatchEvent(new Event('input'))"
    )
    assert browser.execute_script(f"return {shown_time}") == "1.0 s"
    wait_for(browser, f"{picture} !== arguments[0]", before)
    assert [line for line in browser.get_log("browser") if line["level"] == "SEVERE"] == []


def test_first_screen_of_failed_run_shows_remedy(opened: Open, failed: Path) -> None:
    browser = opened(failed)
    assert wait_for(browser, "document.getElementById('badge').innerText").lower() == "failed"
    assert browser.execute_script(f"return {LOWEST_ADVICE}") < SCREEN
    assert "No two photos" in browser.execute_script(
        "return document.querySelector('.finding.bad h3').innerText"
    )
    wait_for(browser, "document.querySelector('#photo img.main').naturalWidth > 0")
    assert [line for line in browser.get_log("browser") if line["level"] == "SEVERE"] == []


def test_photo_panel_shows_the_prediction_of_a_held_out_photo(opened: Open, held_out: Path) -> None:
    browser = opened(held_out)
    wait_for(browser, "window.report !== undefined")
    for name, shown in (("1.png", True), ("2.png", False)):
        browser.execute_script(
            "[...document.querySelectorAll('#table tbody tr')]"
            ".find((row) => row.cells[0].innerText.includes(arguments[0])).click()",
            name,
        )
        wait_for(browser, "document.querySelector('#photo h3').innerText === arguments[0]", name)
        text = browser.execute_script("return document.getElementById('photo').innerText")
        assert ("dense.ply" in text) == ("PSNR" in text) == shown


def test_report_opens_on_the_textured_mesh(opened: Open, meshed: Path) -> None:
    browser = opened(meshed)
    wait_for(browser, "window.report !== undefined")
    shown = "document.querySelector('#tools [aria-pressed=true]').innerText"
    assert browser.execute_script(f"return {shown}") == "mesh"
    wait_for(browser, f"{COLORED} > 100")
    faults = [line for line in browser.get_log("browser") if line["level"] == "SEVERE"]
    assert not faults
