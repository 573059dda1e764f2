"""Output for people and other programs: result lines, the viewer, the reports."""

import os

import lazy_loader

# The viewer's files have no index on purpose (`publish.viewer.output`).  Rerun warns of a file without an index unless this
# variable says otherwise when Rerun is first imported.
os.environ.setdefault("RUST_LOG", "warn,re_log_encoding::rrd::file_sink=error")

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
