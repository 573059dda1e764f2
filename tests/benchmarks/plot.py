"""Costs of a hop beside its peers, and how it grows, as one SVG."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot


def draw(told: dict[str, Any], out: Path) -> None:
    """Draw what `speed.py --json` keeps."""
    growth: dict[str, list[list[float]]] = told["growth_ms"]
    matplotlib.rcParams.update({"svg.hashsalt": "shm", "font.size": 9})
    figure, axes = pyplot.subplots(1, 1 + len(growth), figsize=(15, 3.6), width_ratios=[2.4, *[1] * len(growth)])
    names, values = list(told["windows_ms"]), list(told["windows_ms"].values())
    colours = ["#1f6fb4" if name.startswith(("hop", "its")) else "#999999" for name in names]
    axes[0].barh(names[::-1], values[::-1], color=colours[::-1])
    axes[0].set(xscale="log", xlabel="CPU ms", title="one hop of a 400 s window")
    for axis, (what, points) in zip(axes[1:], growth.items(), strict=True):
        axis.loglog(*zip(*points, strict=True), "o-", color="#1f6fb4")
        axis.set(xlabel=what, ylim=(1, 2e4), title="CPU ms of one hop")
    figure.tight_layout()
    figure.savefig(out, metadata={"Date": None})
