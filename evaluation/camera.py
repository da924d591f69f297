"""A picture of a service's live page, where there is a browser to take it with."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
"""Commands that start a browser which Playwright can drive."""
NONE_HERE = "no browser takes a picture of the live page: apt-get install chromium"
TOO_SHORT = "no picture of the live page: no robot was live for long enough"
WIDTH, HEIGHT = 1440, 900
"""Of the picture [pixels]."""
_EVERY = 2.0
"""Seconds between two pictures, of which the last one is kept."""
_SOON = 0.1
"""Seconds between two looks until there is the first: a drive may be short."""
_IS_LIVE = 'document.querySelector("[data-live=true] #looked[data-stale=false]") !== null'


def browser() -> str | None:
    """The path of a browser, if there is one."""
    return next(filter(None, map(shutil.which, BROWSERS)), None)


@contextmanager
def camera(url: str, picture: Path, said: list[str]) -> Iterator[None]:
    """Watches a service's page for as long as the context lasts, and leaves a picture of it.

    Nothing that fails here is raised: it is said.

    Args:
        url: the service.
        picture: the file (.png) to write.
        said: receives one line about what became of it.
    """
    done = threading.Event()

    def watch() -> None:
        path = browser()
        said.append(NONE_HERE if path is None else _watch(path, url, picture, done))

    thread = threading.Thread(target=watch, name="camera")
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


def _watch(path: str, url: str, picture: Path, done: threading.Event) -> str:
    """Takes pictures until it is done; what is to be said of them."""
    try:
        from playwright.sync_api import Error, sync_playwright
    except ImportError:
        return "nobody takes a picture of the live page: pip install playwright"
    taken: bytes | None = None
    try:
        with sync_playwright() as playwright:
            # In containers Chromium has no sandbox of its own; it is shown nothing but our page.
            opened = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
            page = opened.new_page(viewport={"width": WIDTH, "height": HEIGHT})
            page.goto(url)
            while not done.wait(_EVERY if taken else _SOON):
                if page.evaluate(_IS_LIVE):
                    taken = page.screenshot()
            opened.close()
    except Error as error:
        return f"no picture of the live page: {error.message.splitlines()[0]}"
    if taken is None:
        return TOO_SHORT
    try:
        picture.write_bytes(taken)
    except OSError as error:
        return f"no picture of the live page: {picture}: {error.strerror}"
    return f"{picture}: the live page during the drive"
