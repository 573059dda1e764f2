"""Demonstration of `make demo`: calibrates, replays a damage that appears, and replays a measured frame."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from textwrap import indent

from monitor.config import configuration
from monitor.core import MissingInputError, demand_place, missing_extra
from monitor.damage import save_baseline
from monitor.publish import replay_text
from monitor.runs import calibrate, replay


def run(recordings: Path, out: Path, *, say: Callable[[str], None], on_warning: Callable[[str], None]) -> None:
    """Run the demonstration with the shipped recordings, and write its results to the folder `out`.

    Raises MissingInputError or BadInputError if `recordings` does not hold them, or `out` cannot be written.
    """
    if not (recordings / "frame.toml").is_file():
        raise MissingInputError(f"{recordings}: no recordings here; run in the project's folder or give --recordings")
    frame = configuration.load(recordings / "frame.toml")
    demand_place(out / "baseline.json")
    say("1. Calibrating on a healthy recording of a simulated three-story frame whose drawing is wrong on purpose ...")
    healthy, _ = calibrate.calibrate([recordings / "frame-healthy.mcap"], frame, on_warning=on_warning)
    save_baseline(healthy, out / "baseline.json")
    say("2. Replaying 1000 s of it in which story 2 loses 12 % of its stiffness after 400 s ...")
    parts = [recordings / "frame-before.mcap", recordings / "frame-after.mcap"]
    files = (recordings / "frame.toml", out / "baseline.json")
    summary = replay.replay(parts, frame, healthy, out, files=files, on_warning=on_warning)
    say(indent(replay_text(summary), "   "))
    say("3. Replaying a measured frame (mini shake table, an earthquake record played by the table) ...")
    measured = configuration.load(recordings / "mini-shake-table-flexible.toml")
    target = out / "measured-frame"
    summary = replay.replay(
        [recordings / "mini-shake-table-flexible.mcap"], measured, None, target, on_warning=on_warning
    )
    say(indent(replay_text(summary), "   "))
    if missing_extra("viewer") is None:
        say("Look at it:")
        for folder in (out, target):
            say(f"   .venv/bin/shm-monitor view {folder}    (--web for a browser)")
    say(f"Numbers: {out / 'results.jsonl'} (a line a window), {out / 'summary.json'}")
