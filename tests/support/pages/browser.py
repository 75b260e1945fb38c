"""A page in headless Chromium: what it says on the console and whatever it asks for."""

import os
import shutil
from contextlib import contextmanager

import pytest

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
ARGUMENTS = ("--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-component-update")


class _Shared:
    """One browser for a file of tests, and one tab, as each takes a process of its own."""

    def __init__(self):
        self.playwright = self.browser = self.page = None

    def get(self):
        if self.page is None:
            from playwright.sync_api import sync_playwright

            self.playwright = sync_playwright().start()
            self.browser = self.playwright.chromium.launch(executable_path=CHROMIUM, args=list(ARGUMENTS))
            self.page = self.browser.new_page()
        return self.page

    def close(self):
        if self.browser is not None:
            self.browser.close()
        if self.playwright is not None:
            self.playwright.stop()
        self.playwright = self.browser = self.page = None


SHARED = _Shared()  # closed by a fixture of tests/conftest.py when the tests of a file are over


@contextmanager
def opened(path, width=1200, height=900):
    """Yield the page of a file, unfolded; on leaving, nothing was said on its console and only the file was asked for.

    Skips where there is no Chromium, but not in continuous integration.
    """
    if CHROMIUM is None:
        (pytest.fail if os.environ.get("CI") else pytest.skip)("no Chromium: install Debian's package chromium")
    said, asked = [], []
    page, listeners = (
        SHARED.get(),
        {
            "console": lambda message: said.append(message.text),
            "pageerror": lambda error: said.append(str(error)),
            "request": lambda request: asked.append(request.url),
        },
    )
    page.set_viewport_size({"width": width, "height": height})
    for event, listener in listeners.items():
        page.on(event, listener)
    try:
        page.goto(path.as_uri())
        page.evaluate("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
        yield page
    finally:
        for event, listener in listeners.items():
            page.remove_listener(event, listener)
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


def dragged(page, right, down):
    """What the view in space shows after it was dragged by so many pixels."""
    box = page.locator("canvas.space").bounding_box()
    page.mouse.move(box["x"] + 100, box["y"] + 100)
    page.mouse.down()
    page.mouse.move(box["x"] + 100 + right, box["y"] + 100 + down, steps=3)
    page.mouse.up()
    return picture(page)
