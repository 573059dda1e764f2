"""Copy of a site in object storage: what another machine goes on from, and who may write it, whatever fails meanwhile."""

from __future__ import annotations

import json
import os
import random
import shutil
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from monitor.core import InUseError, MissingInputError
from monitor.service.manifest import Part, StoredFile, without_shorter
from monitor.service.objects import OBJECT_BYTES
from monitor.service.site_store import SiteStore
from tests.service.bucket import MANIFEST, Bucket, Clock, Machine, away, content, copied, exceptions, no_failure
from tests.support.waiting import until


@pytest.fixture
def bucket() -> Bucket:
    return Bucket()


@pytest.fixture
def clock() -> Clock:
    return Clock()


Machines = Callable[..., Machine]


@pytest.fixture
def machine(tmp_path: Path, bucket: Bucket, clock: Clock) -> Machines:
    def on(name: str, *, at_work: bool = False) -> Machine:
        made = Machine(tmp_path / name, bucket, clock)
        return made.open() if at_work else made

    return on


def silent(one: Machine, clock: Clock) -> None:
    """Let the monitor be unheard of for long enough, as another sees it."""
    assert one.store.lease.is_held()
    clock.now_s += 14.0
    assert one.store.lease.is_held()
    clock.now_s += 1.0
    assert not one.store.lease.is_held()


def test_another_machine_goes_on_with_the_same_files(machine: Machines, tmp_path: Path, clock: Clock) -> None:
    a, b = machine("a", at_work=True), machine("b")
    for name, data in {"results.jsonl": b"one\n", "state/checkpoint": b"x" * 99, "recordings/1.mcap.part": b""}.items():
        (tmp_path / "a" / name).parent.mkdir(exist_ok=True)
        (tmp_path / "a" / name).write_bytes(data)
    (tmp_path / "a" / "state" / "history.db").write_bytes(b"stays here")
    a.push()
    assert a.store.failed is None
    with pytest.raises(InUseError, match="is at work"):
        b.open()
    silent(b, clock)
    b.open()
    assert b.content() == a.content() != {}
    assert not (tmp_path / "b" / "state" / "history.db").exists()
    (tmp_path / "b" / "results.jsonl").write_bytes(b"one\ntwo\n")
    b.push()
    (tmp_path / "a" / "results.jsonl").write_bytes(b"one\nalone\n")
    a.push()
    assert a.store.lost is not None and "taken over" in str(a.store.failed)
    b.close()
    a = machine("a", at_work=True)
    assert (tmp_path / "a" / "results.jsonl").read_bytes() == b"one\ntwo\n"
    (aside,) = (tmp_path / "a" / "superseded").iterdir()
    assert content(aside) == {"results.jsonl": b"one\nalone\n"}, "what it alone had is kept"


def test_a_copy_of_the_folder_is_no_right_to_the_site(machine: Machines, tmp_path: Path) -> None:
    a = machine("a", at_work=True)
    (tmp_path / "a" / "results.jsonl").write_bytes(b"one\n")
    a.push()
    copied(tmp_path / "a", tmp_path / "b")
    with pytest.raises(InUseError, match=rf"process {os.getpid()}\) is at work, in another folder"):
        machine("b").open()
    a.push()
    assert a.store.lost is None and a.store.failed is None


def test_of_two_copies_of_a_folder_that_has_left_the_site_one_has_it(machine: Machines, tmp_path: Path) -> None:
    a = machine("a", at_work=True)
    a.close()
    copied(tmp_path / "a", tmp_path / "b")
    first, second = machine("b"), machine("a")
    first.open()
    with pytest.raises(InUseError, match="is at work"):
        second.open()


def test_of_two_copies_that_begin_while_the_storage_is_away_one_ends(
    machine: Machines, tmp_path: Path, bucket: Bucket
) -> None:
    a = machine("a", at_work=True)
    a.close()
    copied(tmp_path / "a", tmp_path / "b")

    bucket.fail = away
    first, second = machine("a"), machine("b")
    first.open()
    second.open()
    bucket.fail = no_failure
    for store in (first, second, first):
        store.push()
    assert first.store.lost is None and first.store.failed is None
    assert second.store.lost is not None and "went on from other files" in str(second.store.failed)


