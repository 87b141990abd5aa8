"""A headless Chromium for tests of pages, and a page in it that must not complain."""

import re
import shutil

import pytest

_NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
PATIENCE_MS = 15_000
"""For what only takes long on a computer that is overloaded; what is to be quick is timed."""
_REFUSED = r"status of 40[39]"
"""Chromium logs what a server refuses, which the page shows."""


@pytest.fixture(scope="module")  # while it is open, its thread cannot run another event loop
def browser():
    program = next(filter(None, map(shutil.which, _NAMES)), None)
    if program is None:
        pytest.skip(f"no browser: none of {', '.join(_NAMES)} is installed")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
        yield chromium
        chromium.close()


@pytest.fixture(scope="module")
def desktop(browser):
    """A window as wide as a laptop's; its pages share no tab, and so no token."""
    context = browser.new_context(viewport={"width": 1280, "height": 800})
    context.set_default_timeout(PATIENCE_MS)
    return context


@pytest.fixture
def open_page(desktop):
    """Open a page of an address; at the end none may have made an error or asked elsewhere.

    `open_page.complaints` has what browser and page complained of.
    """
    pages, complaints = [], []

    def open_page(address, width=1280):
        page = desktop.new_page()
        pages.append(page)
        if width != 1280:
            page.set_viewport_size({"width": width, "height": 844})

        def hear(told):
            if told.type == "error" and not re.search(_REFUSED, told.text):
                complaints.append(told.text)

        def watch(request):
            if request.url.split("/")[2] != address.split("/")[2]:
                complaints.append(f"asked for {request.url}")

        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("console", hear)
        page.on("request", watch)
        page.goto(address)
        return page

    open_page.complaints = complaints
    yield open_page
    for page in pages:
        page.close()
    assert not complaints
