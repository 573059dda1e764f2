"""Commands over many sites: host, dataset."""

from __future__ import annotations

import re
from itertools import takewhile
from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from monitor.cli.common import Json, address, say
from monitor.cli.progress import progress
from monitor.core import BadConfigurationError, MissingInputError, UserError, WrongUsageError, demand_file


def host(
    places: Annotated[
        list[Path],
        Argument(
            metavar="SITE.toml...|DIR",
            help="Site files; or a folder, of which each *.toml is a site while it is there.",
        ),
    ],
    workers: Annotated[
        int, Option(min=1, max=256, help="Processes over which the sites are spread: one a core at most.")
    ] = 1,
    metrics: Annotated[
        str | None, Option(metavar="HOST:PORT", help="Answer Prometheus here for all sites, as 127.0.0.1:9464.")
    ] = None,
    standby: Annotated[
        bool, Option("--standby", help="Take over sites whose [output] dir another daemon fills when that one is gone.")
    ] = False,
    share: Annotated[
        str,
        Option(metavar="K/N", help="With --standby: this machine, the K-th of N, takes its share of the sites first."),
    ] = "1/1",
) -> None:
    """Monitor many sites in one process, each as `run` would.

    Fills each site's [output] dir.  A site that cannot start or fails is told by its name and tried again; the others run on.
    Prints READY on standard error when every site's source is open or it was told why not.  Ends on SIGTERM; or, of files alone,
    when all sources have ended.  Exit code 78 at once if files alone are named and every one of them is bad.
    """
    from monitor.config import LogSettings
    from monitor.service import Host, HostWorkers, Policy, is_of_share, logs

    _demand_places(places)
    served = address(metrics, "--metrics", any_port=True)
    number, count = _share(share, standby=standby)
    _demand_a_good_file(places)
    logs.begin(LogSettings(), "host")
    if workers == 1:
        Host(places, Policy(standby=standby, first=lambda path: is_of_share(path, number, count)), served).run()
    else:
        HostWorkers(places, workers, served, standby=standby, share=(number, count)).run()


def _demand_places(places: list[Path]) -> None:
    for place in places:
        if not place.exists():
            raise MissingInputError(f"{place}: there is no such file or folder")
        demand_file(place)


def _share(text: str, *, standby: bool) -> tuple[int, int]:
    """Read K/N."""
    found = re.fullmatch(r"([1-9]\d{0,3})/([1-9]\d{0,3})", text)
    if found is None or int(found[1]) > int(found[2]):
        raise WrongUsageError(f"--share {text}: give it as 1/2, the first of two machines")
    if int(found[2]) > 1 and not standby:
        raise WrongUsageError(f"--share {text}: needs --standby, else nobody takes the other shares")
    return int(found[1]), int(found[2])


def _demand_a_good_file(places: list[Path]) -> None:
    """Refuse to start where no site could: files alone are named, and every one of them is a bad configuration."""
    problems = list(takewhile(bool, map(_problem, places)))
    if len(problems) == len(places):
        raise BadConfigurationError("\n".join(problems))


def _problem(place: Path) -> str:
    """Return what is wrong with a site file; empty for a folder, to which good files may come, or what may be readable later."""
    from monitor.config import configuration

    try:
        if not place.is_dir():
            configuration.load(place)
    except UserError as error:
        return str(error) if isinstance(error, BadConfigurationError) else ""
    return ""


def dataset(
    places: Annotated[
        list[Path], Argument(metavar="SITE.toml...|DIR", help="Site files; or folders of them, as of 'host'.")
    ],
    out: Annotated[Path, Option(metavar="DATASET", help="Folder of the dataset; months that stand are kept.")],
    as_json: Json = False,
) -> None:
    """Write the results of many sites as a Parquet dataset.

    It is partitioned by site and month.

    The sites may be running.  Times of day are UTC; the columns are those of 'reprocess'.
    """
    from monitor.service import dataset as datasets

    _demand_places(places)
    with progress("dataset", "writes the dataset"):
        written = datasets.write_dataset(datasets.site_folders(places), out)
    windows = sum(written.values())
    say(f"{out}: {windows} windows of {len(written)} sites", {"out": str(out), "windows": written}, as_json)
