"""One service a site, after the form of compose.yaml: ``python compose.py sites/*/ > fleet.yaml``."""

from __future__ import annotations

import re
import sys
from pathlib import Path


def composed(template: str, names: list[str]) -> str:
    """The template with these sites in place of its examples.

    Raises
    ------
    ValueError
        If a name is none that a service may have.
    """
    for name in names:
        if not re.fullmatch(r"[a-z0-9][a-z0-9_.-]*", name) or name == "router":
            raise ValueError(f"{name!r}: a site's folder is named with small letters, digits, '-', '_' and '.'")
    head, _, _ = template.partition("  frame-1:\n    <<")
    services = "".join(
        f'  {name}:\n    <<: *monitor\n    volumes: ["./sites/{name}:/site:ro", "{name}:/var/lib/shm-monitor"]\n'
        for name in names
    )
    return head + services + "\nvolumes:\n" + "".join(f"  {name}:\n" for name in names)


if __name__ == "__main__":
    sites = [Path(folder).name for folder in sys.argv[1:]]
    try:
        print(composed((Path(__file__).parent / "compose.yaml").read_text(), sites), end="")
    except ValueError as error:
        sys.exit(f"error: {error}")
