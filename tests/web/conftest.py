"""A browser for tests, and pages in it."""

import os
import shutil
import time
from pathlib import Path

import pytest

from splatax.web import page

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
# Without a graphics device, Chromium draws in software.
SOFTWARE = (
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
)
PATIENCE = 60  # seconds


@pytest.fixture(scope="session")
def viewer() -> Path:
    """The built viewer."""
    if not page.VIEWER.exists():
        pytest.skip("the viewer is not built: run `make page` (needs Node.js)")
    return page.VIEWER


@pytest.fixture(scope="session")
def browser(viewer):
    """Headless Chromium: of SPLATAX_CHROMIUM, the system's, or playwright's own."""
    playwright = pytest.importorskip("playwright.sync_api", reason="no playwright: pip install playwright")
    named = os.environ.get("SPLATAX_CHROMIUM") or next(filter(None, map(shutil.which, BROWSERS)), None)
    with playwright.sync_playwright() as started:
        path = named or started.chromium.executable_path
        if not Path(path).exists():
            pytest.skip("no Chromium: set SPLATAX_CHROMIUM to one, or run `playwright install chromium`")
        sandbox = () if hasattr(os, "geteuid") and os.geteuid() else ("--no-sandbox",)
        launched = started.chromium.launch(executable_path=path, args=[*SOFTWARE, *sandbox])
        yield launched
        launched.close()


class Tab:
    """A page that is open, and all that it has done."""

    def __init__(self, context, path: Path):
        self.tab = context.new_page()
        self.errors: list[str] = []
        self.requests: list[str] = []
        self.tab.on("pageerror", lambda error: self.errors.append(str(error)))
        self.tab.on(
            "console",
            lambda line: self.errors.append(line.text) if line.type in ("error", "warning") else None,
        )
        self.tab.on("request", lambda request: self.requests.append(request.url))
        self.tab.goto(path.as_uri())

    def tell(self, expression):
        return self.tab.evaluate(expression)

    def wait_for(self, expression):
        """Asks until it is true. (Playwright's own waiting is forbidden by the page's security policy.)"""
        end = time.monotonic() + PATIENCE
        while not self.tell(expression):
            assert time.monotonic() < end, f"never true: {expression}. The page says: {self.errors}"
            time.sleep(0.02)

    def settle(self):
        """Waits until nothing moves and the picture is final."""
        self.wait_for("Boolean(window.viewer) && !viewer.motion && viewer.settled")

    @property
    def position(self):
        return self.tell("viewer.pose.position.toArray()")

    @property
    def orientation(self):
        return self.tell("viewer.pose.quaternion.toArray()")


@pytest.fixture
def open_page(browser):
    """Opens a page from its file, without a network, in a window of some size, after a script of the test."""
    contexts = []

    def open_page(path, size=(640, 480), script="", **device) -> Tab:
        window = {"width": size[0], "height": size[1]}
        context = browser.new_context(viewport=window, reduced_motion="reduce", **device)
        context.set_offline(True)
        if script:
            context.add_init_script(script)
        contexts.append(context)
        return Tab(context, path)

    yield open_page
    for context in contexts:
        context.close()
