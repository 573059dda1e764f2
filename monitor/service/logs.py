"""Log of the service: one line for each event on standard error, which the platform keeps and rotates."""

from __future__ import annotations

import json
import logging
import re
import sys
import threading
from contextvars import ContextVar
from datetime import UTC, datetime
from typing import Literal

from monitor.config import LogSettings

_log = logging.getLogger(__name__)
_PLAIN = re.compile(r"[^\s\"=\\\x00-\x1f\x7f-\x9f]+")
_MOST_TEXT = 4000
site_name: ContextVar[str | None] = ContextVar("site_name", default=None)
"""Name of the site whose work is done, where a process works for many."""


class LineFormatter(logging.Formatter):
    """Formatter that writes each event as exactly one line; text from outside is escaped, so it cannot forge a second line.

    A line is ``key=value`` pairs, or JSON.  It names the site, but for the work of a site that `site_name` names.
    """

    def __init__(self, style: Literal["text", "json"], site: str) -> None:
        super().__init__()
        self._json, self._site = style == "json", site

    def format(self, record: logging.LogRecord) -> str:
        """Format an event as a line without the newline."""
        fields = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "site": site_name.get() or self._site,
            "logger": record.name,
            "message": record.getMessage()[:_MOST_TEXT],
        }
        if record.exc_info:
            fields["exception"] = self.formatException(record.exc_info)[-_MOST_TEXT:]
        if self._json:
            return json.dumps(fields)
        return " ".join(f"{k}={v if _PLAIN.fullmatch(v) else _quoted(v)}" for k, v in fields.items())


def _quoted(text: str) -> str:
    """Write a text in quotes, with all escaped that cannot be printed.

    Examples
    --------
    >>> print(_quoted("1.2 \u00b1 0.1 %\u2028"))
    "1.2 ± 0.1 %\\u2028"
    """
    quoted = json.dumps(text, ensure_ascii=False)
    return "".join(c if c.isprintable() else json.dumps(c)[1:-1] for c in quoted)


def begin(settings: LogSettings, site: str) -> None:
    """Set up logging for the process with the format and the level of the settings.

    The library that delivers notifications (apprise) is silenced: at some levels it logs the addresses, which hold secrets.
    """
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(LineFormatter(settings.format, site))
    logging.basicConfig(handlers=[handler], level=settings.level.upper(), force=True)
    threading.excepthook = _log_thread_end
    for name in ("apprise", "urllib3", "requests"):
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)


def _log_thread_end(ended: threading.ExceptHookArgs) -> None:
    """Log the error that ended a thread, which Python would print in many lines."""
    if ended.exc_value is not None and not isinstance(ended.exc_value, SystemExit):
        name = "" if ended.thread is None else ended.thread.name
        _log.error("thread %s ended", name, exc_info=ended.exc_value)
