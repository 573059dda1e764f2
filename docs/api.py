"""docs/api.py DIR: the API reference from docstrings, one page a module, without addresses of other hosts in what is ours."""

from __future__ import annotations

import sys
import warnings
from pathlib import Path

import pdoc
import pdoc.render


def main() -> None:
    """Write it."""
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    # Inherited annotations are resolved where they are shown, not where they are written; their text stands all the same.
    warnings.filterwarnings("ignore", message="Error parsing type annotation")
    pdoc.render.configure(docformat="numpy", footer_text="shm-monitor", search=True)
    root = Path(__file__).parents[1]
    files = (
        path.relative_to(root).with_suffix("")
        for name in ("monitor", "drivers")
        for path in (root / name).rglob("*.py")
    )
    modules = {".".join(path.parts).removesuffix(".__init__") for path in files}
    pdoc.pdoc(*sorted(modules - {"monitor.__main__"}), output_directory=Path(sys.argv[1]))


if __name__ == "__main__":
    main()
