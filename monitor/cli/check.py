"""Command `check`."""

from __future__ import annotations

from collections import defaultdict
from contextlib import closing
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument

from monitor.cli.common import Json, say, warn

if TYPE_CHECKING:
    from monitor.config import Configuration


def check(
    file: Annotated[Path, Argument(metavar="FILE.toml", help="Structure file, site file or fleet file.")],
    as_json: Json = False,
) -> None:
    """List every problem of a file at once.  The file is a structure file, a site file or a fleet file."""
    from monitor.config import configuration, security_check

    if "fleet" in configuration.read_toml(file):
        from monitor.service import fleet

        sites = fleet.load(file).sites
        say(
            f"{file}: no problems; sites {', '.join(sites) or 'none named'}",
            {"file": str(file), "sites": sites},
            as_json,
        )
        return
    from monitor.damage import what_sensors_see
    from monitor.identification import stabilization
    from monitor.runs import load_healthy
    from monitor.service import outlets

    settings = configuration.load(file)
    if settings.site.baseline is not None:
        baseline = file.parent / settings.site.baseline
        if baseline.exists():
            for doubt in load_healthy(baseline, settings).doubts:
                warn(doubt)
        else:
            warn(f"{baseline}: there is no such baseline yet; make it with 'calibrate'")
    outlets.make_outlets(file, settings, dry=True)
    _demand_recordings(file, settings)
    _warn_of_shared_floors(settings)
    for warning in security_check.warnings(file, settings):
        warn(warning)
    head = f"{file}: no problems; {settings.size_words}; channels {', '.join(settings.channels)}"
    witnesses = [sensor.channel for sensor in settings.witnesses]
    head += f"; witnesses {', '.join(witnesses)}" if witnesses else ""
    content = {"file": str(file), "channels": list(settings.channels), "witnesses": witnesses}
    if not settings.has_model:
        say(head, {**content, "frequencies_hz": []}, as_json)
        return
    modes, p = settings.model().modes(), settings.processing
    frequencies = modes.frequencies_hz
    text = f"{head}\nnatural frequencies: {', '.join(f'{f:.4g}' for f in frequencies)} Hz"
    content["frequencies_hz"] = frequencies.tolist()
    if settings.storeys:
        wanted = stabilization.expected_modes(modes, p.cutoff_hz, settings.selection)
        content["seen"] = what_sensors_see(settings.instrumented(), wanted, settings.story_names, p.window_s)
        head = f"what the sensors will see of a loss of 10 %, in eight windows of {p.window_s:g} s:"
        text += "".join(f"\n{says}" for says in (head, *content["seen"]))
    say(text, content, as_json)
    beyond = [f"{f:.4g}" for f in frequencies if f > p.cutoff_hz]
    if beyond:
        warn(f"modes at {', '.join(beyond)} Hz lie beyond cutoff_hz = {p.cutoff_hz:g}")
    if lags := stabilization.advice(modes, p.rate_hz, p.cutoff_hz, settings.identification, settings.selection):
        warn(lags)


def _demand_recordings(file: Path, settings: Configuration) -> None:
    """Check that the recordings of a ``[source]`` exist and can be read."""
    from drivers.base import SourceContext
    from monitor.config import configuration
    from monitor.core import read_by_user

    if settings.source is None or settings.source["kind"] != "mcap":  # the other sources wait for what comes
        return
    source = configuration.make_source(settings.source, SourceContext(settings.channels, file.parent))
    with read_by_user(f"{file}: source.files: "), closing(source):
        source.open()


def _warn_of_shared_floors(settings: Configuration) -> None:
    """Warn of sensors on the same floor, of which one may have been meant for another."""
    on: dict[tuple[int, str], list[str]] = defaultdict(list)
    for sensor in settings.sensors:
        if sensor.floor is not None:
            place = f"{sensor.along}, {sensor.position_m}" if settings.storeys else ""
            on[sensor.floor, place].append(sensor.channel)
            sides = settings.storeys[sensor.floor - 1].plan_m if settings.storeys and sensor.floor else (inf, inf)
            if any(2.0 * abs(at) > side for at, side in zip(sensor.position_m, sides, strict=True)):
                warn(f"sensors: {sensor.channel} is outside the plan of floor {sensor.floor}")
    for (floor, _), channels in sorted(on.items()):
        if len(channels) > 1:
            warn(
                f"sensors: {', '.join(channels)} are on the same floor {floor}: right if they measure its motion twice, in the "
                "same direction"
            )
