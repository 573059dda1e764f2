"""What a process has done already when it is forked: see `tests.support.forked`."""

from __future__ import annotations

from threadpoolctl import threadpool_limits

from monitor.cli import command_line
from monitor.runs import warm_up
from tests.support import live_site

LOADED = command_line(), live_site

with threadpool_limits(limits=1):
    warm_up()
