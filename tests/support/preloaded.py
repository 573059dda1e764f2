"""What a process has done already when it is forked: see `tests.support.forked`."""

from __future__ import annotations

from threadpoolctl import threadpool_limits

import monitor.cli.host
import monitor.cli.run
import tests.support.live_site  # noqa: F401
from monitor.runs import warm_up

with threadpool_limits(limits=1):
    warm_up()
