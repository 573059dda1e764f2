"""Open the Rerun viewer of a site, for a replay and for the daemon."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from monitor.config import Configuration
from monitor.core import missing_extra
from monitor.damage import AnyBaseline
from monitor.publish import RerunPublisher, Scene, make_scene


def open_viewer(
    config: Configuration,
    baseline: AnyBaseline | None,
    *,
    file: Path | None,
    serve: tuple[str, int] | None,
    lossless: bool,
    on_warning: Callable[[str], None],
) -> RerunPublisher | None:
    """Open a publisher that draws the results of a site (`open_view`).

    The viewer shows the model and the frequencies of the baseline; by default those of the structure file, if it has a model.
    """
    scene = make_scene(config, baseline)
    return open_view(scene, file=file, serve=serve, lossless=lossless, on_warning=on_warning)


def open_view(
    scene: Scene,
    *,
    file: Path | None,
    serve: tuple[str, int] | None = None,
    lossless: bool = True,
    on_warning: Callable[[str], None],
) -> RerunPublisher | None:
    """Open a publisher that draws results with Rerun; keywords as of `monitor.publish.RerunPublisher`.

    Without the extra `viewer` there is none, as `on_warning` is told in one line, and an earlier `file` is removed, for it
    would be taken for this run's.
    """
    if (missing := missing_extra("viewer")) is not None:
        if file is not None:
            file.unlink(missing_ok=True)
        on_warning(f"{'[output] serve' if file is None else file.name} is left out: it {missing}")
        return None
    return RerunPublisher(scene, file=file, serve=serve, lossless=lossless)


def close_view(view: RerunPublisher | None, file: Path, on_warning: Callable[[str], None]) -> None:
    """Finish the file of a view, where there is one, and tell why it was not written."""
    if view is None:
        return
    view.close(timeout_s=120.0)
    if view.failed is not None:
        on_warning(f"{file} was not written: {view.failed}")
