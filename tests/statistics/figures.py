"""Figures of the campaigns, each written as soon as it is drawn."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

RED, BLUE, GREEN, GREY = "#c0392b", "#1f6fb4", "#2a8a4a", "#777777"


@contextmanager
def figure(path: Path, panels: int = 1, size: tuple[float, float] = (8.0, 4.0)) -> Iterator[list[Any]]:
    """Axes one below another, with the names of their lines, as SVG or PNG."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    matplotlib.rcParams.update({"svg.hashsalt": "shm", "font.size": 9})
    made, axes = pyplot.subplots(panels, 1, figsize=size, squeeze=False, sharex=panels > 1)
    yield list(axes[:, 0])
    for one in axes[:, 0]:
        one.grid(color="#dddddd")
        one.legend(loc="best")
    made.tight_layout()
    made.savefig(path, metadata={"Date": None} if path.suffix == ".svg" else None)
    pyplot.close(made)
