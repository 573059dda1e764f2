"""What a process has done already when it is forked: see `tests.support.forked`."""

from __future__ import annotations

from threadpoolctl import threadpool_limits

from monitor.cli import app, host, run
from monitor.runs import warm_up
from tests.support import live_site

LOADED = app, host, run, live_site

with threadpool_limits(limits=1):
    warm_up()