@pytest.mark.parametrize("is_away", [False, True])
@pytest.mark.parametrize("is_same_run", [False, True])
def test_a_folder_restored_from_an_older_copy_deletes_nothing_that_is_newer(
    machine: Machines, tmp_path: Path, bucket: Bucket, clock: Clock, is_same_run: bool, is_away: bool
) -> None:
    """Either the copy was made in the run that then died, or before; the storage may be away when the restored one begins."""
    folder = tmp_path / "a"
    a = machine("a", at_work=True)
    (folder / "results.jsonl").write_bytes(b"one\n")
    a.push()
    copied(folder, tmp_path / "backup")
    if not is_same_run:
        a.close()
        a = machine("a", at_work=True)
    (folder / "results.jsonl").write_bytes(b"one\ntwo\n")
    (folder / "recordings").mkdir()
    (folder / "recordings" / "1.mcap").write_bytes(b"data")
    a.push()
    newest = content(folder)
    copied(tmp_path / "backup", folder)
    if is_away:
        bucket.fail = away
        early = machine("a", at_work=True)
        bucket.fail = no_failure
        early.push()
        assert early.store.lost is not None and "went on from other files" in str(early.store.failed)
    again = machine("a")
    if again.store.lease.is_held():  # a lock that is another file
        clock.now_s += 15.0
    again.open()
    assert content(folder) == newest
    again.push()
    assert again.store.failed is None and content(folder) == newest


def test_the_lease_is_renewed_while_a_file_hangs_and_its_loss_is_heard(
    machine: Machines, tmp_path: Path, clock: Clock
) -> None:
    """A pipe that nobody writes to stands for a file of a disk that hangs."""
    a, b = machine("a", at_work=True), machine("b")
    pipe = tmp_path / "a" / "recordings.mcap"
    os.mkfifo(pipe)
    storing = threading.Thread(target=a.push, daemon=True)
    storing.start()
    for _ in range(8):
        assert b.store.lease.is_held()
        clock.now_s += 5.0
        a.renew()
    assert storing.is_alive() and a.store.lost is None
    assert str(a.store.failed).startswith("does not answer for "), "that nothing is stored is told, and no doubt"
    silent(b, clock)  # its machine was stopped
    b.open()
    a.renew()
    assert a.store.lost is not None and "taken over" in str(a.store.failed)
    with pipe.open("wb"):
        storing.join(10.0)
    assert not storing.is_alive() and b.store.lost is None
    b.push()
    assert b.store.failed is None, "what hung has written nothing beside it"


def test_what_the_lease_hears_of_another_s_manifest_lets_no_writer_over_it(
    machine: Machines, tmp_path: Path, clock: Clock
) -> None:
    """The storing thread is between two calls while the lease's hears that the site was taken over."""
    a, b = machine("a", at_work=True), machine("b")
    (tmp_path / "a" / "results.jsonl").write_bytes(b"one\n")
    silent(b, clock)
    b.open()
    a.renew()
    assert a.store.lost is not None
    a.store.lost = None  # it had asked before
    a.push()
    assert a.store.lost is not None and "taken over" in str(a.store.failed)
    b.renew()
    b.push()
    assert b.store.lost is None and b.store.failed is None


def test_the_lease_has_a_thread_of_its_own(tmp_path: Path, bucket: Bucket) -> None:
    def manifest() -> dict[str, Any]:
        content: dict[str, Any] = json.loads(bucket.objects["tower/manifest.json"])
        return content

    store = SiteStore("s3://bucket", "tower", tmp_path, 0.02, client=lambda: bucket)
    store.open(wait=True)
    pipe = tmp_path / "recordings.mcap"
    os.mkfifo(pipe)
    begun = manifest()["number"]
    until(lambda: manifest()["number"] > begun + 20, "the lease is renewed while the pipe is read")
    assert "recordings.mcap" not in manifest()["files"]
    handle = os.open(pipe, os.O_RDWR)
    pipe.unlink()
    os.close(handle)
    store.close("released", 30.0)
    assert manifest()["state"] == "released"


def test_a_monitor_that_has_left_the_site_says_no_more_that_it_is_at_work(machine: Machines, clock: Clock) -> None:
    a = machine("a", at_work=True)
    a.close()
    clock.now_s += 60.0
    a.renew()
    assert not machine("b").store.lease.is_held()


