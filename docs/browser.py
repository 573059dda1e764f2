"""docs/browser.py PAGE_OR_ADDRESS PICTURE.png [SECONDS]: what a browser shows of a page, as a picture, without a screen.

Needs the Debian package chromium.  A page's own errors end it with status 1.  Loopback and files only.
"""

from __future__ import annotations

import base64
import json
import os
import select
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

_FLAGS = """--headless=new --no-sandbox --disable-quic --no-first-run --disable-background-networking --disable-sync
--disable-component-update --disable-default-apps --hide-scrollbars --use-angle=swiftshader
--enable-unsafe-swiftshader --ignore-gpu-blocklist --remote-debugging-pipe""".split()  # noqa: SIM905
_OUTSIDE = "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1"  # nothing but loopback


class Page:
    """One page of a browser, by the DevTools protocol over a pair of pipes."""

    def __init__(self, to_browser: int, from_browser: int) -> None:
        self._write, self._read = to_browser, from_browser
        self._rest, self._count, self._session, self._loaded = b"", 0, "", False
        self.errors: list[str] = []
        """Exceptions and what the console was told as an error."""
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Runtime", "Page", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        """What the browser answers to a call."""
        self._count += 1
        content = {"id": self._count, "method": method, "params": params}
        if self._session:
            content["sessionId"] = self._session
        os.write(self._write, json.dumps(content).encode() + b"\0")
        while True:
            answer = self._message(60.0)
            if answer is None:
                raise TimeoutError(f"{method}: no answer from the browser")
            if answer.get("id") == self._count:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']['message']}")
                return dict(answer["result"])
            self._note(answer)

    def show(self, address: str, seconds: float) -> None:
        """Load what an address holds and let it go on; before it has loaded, a busy machine cannot print it."""
        self._loaded = False
        self.call("Page.navigate", url=address)
        until = time.monotonic() + 60.0
        while not self._loaded:
            if (event := self._message(until - time.monotonic())) is None:
                raise TimeoutError(f"{address}: not loaded within a minute")
            self._note(event)
        self.wait(seconds)

    def wait(self, seconds: float) -> None:
        """Let the page go on."""
        until = time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0:
            if (event := self._message(left)) is not None:
                self._note(event)

    def picture(self) -> bytes:
        """What it shows now, PNG."""
        return base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])

    def value(self, expression: str) -> Any:
        """Of a JavaScript expression."""
        return self.call("Runtime.evaluate", expression=expression, returnByValue=True)["result"].get("value")

    def _message(self, timeout_s: float) -> dict[str, Any] | None:
        until = time.monotonic() + timeout_s
        while b"\0" not in self._rest:
            if not select.select([self._read], [], [], max(0.0, until - time.monotonic()))[0]:
                return None
            data = os.read(self._read, 1 << 20)
            if not data:
                raise RuntimeError("the browser ended by itself")
            self._rest += data
        message, _, self._rest = self._rest.partition(b"\0")
        return dict(json.loads(message))

    def _note(self, event: dict[str, Any]) -> None:
        kind, params = event.get("method"), event.get("params", {})
        self._loaded = self._loaded or kind == "Page.loadEventFired"
        if kind == "Runtime.exceptionThrown":
            self.errors.append(params["exceptionDetails"].get("exception", {}).get("description", "exception"))
        elif kind == "Runtime.consoleAPICalled" and params["type"] == "error":
            self.errors.append(" ".join(str(a.get("value", a.get("description", ""))) for a in params["args"]))
        elif kind == "Log.entryAdded" and params["entry"]["level"] == "error":
            self.errors.append(params["entry"]["text"])


@contextmanager
def browser(width: int = 1140, height: int = 1000) -> Iterator[Page]:
    """A browser without a screen, closed at the end."""
    browser_reads, to_browser = os.pipe()
    from_browser, browser_writes = os.pipe()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as home:
        # The browser reads its file 3 and writes its file 4.
        command = f'exec chromium "$@" 3<&{browser_reads} 4>&{browser_writes}'
        arguments = [*_FLAGS, _OUTSIDE, f"--user-data-dir={home}", f"--window-size={width},{height}", "about:blank"]
        process = subprocess.Popen(
            ["bash", "-c", command, "chromium", *arguments],
            pass_fds=(browser_reads, browser_writes),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env={**os.environ, "HOME": home},
        )
        os.close(browser_reads)
        os.close(browser_writes)
        try:
            yield Page(to_browser, from_browser)
        finally:
            os.close(to_browser)  # which ends it
            try:
                process.wait(20)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            os.close(from_browser)


def main() -> None:
    """Take the picture."""
    if len(sys.argv) not in (3, 4):
        sys.exit(__doc__)
    place, picture = sys.argv[1], Path(sys.argv[2])
    address = place if "://" in place else Path(place).resolve().as_uri()
    with browser(*((1600, 1000) if "://" in place else (1140, 1000))) as page:
        page.show(address, float(sys.argv[3]) if len(sys.argv) > 3 else 2.0)
        height = int(page.value("document.documentElement.scrollHeight"))
        size = {"width": 1140, "height": max(height, 600), "deviceScaleFactor": 1, "mobile": False}
        if "://" not in place:  # a document: all of it
            page.call("Emulation.setDeviceMetricsOverride", **size)
        picture.write_bytes(page.picture())
        # What a page asks of the world outside is refused here, and no error of its own.
        own = [e for e in page.errors if "ERR_NAME_NOT_RESOLVED" not in e and "Failed to fetch" not in e]
        if own:
            sys.exit("\n".join(own))


if __name__ == "__main__":
    main()
