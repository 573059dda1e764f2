"""What a command loads before it answers: the libraries that take long are loaded by the commands that need them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

_ASK = """
import sys
sys.argv[0] = "shm-monitor"
{do}
print("loaded:", *(name for name in {names!r} if name in sys.modules))
"""
_RUN = "from monitor.cli import main\ntry:\n    main()\nexcept SystemExit as end:\n    assert not end.code, end.code"
_SLOW = (
    "scipy.stats",
    "scipy.signal",
    "scipy.optimize",
    "numba",
    "pyarrow",
    "pandas",
    "rerun",
    "matplotlib",
    "apprise",
    "can",
    "cantools",
)
"""Each takes a tenth of a second to more than a second to load."""


def loaded(do: str, names: tuple[str, ...], *arguments: str) -> list[str]:
    """Return the modules of `names` that a new process has loaded after it did so."""
    code = _ASK.format(do=do, names=names)
    run = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=True)
    return run.stdout.splitlines()[-1].split()[1:]


def test_what_needs_no_computation_loads_no_library_for_it() -> None:
    for argument in ("--version", "--help"):
        assert loaded(_RUN, ("numpy", "scipy", "pydantic", *_SLOW), argument) == [], argument


def test_check_loads_only_what_reads_a_file_and_computes_modes() -> None:
    assert loaded(_RUN, ("urllib.request", *_SLOW), "check", "recordings/frame.toml") == []


def test_a_daemon_without_metrics_and_page_loads_no_server() -> None:
    do = "from monitor.service import Host, outlets\nassert Host and outlets.outlet_of('metrics')"
    assert loaded(do, ("uvicorn", "h11", "starlette")) == []


def test_a_replay_asks_for_its_viewer_without_waiting_for_rerun() -> None:
    assert loaded("from monitor.runs import replay, viewer", _SLOW) == []


_FIRST_WINDOW = (
    """
from monitor.publish import LinesFile
def write(self, line):
    raise SystemExit
LinesFile.write = write
"""
    + _RUN
)


def test_the_first_window_of_a_replay_waits_for_no_library_that_it_does_not_need(tmp_path: Path) -> None:
    recording = "recordings/mini-shake-table-flexible"
    arguments = ("replay", f"{recording}.mcap", "--structure", f"{recording}.toml", "--out", str(tmp_path))
    assert loaded(_FIRST_WINDOW, _SLOW, *arguments) == ["scipy.optimize", "numba"]
