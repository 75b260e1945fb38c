"""A page in headless Chromium: what it says on the console and whatever it asks for."""

import os
import shutil
from contextlib import contextmanager

import pytest

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
ARGUMENTS = ("--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-component-update")


@contextmanager
def opened(path, width=1200, height=900):
    """Yield the page of a file; on leaving, nothing was said on its console and nothing but the file was asked for.

    Skips where there is no Chromium, but not in continuous integration.
    """
    if CHROMIUM is None:
        (pytest.fail if os.environ.get("CI") else pytest.skip)("no Chromium: install Debian's package chromium")
    from playwright.sync_api import sync_playwright

    said, asked = [], []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=list(ARGUMENTS))
        page = browser.new_page(viewport={"width": width, "height": height})
        page.on("console", lambda message: said.append(message.text))
        page.on("pageerror", lambda error: said.append(str(error)))
        page.on("request", lambda request: asked.append(request.url))
        page.goto(path.as_uri())
        yield page
        browser.close()
    assert not said, said
    assert [url for url in asked if not url.startswith("data:")] == [path.as_uri()]


def picture(page, number=0):
    """What a canvas shows, once it has been drawn."""
    page.wait_for_timeout(100)
    return page.evaluate(
        "(number) => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() =>"
        " done(document.querySelectorAll('canvas')[number].toDataURL()))))",
        number,
    )


def read_over(page, across, downs):
    """All that the view in space says where it is pointed at: in ``across`` columns, at shares of its height."""
    box, said = page.locator("canvas.space").bounding_box(), page.locator("output.said").first
    read = set()
    for column in range(1, across):
        for down in downs:
            page.mouse.move(box["x"] + column / across * box["width"], box["y"] + down * box["height"])
            read.add(said.text_content())
    return read