def test_a_thread_stores_what_has_changed_at_once_where_asked_and_at_the_end(tmp_path: Path, bucket: Bucket) -> None:
    def stored() -> bytes:
        return b"".join(data for key, data in bucket.objects.items() if not key.endswith("manifest.json"))

    store = SiteStore("s3://bucket", "tower", tmp_path, 60.0, client=lambda: bucket)
    store.open(wait=True)
    (tmp_path / "results.jsonl").write_bytes(b"one\n")
    store.settle(60.0)
    assert stored() == b"one\n" and store.failed is None
    bucket.fail = away
    (tmp_path / "results.jsonl").write_bytes(b"one\ntw")
    store.settle(60.0)
    assert store.failed is not None
    store.settle(3600.0)  # waits for nothing
    bucket.fail = no_failure
    (tmp_path / "results.jsonl").write_bytes(b"one\ntwo\n")
    store.close("ended", 60.0)
    assert stored() == b"one\ntwo\n" and store.failed is None
    assert SiteStore("s3://bucket", "tower", tmp_path / "b", 60.0, client=lambda: bucket).lease.has_ended()


def test_a_restart_on_the_same_machine_waits_for_nobody_and_keeps_what_is_newer(
    machine: Machines, tmp_path: Path, bucket: Bucket
) -> None:
    a = machine("a", at_work=True)
    (tmp_path / "a" / "results.jsonl").write_bytes(b"one\n" * 1000)
    a.push()
    with (tmp_path / "a" / "results.jsonl").open("ab") as file:
        file.write(b"two\n")
    again = machine("a", at_work=True)
    before = len(bucket.objects)
    again.push()
    assert a.content() == {"results.jsonl": b"one\n" * 1000 + b"two\n"}
    added = [key for key in bucket.objects if bucket.objects[key] == b"two\n"]
    assert len(bucket.objects) == before + 1 and len(added) == 1, "what was stored is known by its checksum"


def test_a_file_that_grows_is_stored_in_few_parts(
    machine: Machines, tmp_path: Path, bucket: Bucket, clock: Clock
) -> None:
    a, b, sent = machine("a"), machine("b"), 0
    a.open()
    for k in range(256):
        with (tmp_path / "a" / "results.jsonl").open("ab") as file:
            file.write(f"{k:09d}\n".encode())
        bucket.calls.clear()
        a.push()
        assert len(bucket.calls) == 2, "one object with what is new, and the manifest"
        sent += len(bucket.objects[bucket.calls[0]])
    assert len(bucket.objects) <= 1 + 9 and sent <= 2560 * 9
    silent(b, clock)
    b.open()
    assert b.content() == a.content()


def test_while_much_is_stored_or_fetched_the_monitor_is_heard_of(
    machine: Machines, tmp_path: Path, bucket: Bucket, clock: Clock
) -> None:
    heard: list[float] = []

    def slow(call: str, is_done: bool) -> None:
        clock.now_s += 2.0
        if call == "get":
            b.renew()
        if is_done and bucket.calls[-1].endswith("manifest.json"):
            heard.append(clock.now_s)

    a, b = machine("a", at_work=True), machine("b")
    (tmp_path / "a" / "recordings").mkdir()
    (tmp_path / "a" / "recordings" / "1.mcap").write_bytes(bytes(8 * OBJECT_BYTES + 1))
    bucket.fail = slow
    a.close()
    b.open()
    assert len(heard) >= 8 and max(np.diff([0.0, *heard, clock.now_s])) < 15.0, (
        "sooner than another one would take the site"
    )
    assert b.content() == a.content()


def test_a_stored_checkpoint_is_no_newer_than_the_lines_beside_it(machine: Machines, bucket: Bucket) -> None:
    """The monitor writes on while its files are stored."""

    def go_on(call: str, is_done: bool) -> None:
        if call == "put" and is_done:
            bucket.fail = no_failure
            a.write("results.jsonl", b"1\n2\n")
            a.write("state/checkpoint", b"2")

    a, b = machine("a", at_work=True), machine("b")
    for name, data in (("results.jsonl", b"1\n"), ("state/checkpoint", b"1"), ("x.mcap", bytes(OBJECT_BYTES))):
        a.write(name, data)
    bucket.fail = go_on
    a.close()
    found = b.open().content()
    assert int(found["state/checkpoint"]) <= len(found["results.jsonl"].split())


