"""Commands over many sites: host, dataset."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from monitor.cli.common import Json, address, say


def host(
    places: Annotated[
        list[Path],
        typer.Argument(
            metavar="SITE.toml...|DIR",
            help="Site files; or a folder, of which each *.toml is a site while it is there.",
        ),
    ],
    workers: Annotated[
        int, typer.Option(min=1, max=256, help="Processes over which the sites are spread: one a core at most.")
    ] = 1,
    metrics: Annotated[
        str | None,
        typer.Option(metavar="HOST:PORT", help="Answer Prometheus here for all sites, as 127.0.0.1:9464."),
    ] = None,
) -> None:
    """Monitor many sites in one process, each as `run` would.

    Fills each site's [output] dir.  A site that cannot start or fails is told by its name and tried again; the others run on.
    Prints READY on standard error when every site's source is open or it was told why not.  Ends on SIGTERM; or, of files alone,
    when all sources have ended.  Exit code 78 at once if files alone are named and every one of them is bad.
    """
    from monitor.config import LogSettings
    from monitor.core import MissingInputError
    from monitor.service import Host, HostWorkers, logs

    for place in places:
        if not place.exists():
            raise MissingInputError(f"{place}: there is no such file or folder")
    served = address(metrics, "--metrics", any_port=True)
    _demand_a_good_file(places)
    logs.begin(LogSettings(), "host")
    service = Host(places, served) if workers == 1 else HostWorkers(places, workers, served)
    service.run()


def _demand_a_good_file(places: list[Path]) -> None:
    """Refuse to start where no site could: files alone are named, and every one of them is a bad configuration.

    Raises
    ------
    BadConfigurationError
        The message lists the problems of all files.
    """
    from monitor.config import configuration
    from monitor.core import BadConfigurationError, UserError

    problems = []
    for place in places:
        if place.is_dir():  # good files may come
            return
        try:
            configuration.load(place)
        except BadConfigurationError as error:
            problems.append(str(error))
        except UserError:  # what cannot be read may be readable later; the host tries again
            return
        else:
            return
    raise BadConfigurationError("\n".join(problems))


def dataset(
    places: Annotated[
        list[Path], typer.Argument(metavar="SITE.toml...|DIR", help="Site files; or folders of them, as of 'host'.")
    ],
    out: Annotated[Path, typer.Option(metavar="DATASET", help="Folder of the dataset; months that stand are kept.")],
    as_json: Json = False,
) -> None:
    """Write the results of many sites as a Parquet dataset.

    It is partitioned by site and month.

    The sites may be running.  Times of day are UTC; the columns are those of 'reprocess'.
    """
    from monitor.core import MissingInputError
    from monitor.service import dataset as datasets

    for place in places:
        if not place.exists():
            raise MissingInputError(f"{place}: there is no such file or folder")
    written = datasets.write_dataset(datasets.site_folders(places), out)
    windows = sum(written.values())
    say(f"{out}: {windows} windows of {len(written)} sites", {"out": str(out), "windows": written}, as_json)
