"""Prints the sizes and times of docs/install.md: ``python docs/sizes.py``.

It installs the core, then the viewer, in out/sizes, and so needs the network.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).parents[1]
OUT = ROOT / "out" / "sizes"
_ROUNDS = 5


def main() -> None:
    """Install and measure."""
    shutil.rmtree(OUT, ignore_errors=True)
    OUT.mkdir(parents=True)
    run("wheel", "build", "--no-isolation", "--wheel", "--outdir", str(OUT), str(ROOT), python=sys.executable)
    (wheel,) = OUT.glob("*.whl")
    print(f"wheel {wheel.stat().st_size / 1e6:.2f} MB")
    python = str(OUT / "env/bin/python")
    subprocess.run([sys.executable, "-m", "venv", str(OUT / "env")], check=True)
    versions = OUT / "versions.txt"  # of the lock, without its hashes
    lock = (ROOT / "requirements.txt").read_text(encoding="utf-8")
    versions.write_text("\n".join(re.findall(r"^[\w.\[\]-]+==[^\s\\\\]+", lock, re.MULTILINE)))
    run("core", "pip", "install", "--quiet", "-c", str(versions), str(wheel), python=python)
    run(
        "viewer",
        "pip",
        "install",
        "--quiet",
        "-c",
        str(versions),
        f"{wheel}[viewer]",
        "setuptools",
        "wheel",
        python=python,
    )
    for what, code in (
        ("shm-monitor --version", "import sys; sys.argv[1:] = ['--version']; from monitor.cli import main; main()"),
        ("import shm_monitor", "import shm_monitor"),
    ):
        taken = []
        for _ in range(_ROUNDS):
            started = time.perf_counter()
            subprocess.run([python, "-c", code], check=True, capture_output=True, cwd=OUT)
            taken.append(time.perf_counter() - started)
        print(f"{what}: {min(taken):.2f} s, the fastest of {_ROUNDS}")
    print(
        subprocess.run([python, "-c", _IDENTIFY], check=True, capture_output=True, text=True, cwd=ROOT).stdout, end=""
    )


_IDENTIFY = """
import time
import shm_monitor as shm
record = shm.read("recordings/frame-before.mcap")
for what, given in (("without a structure", []), ("with one", [shm.structure("recordings/frame.toml")])):
    for _ in range(5):
        started = time.process_time()
        shm.identify(record.samples, record.rate_hz, *given)
        taken = time.process_time() - started
    size = f"{record.duration_s:g} s of {len(record.channels)} channels"
    print(f"identify, {size}, {what}: {1000 * taken:.0f} ms of CPU, the fifth call")
"""


def run(what: str, *arguments: str, python: str) -> None:
    """Run a module, and print the size of the environment after an installation."""
    subprocess.run([python, "-m", *arguments], check=True, stdout=subprocess.DEVNULL)
    if "pip" in arguments:
        size = subprocess.run(
            ["du", "-sm", str(OUT / "env")], check=True, capture_output=True, text=True
        ).stdout.split()[0]
        print(f"{what}: {size} MB")


if __name__ == "__main__":
    main()
