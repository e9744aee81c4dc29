"""A headless Chromium for pictures of our pages."""

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


def picture_of(browser: Any) -> bytes:
    """The window as PNG, however long it takes; the driver's own command gives up after 10 s."""
    taken = browser.execute_cdp_cmd("Page.captureScreenshot", {"format": "png"})
    return base64.b64decode(taken["data"])


@contextmanager
def headless(width: int = 1280, height: int = 800) -> Iterator[Any]:
    """Selenium's driver of a page of this size. Ends the script where there is no browser."""
    try:
        from selenium import webdriver
    except ImportError as error:
        raise SystemExit("pip install selenium") from error
    chromium, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if chromium is None or driver is None:
        raise SystemExit("needs chromium and chromedriver (Debian: chromium chromium-driver)")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for argument in _ARGUMENTS:
        options.add_argument(argument)
    options.page_load_strategy = "none"  # who wants to see something waits for it
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    browser = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    browser.command_executor.client_config.timeout = 600  # seconds; drawn without a GPU
    browser.set_script_timeout(600)
    screen = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
    try:
        yield browser
    finally:
        browser.quit()
