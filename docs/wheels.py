"""Shows the wheel of every package that the monitor with all its extras needs on 64-bit ARM: ``python docs/wheels.py``.

pip is asked for the locked versions (requirements-dev.txt) and binary wheels only, and installs nothing.  It needs the network.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
import tomllib
from importlib.metadata import requires
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
PLATFORMS = ("manylinux2014_aarch64", "manylinux_2_28_aarch64")


def locked() -> dict[str, str]:
    """Read the versions of the lock: name as in the index -> version."""
    text = (ROOT / "requirements-dev.txt").read_text(encoding="utf-8")
    return {name(found[1]): found[2] for found in re.finditer(r"^([\w.-]+)==(\S+)", text, re.MULTILINE)}


def name(text: str) -> str:
    """Spell a package's name as the index does."""
    return re.sub(r"[-_.]+", "-", text).lower()


def needed(wanted: str, extras: frozenset[str], found: dict[str, str], versions: dict[str, str]) -> None:
    """Collect in `found` what a distribution of this environment requires, and what that requires."""
    for line in requires(wanted) or ():
        one = Requirement(line)
        applies = one.marker is None or any(
            one.marker.evaluate({"extra": extra, "platform_machine": "aarch64"}) for extra in extras or {""}
        )
        key = name(one.name)
        if applies and key != "shm-monitor" and key not in found:
            found[key] = versions[key]
            needed(one.name, frozenset(one.extras), found, versions)


def main() -> int:
    """Print the wheel of each package, and which packages have none; return 1 if there are such."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    found: dict[str, str] = {}
    versions = locked()
    optional = project["optional-dependencies"]
    for line in [
        *project["dependencies"],
        *(line for name, lines in optional.items() if name != "all" for line in lines),
    ]:
        one = Requirement(line)
        found[name(one.name)] = versions[name(one.name)]
        needed(one.name, frozenset(one.extras), found, versions)
    wheels, without = ask(found)
    print("\n".join(wheels))
    print(
        f"{len(wheels)} packages have a wheel for aarch64 or for every machine; without: {', '.join(without) or 'none'}"
    )
    return 1 if without else 0


def ask(wanted: dict[str, str]) -> tuple[list[str], list[str]]:
    """Ask pip for the wheels of packages (name -> version); return their file names, and the packages that have none."""
    without: list[str] = []
    while True:
        with tempfile.TemporaryDirectory() as folder:
            report = Path(folder, "report.json")
            command = [
                sys.executable,
                "-m",
                "pip",
                "install",
                "--quiet",
                "--dry-run",
                "--no-deps",
                "--only-binary=:all:",
            ]
            command += [f"--platform={platform}" for platform in PLATFORMS]
            command += ["--python-version=3.11", "--target", folder, "--report", str(report)]
            command += [f"{key}=={value}" for key, value in sorted(wanted.items()) if key not in without]
            done = subprocess.run(command, check=False, capture_output=True, text=True)
            if not done.returncode:
                return sorted(
                    Path(i["download_info"]["url"]).name for i in json.loads(report.read_text())["install"]
                ), without
        missing = re.search(r"No matching distribution found for ([\w.-]+)==", done.stderr)
        if missing is None:
            raise SystemExit(done.stderr)
        without.append(name(missing[1]))


if __name__ == "__main__":
    sys.exit(main())
