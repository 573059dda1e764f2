"""The web page of a running daemon, in a real browser, and under readers that hang and that are many."""

from __future__ import annotations

import json
import socket
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

from monitor.config import configuration
from monitor.model import simulate
from monitor.service import status
from tests.support.browser import browser_tool
from tests.support.debian import demand
from tests.support.live_site import RATE, LiveDaemon, save_stream
from tests.support.site import SITE as BARE_SITE, TOKEN
from tests.support.waiting import until

pytestmark = pytest.mark.system

PACE_S = 0.025
"""Between two blocks of half a second: twenty times real time, four windows a second."""
READERS, HANGING = 50, 40


@contextmanager
def running(folder: Path, frame_text: str, keys: str) -> Iterator[tuple[LiveDaemon, str]]:
    """A daemon with a page, and its address."""
    site = folder / "site.toml"
    site.write_text(BARE_SITE.replace('dir = "out"', f'dir = "out"\nweb = "127.0.0.1:0"\n{keys}') + frame_text)
    model = configuration.load(site).model()
    save_stream(folder, simulate(model, duration_s=120.0, rate_hz=RATE, noise=0.03, seed=6).floors)
    with LiveDaemon(folder, PACE_S) as daemon:
        daemon.wait_for("READY")
        (address,) = [text.split()[-1] for text in daemon.said.splitlines() if text.startswith("web page at ")]
        daemon.wait_for_windows(3)
        yield daemon, address


def wait_for(page: Any, expression: str) -> None:
    for _ in range(240):
        if page.value(expression):
            return
        page.wait(0.25)
    raise AssertionError(f"not within a minute: {expression}; the page says {page.value('document.body.innerText')}")


def own_errors(page: Any) -> list[str]:
    return [text for text in page.errors if "401" not in text]


SMALLEST = """Math.min(...[...document.querySelectorAll('body *')].filter(e => e.offsetParent).map(e =>
  parseFloat(getComputedStyle(e).fontSize)))"""
DRAWN = """document.querySelectorAll('#modes canvas').length >= 3 && document.querySelectorAll('#loss canvas').length >= 3 &&
  document.querySelectorAll('#sensors tbody tr').length === 3"""
OUTSIDE = (
    "performance.getEntriesByType('resource').map(e => e.name).filter(name => !name.startsWith(location.origin)).length"
)


def test_a_browser_reads_the_page_with_the_token_at_a_desk_and_on_a_telephone(tmp_path: Path, frame_text: str) -> None:
    demand("chromium")
    (tmp_path / "web.token").write_text(TOKEN)
    with (
        running(tmp_path, frame_text, 'web_token_file = "web.token"') as (_, url),
        browser_tool().browser(1280, 900) as page,
    ):
        for width, scheme in ((1280, "light"), (390, "dark")):
            size = {"width": width, "height": 800, "deviceScaleFactor": 1, "mobile": width < 500}
            page.call("Emulation.setDeviceMetricsOverride", **size)
            page.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])
            page.call("Page.navigate", url=url)
            if width > 390:  # the tab keeps the token
                for token, after in (
                    ("wrong" * 5, "login-says').textContent.includes('not the monitor')"),
                    (TOKEN, "login').hidden"),
                ):
                    wait_for(page, "typeof refresh === 'function' && !document.getElementById('login').hidden")
                    page.value(
                        f"document.getElementById('token').value = '{token}'; document.querySelector('#login button').click()"
                    )
                    wait_for(page, f"document.getElementById('{after}")
            wait_for(page, DRAWN)
            assert page.value("document.getElementById('word').textContent") == "not judged", "there is no baseline"
            assert "no baseline" in page.value("document.getElementById('headline').textContent").lower()
            assert page.value("document.documentElement.scrollWidth") <= width
            assert page.value(SMALLEST) >= 11.0
            assert page.value("document.querySelectorAll('figure [role=img][aria-label]').length") >= 6, (
                "charts have words"
            )
            assert page.value("document.getElementById('state').innerText.includes('What to do:')")
            drawn = page.value("document.getElementById('trust').innerText")
            page.value(f"before = {json.dumps(drawn)}")
            wait_for(page, "document.getElementById('trust').innerText !== before")
            assert page.value("document.querySelectorAll('#loss canvas').length") >= 3, "drawn again"
            picture = tmp_path / f"{width}.png"
            picture.write_bytes(page.picture())
            assert (
                page.value("getComputedStyle(document.body).backgroundColor")
                == {"light": "rgb(246, 247, 249)", "dark": "rgb(17, 22, 28)"}[scheme]
            )
        assert page.value(OUTSIDE) == 0
        assert page.value("performance.getEntriesByType('resource').length") > 5
        assert TOKEN not in page.value(
            "performance.getEntriesByType('resource').map(e => e.name).join() + location.href"
        )
        assert page.value("document.cookie") == ""
        page.call("Page.navigate", url=f"{url}api")
        wait_for(page, "document.querySelectorAll('#paths section').length >= 7")
        assert page.value("document.documentElement.scrollWidth") <= 390
        assert own_errors(page) == []


