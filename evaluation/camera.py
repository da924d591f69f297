"""A picture of a service's live page, where there is a browser to take it with."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
"""Commands that start a browser which Playwright can drive."""
NONE_HERE = (
    "no browser takes a picture of the live page: `apt-get install chromium`, `pip install playwright`"
)
WIDTH, HEIGHT = 1440, 900
"""Of the picture [pixels]."""


def browser() -> str | None:
    """The path of a browser, if there is one."""
    return next(filter(None, map(shutil.which, BROWSERS)), None)


@contextmanager
def camera(url: str, picture: Path, said: list[str]) -> Iterator[None]:
    """Watches a service's page meanwhile, and leaves a picture of it at the end, unless something fails.

    Args:
        url: the service.
        picture: the file (.png) to write.
        said: receives one line about what became of it.
    """
    path = browser()
    try:
        from playwright.sync_api import Error, sync_playwright
    except ImportError:
        path = None
    if path is None:
        said.append(NONE_HERE)
        yield
        return
    with ExitStack() as stack:
        page = None
        try:
            playwright = stack.enter_context(sync_playwright())
            # In containers Chromium has no sandbox of its own; it is shown nothing but our page.
            opened = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
            stack.callback(opened.close)
            page = opened.new_page(viewport={"width": WIDTH, "height": HEIGHT})
            page.goto(url)
        except Error as error:
            said.append(f"no picture of the live page: {error.message.splitlines()[0]}")
        yield
        if page is not None and not said:
            try:
                page.screenshot(path=picture)
                said.append(f"{picture}: the live page at the end of the drive")
            except Error as error:
                said.append(f"no picture of the live page: {error.message.splitlines()[0]}")
