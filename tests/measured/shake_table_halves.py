"""Fit a shake-table frame to one half of its recording, and judge on the other half what it predicts.

    .venv/bin/python -m tests.measured.shake_table_halves [--frames flexible,stiff] [--halves 1,2] [--out FOLDER]

A row for each half that is fitted: what ``diagnose`` names, then log score a sample and error of the cross-spectra of the
other half, for the drawing and for the updated and the extended structure file that ``diagnose`` wrote.  On the other half
``evaluate`` fits nothing but the level of the excitation and the noise.  A fit takes minutes; one whose files are in FOLDER is
not repeated.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

from drivers.mcap_writer import McapWriter
from tests.measured.sensor_faults import FRAMES, RECORDINGS, halves

FILES = ("structure.updated.toml", "structure.extended.toml")


def monitor(*arguments: object) -> str:
    """Run a command of the monitor; return what it prints."""
    command = [sys.executable, "-m", "monitor", *map(str, arguments)]
    return subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout


def recorded(frame: str, half: int, out: Path) -> Path:
    """Write one half of a frame's recording, counted from 1."""
    of, path = halves(frame)[half - 1], out / f"{frame}-{half}.mcap"
    with McapWriter(path) as writer:
        for block in of.blocks(of.floors):
            writer.write(block)
    return path


def judge(frame: str, half: int, out: Path) -> str:
    """Fit one half and judge the other; return both as a row of a table."""
    drawing, fitted = RECORDINGS / f"mini-shake-table-{frame}.toml", out / f"{frame}-fitted-{half}"
    if not (fitted / FILES[-1]).exists():
        monitor("diagnose", recorded(frame, half, out), "--structure", drawing, "--out", fitted)
    found = json.loads((fitted / "diagnosis.json").read_text())
    other = recorded(frame, 3 - half, out)
    cells = [frame, str(half), found["verdict"], "; ".join(cause["says"] for cause in found["causes"]) or "-"]
    cells += [scores(other, file) for file in (drawing, *(fitted / name for name in FILES))]
    return f"| {' | '.join(cells)} |"


def scores(recording: Path, structure: Path) -> str:
    """Score a structure file on a recording, as text; a file that is refused, which the command explains, has no scores."""
    try:
        score = json.loads(monitor("evaluate", recording, "--structure", structure))
    except subprocess.CalledProcessError as error:
        return f"refused, exit {error.returncode}"
    return f"{score['log_score_per_sample']:.3f}, {score['csd_error']:.4f}"


def main() -> None:
    """Print a row for each half that is fitted."""
    parser = argparse.ArgumentParser(prog="python -m tests.measured.shake_table_halves", description=__doc__)
    parser.add_argument("--frames", default=",".join(FRAMES))
    parser.add_argument("--halves", default="1,2")
    parser.add_argument("--out", type=Path, default=Path("out/halves"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    print("| frame | fitted half | verdict | causes | drawing | updated | extended |\n|---|---|---|---|---|---|---|")
    for frame in options.frames.split(","):
        for half in map(int, options.halves.split(",")):
            print(judge(frame, half, options.out), flush=True)


if __name__ == "__main__":
    main()
