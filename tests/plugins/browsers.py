"""A headless Chromium for tests of pages, and a page in it that must log no error."""

import re
import shutil

import pytest

_NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
PATIENCE_MS = 15_000
"""For waits that are long on an overloaded computer only; fast responses are timed."""
_REFUSED = r"status of 40[39]"
"""Chromium logs refusals of a server, which the page shows."""


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
    """Window as wide as a laptop's; each page has a tab, and so a token, of its own."""
    context = browser.new_context(viewport={"width": 1280, "height": 800})
    context.set_default_timeout(PATIENCE_MS)
    return context


@pytest.fixture
def open_page(desktop):
    """Open a page of an address; none may log an error or send requests to other servers.

    `open_page.complaints` has the errors of browser and page.
    """
    pages, complaints = [], []

    def open_page(address, width=1280):
        page = desktop.new_page()
        pages.append(page)
        if width != 1280:
            page.set_viewport_size({"width": width, "height": 844})

        def on_console(message):
            if message.type == "error" and not re.search(_REFUSED, message.text):
                complaints.append(message.text)

        def on_request(request):
            if request.url.split("/")[2] != address.split("/")[2]:
                complaints.append(f"asked for {request.url}")

        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("console", on_console)
        page.on("request", on_request)
        page.goto(address)
        return page

    open_page.complaints = complaints
    yield open_page
    for page in pages:
        page.close()
    assert not complaints