def test_without_the_storage_a_site_goes_on_where_its_files_are(
    machine: Machines, tmp_path: Path, bucket: Bucket
) -> None:
    a, b = machine("a", at_work=True), machine("b")
    (tmp_path / "a" / "results.jsonl").write_bytes(b"one\n")
    a.push()
    bucket.fail = away
    a.write("results.jsonl", b"one\nmore\n")
    a.push()
    assert a.store.failed is not None and "endpoint" in a.store.failed and a.store.lost is None
    assert b.store.lease.is_held(), "nobody knows"
    with pytest.raises(MissingInputError, match=r"s3://bucket/city/tower: .*endpoint"):
        b.open()
    a = machine("a", at_work=True)
    a.push()
    assert a.store.failed is not None and a.store.lost is None
    (tmp_path / "a" / "results.jsonl").write_bytes(b"one\ntwo\n")
    bucket.fail = no_failure
    a.close()
    assert a.store.failed is None
    b.open()
    assert b.content() == {"results.jsonl": b"one\ntwo\n"}


def test_files_that_another_machine_went_on_from_are_not_gone_on_from_where_the_storage_fails(
    machine: Machines, bucket: Bucket
) -> None:
    def refuse(call: str, is_done: bool) -> None:
        if call == "put":
            raise exceptions.EndpointConnectionError(endpoint_url="s3")

    for name in ("a", "b"):
        store = machine(name)
        store.open()
        store.close()
    bucket.fail = refuse
    with pytest.raises(MissingInputError, match="endpoint"):
        machine("a").open()


def test_files_that_are_missing_or_damaged_there_are_told_and_nobody_goes_on_without_them(
    machine: Machines, tmp_path: Path, bucket: Bucket
) -> None:
    a, b = machine("a", at_work=True), machine("b")
    (tmp_path / "a" / "results.jsonl").write_bytes(b"one\n")
    a.close()
    (key,) = (key for key in bucket.objects if not key.endswith("manifest.json"))
    bucket.objects[key] = b"two\n"
    for says in ("not as it was stored", "is missing"):
        with pytest.raises(MissingInputError, match=says):
            b.open()
        assert not (tmp_path / "b" / "state" / "owner").exists()
        assert not machine("c").store.lease.is_held(), "nobody waits for a machine that cannot go on"
        bucket.objects.pop(key, None)
    bucket.objects[MANIFEST] = b"{"
    with pytest.raises(MissingInputError, match=r"manifest.json is damaged"):
        b.open()


@pytest.mark.parametrize("name", ["../x", "/etc/x", "state/lock", "state/owner"])
def test_a_manifest_names_files_of_the_site_alone(machine: Machines, bucket: Bucket, tmp_path: Path, name: str) -> None:
    a, b = machine("a", at_work=True), machine("b")
    (tmp_path / "a" / "results.jsonl").write_bytes(b"one\n")
    a.close()
    place = MANIFEST
    bucket.objects[place] = bucket.objects[place].replace(b"results.jsonl", name.encode())
    with pytest.raises(MissingInputError, match="is no file of a site"):
        b.open()


@pytest.mark.parametrize("seed", [*range(5), *(pytest.param(k, marks=pytest.mark.slow) for k in range(5, 20))])
def test_whatever_fails_a_machine_that_takes_over_has_what_was_stored_last(
    machine: Machines, tmp_path: Path, bucket: Bucket, clock: Clock, seed: int
) -> None:
    """Files grow, are replaced and vanish while every fifth call fails, before or after it took effect."""
    chance = random.Random(seed)

    def sometimes(call: str, is_done: bool) -> None:
        if chance.random() < 0.2:
            raise exceptions.ReadTimeoutError(endpoint_url="s3")

    names = ["a", "b"]
    store = machine(names[0])
    store.open()
    store.push()
    folder = tmp_path / names[0]
    stored: list[dict[str, bytes]] = [content(folder)]
    for _ in range(60):
        path = folder / chance.choice(["results.jsonl", "recordings/1.mcap", "state/checkpoint", "summary.json"])
        path.parent.mkdir(exist_ok=True)
        if path.suffix in {".jsonl", ".mcap"} and chance.random() < 0.8:
            with path.open("ab") as file:
                file.write(chance.randbytes(chance.randrange(1, 200)))
        elif chance.random() < 0.2:
            path.unlink(missing_ok=True)
        else:
            path.with_name("new").write_bytes(chance.randbytes(chance.randrange(200)))
            path.with_name("new").replace(path)
        bucket.fail = sometimes
        store.push()
        store.renew()
        bucket.fail = no_failure
        assert store.store.lost is None
        # A write whose answer was lost may have arrived all the same.
        stored = [content(folder)] if store.store.failed is None else [*stored, content(folder)]
        if chance.random() < 0.1:  # the machine restarts
            store = machine(names[0])
            store.open()
        elif chance.random() < 0.1:  # the machine dies
            names.reverse()
            store, folder = machine(names[0]), tmp_path / names[0]
            silent(store, clock)
            store.open()
            assert content(folder) in stored
            stored = [content(folder)]
    store.push()
    machine(names[0]).open()  # what nothing refers to is removed
    manifest = json.loads(bucket.objects[MANIFEST])
    referred = {part[0] for file in manifest["files"].values() for part in file["parts"]}
    assert {key.rpartition("/")[2] for key in bucket.objects} == {"manifest.json"} | referred