def hang(port: int, text: bytes) -> socket.socket:
    """Say something, and never read the answer; the connection may wait to be accepted."""
    one = socket.socket()
    one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    one.settimeout(30.0)
    one.connect(("127.0.0.1", port))
    one.sendall(text)
    return one


def read_all(url: str, answers: list[int], failures: list[str]) -> None:
    """Read what a browser does when it opens the page."""
    for path in ("", "page.js", "uplot.js", "api/v1/page", "api/v1/windows", "api/v1/sensors"):
        for attempt in range(20):
            try:
                with urllib.request.urlopen(f"{url}{path}", timeout=60.0) as answer:
                    answers.append(len(answer.read()))
                break
            except OSError as error:  # its place was given to a later reader; a browser asks again, too
                if attempt == 19:
                    failures.append(f"{path}: {error}")
                time.sleep(0.2)


def test_readers_that_hang_and_fifty_at_once_hold_up_nothing_and_the_end_is_told(
    tmp_path: Path, frame_text: str
) -> None:
    demand("chromium")
    with (
        running(tmp_path, frame_text, "") as (daemon, url),
        browser_tool().browser(1280, 900) as page,
        ExitStack() as ending,
    ):
        found = status.look(daemon.out)
        assert found["web"] == url
        assert f"web       {url}" in status.tell(found)
        page.call("Page.navigate", url=url)
        wait_for(page, "document.querySelectorAll('#modes canvas').length >= 3")
        assert own_errors(page) == []

        port = int(url.rstrip("/").rpartition(":")[2])
        for k in range(HANGING):
            ending.callback(
                hang(port, b"GET /uplot.js HTTP/1.1\r\nHost: localhost\r\n" + (b"\r\n" if k % 2 else b"")).close
            )
        before = len(daemon.windows)
        page.value("shown = heard")
        answers: list[int] = []
        failures: list[str] = []
        readers = [
            threading.Thread(target=read_all, args=(url, answers, failures), daemon=True) for _ in range(READERS)
        ]
        for reader in readers:
            reader.start()
        for reader in readers:
            reader.join(120.0)
        assert failures == []
        assert len(answers) == 6 * READERS
        until(lambda: len(daemon.windows) >= before + 10, "windows go on")
        wait_for(page, "heard > shown")
        assert daemon.failed == {}

        # What a fault in the page could ask for: the browser refuses it.
        page.errors.clear()
        page.value("new Image().src = 'http://127.0.0.1:9/x.png'")
        page.value(
            "const code = document.createElement('script'); code.textContent = 'window.ran = 1'; document.body.append(code)"
        )
        page.wait(0.5)
        assert page.value("window.ran") is None
        assert sum("Content Security Policy" in text for text in page.errors) >= 2

        for _ in range(HANGING):
            ending.callback(hang(port, b"GET / HTTP/1.1\r\n").close)
        assert daemon.stop()[0] == 0
        page.value("heard -= LATE_MS")  # as if it had not answered for that long
        page.value("refresh()")
        wait_for(page, "document.getElementById('word').textContent === 'No answer'")
        assert page.value("document.getElementById('state').className") == "state not_judged"
        assert page.value("document.getElementById('sign').textContent") == "?"
        said = page.value("document.getElementById('state').innerText")
        assert "Before: not judged: " in said
        assert "What to do:" not in said and "Data:" not in said, (
            "nothing of an earlier state stands as the present one's"
        )
        assert page.value("document.querySelector('#state small')") is None, "since when it had that state"
