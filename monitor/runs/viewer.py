"""Open the Rerun viewer of a site, for a replay and for the daemon."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from monitor.config import Configuration
from monitor.core import missing_extra
from monitor.damage import AnyBaseline, Baseline, ModalBaseline
from monitor.publish import RerunPublisher, make_modal_scene, make_scene


def open_viewer(
    config: Configuration,
    baseline: AnyBaseline | None,
    *,
    file: Path | None,
    serve: tuple[str, int] | None,
    lossless: bool,
    on_warning: Callable[[str], None],
) -> RerunPublisher | None:
    """Open a publisher that draws the results of a site with Rerun; keywords as of `monitor.publish.RerunPublisher`.

    The viewer shows the model and the frequencies of the baseline; by default those of the structure file, if it has a model.
    Without the extra `viewer` there is none, as `on_warning` is told in one line, and an earlier `file` is removed, for it
    would be taken for this run's.
    """
    if (missing := missing_extra("viewer")) is not None:
        if file is not None:
            file.unlink(missing_ok=True)
        on_warning(f"{'[output] serve' if file is None else file.name} is left out: it {missing}")
        return None
    if isinstance(baseline, ModalBaseline) or not config.has_model:
        assert not isinstance(baseline, Baseline)
        view = make_modal_scene(
            config.site.name or config.structure.name or "structure",
            config.drawing,
            config.channels,
            baseline,
            alarm_loss=config.alarm.alarm_loss,
            cutoff_hz=config.processing.cutoff_hz,
            max_modes=config.selection.max_modes,
        )
        return RerunPublisher(view, file=file, serve=serve, lossless=lossless)
    scene = make_scene(
        config.site.name or config.structure.name or "structure",
        config.drawing,
        config.story_names,
        {sensor.channel: sensor.floor for sensor in config.floor_sensors if sensor.floor is not None},
        config.model(),
        baseline,
        alarm_loss=config.alarm.alarm_loss,
        cutoff_hz=config.processing.cutoff_hz,
        misfit_threshold=config.watch.misfit,
        max_modes=config.selection.max_modes,
    )
    return RerunPublisher(scene, file=file, serve=serve, lossless=lossless)