# --- copies, restored parts, clones, and storages that lose or misremember ---------------------------------------------


@pytest.mark.parametrize("is_away", [False, True])
@pytest.mark.parametrize("part", ["recordings", "recordings/1.mcap", "results.jsonl", "findings/page.html", "state"])
def test_a_part_of_a_folder_that_is_restored_deletes_nothing_that_is_newer(
    machine: Machines, tmp_path: Path, bucket: Bucket, clock: Clock, part: str, is_away: bool
) -> None:
    """The rest of the folder is the latest, so that it looks like that of the monitor that wrote last."""
    a = machine("a", at_work=True)
    old = {
        "results.jsonl": b"one\n",
        "recordings/1.mcap": b"da",
        "findings/page.html": b"old",
        "state/checkpoint": b"1",
    }
    new = {"results.jsonl": b"one\ntwo\n", "recordings/1.mcap": b"data", "findings/page.html": b"new page"}
    new |= {"state/checkpoint": b"2", "recordings/2.mcap": b"more"}
    for name, data in old.items():
        a.write(name, data)
        os.utime(a.folder / name, ns=(10**18, 10**18))
    a.push()
    copied(a.folder, tmp_path / "backup")
    for name, data in new.items():
        a.write(name, data)
    a.push()
    newest = a.content()
    source, target = tmp_path / "backup" / part, a.folder / part
    copied(source, target) if source.is_dir() else shutil.copy2(source, target)
    (a.folder / "state" / "lock").touch()
    if is_away:
        bucket.fail = away
        early = machine("a", at_work=True)
        bucket.fail = no_failure
        early.push()
    again = machine("a")
    if again.store.lease.is_held():  # a lock that is another file
        clock.now_s += 15.0
    again.open()
    again.push()
    kept = [again.content(), *map(content, (a.folder / "superseded").glob("*"))]
    for name, data in newest.items():
        assert any(found.get(name) == data for found in kept), name
    if not is_away:
        assert again.content() == newest
    assert again.store.failed is None


def test_a_copy_that_was_made_while_the_storage_failed_is_older_than_what_was_stored_later(
    machine: Machines, tmp_path: Path, bucket: Bucket, clock: Clock
) -> None:
    def refuse_manifest(call: str, is_done: bool) -> None:
        if call == "put" and not is_done and bucket.calls[-1] != MANIFEST:
            raise exceptions.EndpointConnectionError(endpoint_url="s3")

    a = machine("a", at_work=True)
    a.write("state/checkpoint", b"2")
    bucket.fail = refuse_manifest
    a.push()
    copied(a.folder, tmp_path / "backup")
    a.write("state/checkpoint", b"3")
    bucket.fail = no_failure
    a.push()
    copied(tmp_path / "backup", a.folder)
    again = machine("a")
    if again.store.lease.is_held():  # a lock that is another file
        clock.now_s += 15.0
    assert again.open().content() == {"state/checkpoint": b"3"}


def test_a_file_that_was_lost_in_the_storage_as_well_keeps_nobody_from_storing(
    machine: Machines, bucket: Bucket
) -> None:
    a = machine("a", at_work=True)
    a.write("recordings/1.mcap", b"data")
    a.push()
    for name in [name for name in bucket.objects if name != MANIFEST]:
        del bucket.objects[name]
    (a.folder / "recordings" / "1.mcap").unlink()
    again = machine("a", at_work=True)
    again.write("results.jsonl", b"one\n")
    again.push()
    assert again.store.failed is None and again.content() == {"results.jsonl": b"one\n"}


