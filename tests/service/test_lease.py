"""The right to write a site, by its folder or its copy: of two who ask one has it, and who has lost it hears so."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from monitor.core import InUseError, MissingInputError
from monitor.service.lease import FolderLease, Lease
from tests.support.bucket import Bucket, Clock, Machine

Leases = Callable[[str], Lease]


@pytest.fixture(params=["folder", "store"])
def lease(request: pytest.FixtureRequest, tmp_path: Path) -> Leases:
    """Makes a lease of a machine: of the folder that both have, or of a bucket beside folders of their own."""
    bucket, clock = Bucket(), Clock()
    if request.param == "folder":
        return lambda machine: FolderLease(tmp_path / "out")
    return lambda machine: Machine(tmp_path / machine, bucket, clock).store.lease


def test_of_two_who_ask_one_has_it_until_it_lets_it_go(lease: Leases) -> None:
    first, second = lease("a"), lease("b")
    first.acquire()
    with pytest.raises(InUseError):
        second.acquire()
    first.renew()
    first.release()
    second.acquire()
    second.renew()
    second.release()


def test_a_folder_that_was_made_anew_or_removed_is_another_one_s(tmp_path: Path) -> None:
    first, second = FolderLease(tmp_path / "out"), FolderLease(tmp_path / "out")
    first.acquire()
    shutil.rmtree(tmp_path / "out")
    with pytest.raises(MissingInputError, match="was removed while a daemon wrote here"):
        first.renew()
    second.acquire()
    second.renew()
    with pytest.raises(InUseError, match="was removed and made anew"):
        first.renew()
    first.release()
    second.renew()
    second.release()


def test_a_folder_of_hard_links_is_the_same_folder(tmp_path: Path) -> None:
    first, second = FolderLease(tmp_path / "a"), FolderLease(tmp_path / "b")
    first.acquire()
    (tmp_path / "b" / "state").mkdir(parents=True)
    (tmp_path / "b" / "state" / "lock").hardlink_to(tmp_path / "a" / "state" / "lock")
    with pytest.raises(InUseError, match="another daemon writes here"):
        second.acquire()
    first.release()
    second.acquire()
    second.release()
