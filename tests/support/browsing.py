"""A real browser at a real service: Chromium without a window, a line that can be cut, and one result of the engine."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from live_service import LiveService, live_service
from playwright.sync_api import Browser, BrowserContext, Page, sync_playwright
from tcp_proxy import TcpProxy
from tiny_scan import write_scan

FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
WAIT_MS = 45_000


class Browsing:
    """url: where the browser finds the service, which may move behind it."""

    def __init__(self, service: LiveService, proxy: TcpProxy, browser: Browser, folder: Path) -> None:
        self.service, self.proxy, self.browser, self.folder = service, proxy, browser, folder
        self.url = f"http://127.0.0.1:{proxy.port}"
        self._contexts: list[BrowserContext] = []
        self.pictures = Path(os.environ.get("ADVTEX_SCREENSHOTS", folder / "screenshots"))
        self.problems: list[str] = []

    def page(self, *, signed_in: bool = True, url: str = "", width: int = 1280) -> Page:
        """A tab of a new browser profile. What its scripts do wrong is kept in `problems`."""
        context = self.browser.new_context(base_url=url or self.url, viewport={"width": width, "height": 860})
        context.set_default_timeout(WAIT_MS)
        self._contexts.append(context)
        page = context.new_page()
        mine = (url or self.url, "blob:", "data:")
        page.on("request", lambda sent: None if sent.url.startswith(mine) else self.problems.append(sent.url))
        page.on("pageerror", lambda error: self.problems.append(str(error)))
        page.on("console", lambda said: self.problems.append(said.text) if "Content Security" in said.text else None)
        if signed_in:
            page.goto("/sign-in")
            self.sign_in(page)
        return page

    def sign_in(self, page: Page) -> None:
        page.get_by_label("Key").fill(self.service.key)
        page.get_by_role("button", name="Sign in").click()
        page.get_by_role("button", name="Sign out").wait_for()

    def restart_server(self) -> None:
        """Kill it, and let a new one take over; the browser sees the same address."""
        self.service.server.kill()
        self.service.server.wait()
        self.proxy.cut(silently=False)
        self.service.restart_server()
        self.proxy.target = urlsplit(self.service.url).port or 0
        self.proxy.mend()

    def close_pages(self) -> None:
        for context in self._contexts:
            context.close()
        self._contexts.clear()


def chromium() -> str:
    """Debian's; the test fails in words where there is none."""
    found = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if found is None:
        pytest.fail("no Chromium: apt-get install chromium (.ci/run does it, as root)")
    return found


def make_result(folder: Path) -> Path:
    """What the real engine makes of a tiny scan. -> its folder"""
    scan, out = write_scan(folder / "scan-of-result", frames=8), folder / "result"
    command = [
        sys.executable,
        "-m",
        "advtex_engine",
        "texture",
        str(scan),
        "-o",
        str(out),
        "--method",
        "mean",
        "--no-refine",
    ]
    subprocess.run([*command, "--holdout", "4"], check=True, capture_output=True, timeout=300)
    shutil.rmtree(out / "work", ignore_errors=True)
    return out


@contextmanager
def browsing(folder: Path) -> Iterator[Browsing]:
    """With one worker, whose engine is `page_engines.engine`."""
    binary = chromium()
    settings = {"ADVTEX_ENGINE_PAGE_RESULT": str(make_result(folder)), "ADVTEX_AUTH_FAILURES_PER_MINUTE": "1000"}
    with live_service(folder, settings=settings) as service:
        service.start_worker("page_engines:engine")
        with TcpProxy(urlsplit(service.url).port or 0) as proxy, sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=binary, args=FLAGS)
            yield Browsing(service, proxy, browser, folder)
            browser.close()
