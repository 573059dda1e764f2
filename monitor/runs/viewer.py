"""Open the Rerun viewer of a site, for a replay and for the daemon."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from monitor.config import Configuration
from monitor.core import missing_extra
from monitor.damage import Baseline
from monitor.publish import RerunPublisher, make_scene


def open_viewer(
    config: Configuration,
    baseline: Baseline | None,
    *,
    file: Path | None,
    serve: tuple[str, int] | None,
    lossless: bool,
    on_warning: Callable[[str], None],
) -> RerunPublisher | None:
    """Open a publisher that draws the results of a site with Rerun.

    Parameters
    ----------
    config : Configuration
        Settings of the site.
    baseline : Baseline, optional
        Reference whose model and frequencies the viewer shows; by default the model of the structure file.
    file, serve, lossless
        As of `monitor.publish.RerunPublisher`.
    on_warning : callable
        Is told in one line where the extra `viewer` is not installed.

    Returns
    -------
    RerunPublisher or None
        None without that extra; an earlier `file` is removed, for it would be taken for this run's.
    """
    if (missing := missing_extra("viewer")) is not None:
        if file is not None:
            file.unlink(missing_ok=True)
        on_warning(f"{'[output] serve' if file is None else file.name} is left out: it {missing}")
        return None
    scene = make_scene(
        config.site.name or config.structure.name or "structure",
        config.drawing,
        config.story_names,
        {sensor.channel: sensor.floor for sensor in config.sensors},
        config.model(),
        baseline,
        alarm_loss=config.alarm.alarm_loss,
        cutoff_hz=config.processing.cutoff_hz,
        misfit_threshold=config.watch.misfit,
        max_modes=config.selection.max_modes,
    )
    return RerunPublisher(scene, file=file, serve=serve, lossless=lossless)
