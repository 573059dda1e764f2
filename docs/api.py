"""docs/api.py DIR [MODULE ...]: the API reference from docstrings, without addresses of other hosts in what is ours.

A page for each module, or only for those that are named.
"""

from __future__ import annotations

import sys
import warnings
from pathlib import Path

import pdoc
import pdoc.render


def modules() -> list[str]:
    """Every module of the program."""
    root = Path(__file__).parents[1]
    files = (path for name in ("monitor", "drivers") for path in (root / name).rglob("*.py"))
    names = {".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__") for path in files}
    return sorted(names - {"monitor.__main__"})


def main() -> None:
    """Write it."""
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    # Inherited annotations are resolved where they are shown, not where they are written; their text stands all the same.
    warnings.filterwarnings("ignore", message="Error parsing type annotation")
    pdoc.render.configure(docformat="numpy", footer_text="shm-monitor", search=True)
    pdoc.pdoc(*(sys.argv[2:] or modules()), output_directory=Path(sys.argv[1]))


if __name__ == "__main__":
    main()
