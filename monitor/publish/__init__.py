"""Publishers: everything that shows or stores results.  Their failure never stops the monitor."""

import os

# The files have no index on purpose (`rerun_queue`), which Rerun would warn of; it reads this when it is first imported.
os.environ.setdefault("RUST_LOG", "warn,re_log_encoding::rrd::file_sink=error")
