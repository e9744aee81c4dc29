"""Headless Chromium browser for screenshots of HTML pages."""

from __future__ import annotations

import base64
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

_ARGUMENTS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-dev-shm-usage",
    "--disable-background-networking",
    "--hide-scrollbars",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
)


def capture_png(browser: Any) -> bytes:
    """Capture the browser window as PNG through the DevTools protocol, which has no timeout."""
    taken = browser.execute_cdp_cmd("Page.captureScreenshot", {"format": "png"})
    return base64.b64decode(taken["data"])


@contextmanager
def start_browser(width: int = 1280, height: int = 800) -> Iterator[Any]:
    """Start Chromium with a window size in pixels; exit if Chromium is not installed."""
    try:
        from selenium import webdriver
    except ImportError as error:
        raise SystemExit("pip install selenium") from error
    chromium, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if chromium is None or driver is None:
        raise SystemExit(
            "chromium or chromedriver is missing: apt install chromium chromium-driver"
        )
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for argument in _ARGUMENTS:
        options.add_argument(argument)
    options.page_load_strategy = "none"  # benchmarks wait for the page's content
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    browser = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    browser.command_executor.client_config.timeout = 600  # seconds
    browser.set_script_timeout(600)
    screen = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
    try:
        yield browser
    finally:
        browser.quit()
