"""Delivers one message, or fetches one address, as a program: ``python delivery.py``, with the job as JSON on standard input.

The exit code is 0 if that was done.  It is a process of its own because libraries bound the time of each read, never that of a
delivery as a whole; a process can be ended.  The kernel ends it at its deadline also where its parent is gone.

No redirect is followed: a message that is sent on arrives without a body, and what answers there is not the receiver.
"""

from __future__ import annotations

import json
import signal
import sys
import urllib.request
from typing import Any

_READ_S = 10.0
"""Longest wait for the next bytes of an answer. [s; judgement]"""


def _notify(job: dict[str, Any]) -> bool:
    """Send a message with apprise; return whether it was accepted."""
    import apprise

    asset = apprise.AppriseAsset(
        async_mode=False, app_id="shm-monitor", app_desc="structural health monitor", http_redirects=False
    )
    service = apprise.Apprise.instantiate(job["url"], asset=asset)
    if not isinstance(service, apprise.NotifyBase):
        return False
    service.redirects = False  # also where the address itself asks for them
    return bool(service.notify(body=job["body"], title=job["title"], notify_type=job["type"]))


class _NoRedirects(urllib.request.HTTPRedirectHandler):
    def redirect_request(self, *_: Any) -> None:
        """Have every redirect raised as an error."""


def _fetch(job: dict[str, Any]) -> bool:
    """Fetch an http or https address; return whether it answered itself, without an error."""
    with urllib.request.build_opener(_NoRedirects).open(job["url"], timeout=_READ_S) as answer:
        answer.read(1024)
    return True


def main() -> int:
    """Do the job on standard input and return the exit code."""
    job = json.load(sys.stdin)
    signal.setitimer(signal.ITIMER_REAL, job["deadline_s"])
    return 0 if (_notify(job) if "body" in job else _fetch(job)) else 1


if __name__ == "__main__":
    sys.exit(main())