def test_a_recording_that_got_its_name_and_lines_that_got_a_file_of_their_own_are_not_fetched_again(
    machine: Machines,
) -> None:
    a = machine("a", at_work=True)
    a.write("recordings/1.mcap.part", b"data")
    a.write("results.jsonl", b"one\n")
    a.push()
    (a.folder / "recordings" / "1.mcap.part").rename(a.folder / "recordings" / "1.mcap")
    (a.folder / "results.jsonl").rename(a.folder / "results-2026-10.jsonl")
    a.write("results.jsonl", b"")
    again = machine("a", at_work=True)
    assert again.content() == {"recordings/1.mcap": b"data", "results-2026-10.jsonl": b"one\n", "results.jsonl": b""}


@pytest.mark.parametrize("is_away", [False, True])
@pytest.mark.parametrize("left", [b"", b"da", b"do"])
@pytest.mark.parametrize(("stored", "restored"), [("1.mcap", "1.mcap.part"), ("1.mcap.part", "1.mcap")])
def test_a_shorter_form_of_a_recording_that_was_restored_replaces_nothing_longer(
    machine: Machines, bucket: Bucket, clock: Clock, stored: str, restored: str, left: bytes, is_away: bool
) -> None:
    """The recorder gives an unfinished recording its name before the storage answers; `do` goes on otherwise."""
    a = machine("a", at_work=True)
    a.write(f"recordings/{stored}", b"data")
    a.push()
    (a.folder / "recordings" / stored).unlink()
    a.write(f"recordings/{restored}", left)
    bucket.fail = away if is_away else no_failure
    again = machine("a", at_work=True)
    found = again.content()
    bucket.fail = no_failure
    if is_away and restored == "1.mcap.part":
        (a.folder / "recordings" / restored).rename(a.folder / "recordings" / "1.mcap")
    again.push()
    assert again.store.failed is None
    if is_away or left == b"do":
        (aside,) = (a.folder / "superseded").iterdir()
        assert content(aside) == {f"recordings/{stored}": b"data"}, "the folder's may be written, or goes on otherwise"
        return
    assert found == again.content() == {f"recordings/{stored}": b"data"}
    b = machine("b")
    silent(b, clock)
    assert b.open().content() == found


@pytest.mark.parametrize(("finished", "unfinished"), [(4, 2), (4, 4), (2, 4)])
def test_of_two_forms_of_a_recording_that_are_stored_the_longer_counts(finished: int, unfinished: int) -> None:
    lengths = {"1.mcap": finished, "1.mcap.part": unfinished, "2.mcap.part": 1, "results.jsonl": 1}
    files = {name: StoredFile(parts=(Part("x", 0, n),), crc32=0, mtime_ns=0) for name, n in lengths.items()}
    longer = "1.mcap" if finished >= unfinished else "1.mcap.part"
    assert without_shorter(files).keys() == {longer, "2.mcap.part", "results.jsonl"}


def test_a_renewal_after_a_write_without_an_answer_keeps_what_was_written(
    machine: Machines, bucket: Bucket, clock: Clock
) -> None:
    def lose_answer(call: str, is_done: bool) -> None:
        if is_done and bucket.calls[-1] == MANIFEST:
            raise exceptions.ReadTimeoutError(endpoint_url="s3")

    a, b = machine("a", at_work=True), machine("b")
    a.write("results.jsonl", b"one\n")
    bucket.fail = lose_answer
    a.push()
    bucket.fail = no_failure
    clock.now_s += 5.0
    a.renew()
    silent(b, clock)
    assert b.open().content() == {"results.jsonl": b"one\n"}


def test_of_a_machine_that_was_cloned_while_it_ran_one_ends(machine: Machines, bucket: Bucket, clock: Clock) -> None:
    """The clone has the owner's name, and writes the next manifest."""
    a = machine("a", at_work=True)
    written = json.loads(bucket.objects[MANIFEST])
    bucket.objects[MANIFEST] = json.dumps(
        written | {"number": written["number"] + 1, "written": "by the clone"}
    ).encode()
    clock.now_s += 5.0
    a.renew()
    assert "taken over" in str(a.store.lost)


def test_a_monitor_says_that_another_machine_may_have_the_site_as_soon_as_one_may(
    machine: Machines, bucket: Bucket, clock: Clock
) -> None:
    a, b = machine("a", at_work=True), machine("b")
    assert b.store.lease.is_held()
    clock.now_s += 14.9
    assert a.store.failed is None and b.store.lease.is_held(), "its machine stood still, and nobody could ask for long"
    clock.now_s += 0.1
    assert "another machine may monitor the site" in str(a.store.failed) and not b.store.lease.is_held()
    a.renew()
    assert a.store.failed is None


def test_a_standby_waits_where_the_bucket_was_emptied_and_its_owner_stores_all_anew(
    machine: Machines, bucket: Bucket, clock: Clock
) -> None:
    a, b = machine("a", at_work=True), machine("b")
    a.write("results.jsonl", b"one\n")
    a.push()
    assert b.store.lease.is_held()
    bucket.objects.clear()
    assert b.store.lease.is_held()
    with pytest.raises(InUseError, match="a monitor is at work"):
        b.open()
    clock.now_s += 5.0
    for piece in (a.renew, a.push, a.renew):
        piece()
    assert a.store.failed is None and b.store.lease.is_held()
    a.close()
    assert b.open().content() == {"results.jsonl": b"one\n"}


def test_an_older_manifest_that_somebody_put_back_costs_no_newer_file(
    machine: Machines, bucket: Bucket, clock: Clock
) -> None:
    a, b = machine("a", at_work=True), machine("b")
    a.write("results.jsonl", b"one\n")
    a.push()
    before = dict(bucket.objects)
    a.write("results.jsonl", b"one\ntwo\n")
    a.push()
    bucket.objects |= {MANIFEST: before[MANIFEST]}
    clock.now_s += 5.0
    for piece in (a.renew, a.push, a.renew):
        piece()
    assert a.store.lost is None and a.store.failed is None
    a.close()
    assert b.open().content() == {"results.jsonl": b"one\ntwo\n"}


def test_who_was_stopped_while_it_tidied_up_deletes_nothing_of_the_one_that_took_over(
    machine: Machines, bucket: Bucket, clock: Clock
) -> None:
    a, b = machine("a", at_work=True), machine("b")
    a.write("results.jsonl", b"one\n")
    a.close()

    def stop(call: str, is_done: bool) -> None:
        if call == "list" and is_done:
            bucket.fail = no_failure
            silent(a, clock)
            a.open()
            a.write("results.jsonl", b"one\n" + bytes(9) + b"\n")
            a.push()

    bucket.fail = stop
    with pytest.raises(InUseError, match="taken over"):
        b.open()
    a.close()
    assert machine("c", at_work=True).content() == a.content()


def test_a_small_file_that_was_replaced_within_a_tick_of_the_clock_is_stored(machine: Machines, clock: Clock) -> None:
    a, b = machine("a", at_work=True), machine("b")
    for data in (b"1", b"2"):
        a.write("state/alarms", data)
        os.utime(a.folder / "state" / "alarms", ns=(10**18, 10**18))
        a.push()
    silent(b, clock)
    assert b.open().content() == {"state/alarms": b"2"}


def test_of_a_recording_that_is_finished_while_files_are_stored_nothing_is_lost(
    machine: Machines, bucket: Bucket, clock: Clock
) -> None:
    def cut_off(call: str, is_done: bool) -> None:
        if is_done and bucket.calls[-1] == MANIFEST:
            bucket.fail = away

    def finish(call: str, is_done: bool) -> None:
        if is_done and bucket.calls[-1] != MANIFEST:
            bucket.fail = no_failure
            (a.folder / "recordings" / "2.mcap.part").rename(a.folder / "recordings" / "2.mcap")

    a, b, c = machine("a", at_work=True), machine("b"), machine("c")
    a.write("recordings/1.mcap.part", b"da")
    a.push()
    a.write("recordings/1.mcap.part", b"data")
    (a.folder / "recordings" / "1.mcap.part").rename(a.folder / "recordings" / "1.mcap")
    clock.now_s += 5.0
    bucket.fail = cut_off
    a.push()
    bucket.fail = no_failure
    silent(b, clock)
    assert b.open().content() == a.content(), "the manifest had both names"
    a = b
    a.write("recordings/2.mcap.part", b"da")
    a.push()
    a.write("a.mcap", bytes(OBJECT_BYTES))
    a.write("b.mcap", b"data")
    bucket.fail = finish
    a.push()
    silent(c, clock)
    assert c.open().content() == a.content(), "it was renamed after it had been listed"
