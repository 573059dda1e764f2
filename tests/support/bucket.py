"""Object storage in memory that may fail in every way, and machines that keep a site there, without threads, by one clock."""

from __future__ import annotations

import hashlib
import re
import shutil
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import pytest

from monitor.core import Worker
from monitor.service.manifest import State
from monitor.service.site_store import SiteStore

exceptions = pytest.importorskip("botocore.exceptions")
MANIFEST = "city/tower/manifest.json"


class Clock:
    """Time that passes when a test says so, or while somebody sleeps."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds


class Bucket:
    """Storage in memory with the interface of the client; `fail` may raise before or after a call takes effect."""

    class exceptions:
        ClientError = exceptions.ClientError

    def __init__(self) -> None:
        self.objects: dict[str, bytes] = {}
        self.calls: list[str] = []
        self.fail: Callable[[str, bool], None] = lambda call, is_done: None
        self.is_stale: Callable[[str], bool] = lambda name: False
        """Whether a read of an object that was replaced gives the one before."""
        self._before: dict[str, bytes] = {}

    def _error(self, code: str, call: str) -> Exception:
        return exceptions.ClientError({"Error": {"Code": code, "Message": code}}, call)

    def get_object(self, *, Bucket: str, Key: str, Range: str = "bytes=0-") -> dict[str, Any]:
        self.fail("get", False)
        if Key not in self.objects:
            raise self._error("NoSuchKey", "GetObject")
        first, _, last = Range.removeprefix("bytes=").partition("-")
        whole = self._before.get(Key, self.objects[Key]) if self.is_stale(Key) else self.objects[Key]
        return {"Body": BytesIO(whole[int(first) : int(last) + 1 if last else None]), "ETag": _tag(whole)}

    def put_object(
        self, *, Bucket: str, Key: str, Body: bytes, IfMatch: str | None = None, IfNoneMatch: str | None = None
    ) -> dict[str, Any]:
        self.fail("put", False)
        self.calls.append(Key)
        if IfMatch is not None and Key not in self.objects:
            raise self._error("NoSuchKey", "PutObject")
        if IfNoneMatch is not None and Key in self.objects:
            raise self._error("PreconditionFailed", "PutObject")
        if IfMatch is not None and _tag(self.objects[Key]) != IfMatch:
            raise self._error("PreconditionFailed", "PutObject")
        if Key in self.objects:
            self._before[Key] = self.objects[Key]
        self.objects[Key] = Body
        self.fail("put", True)
        return {"ETag": _tag(Body)}

    def delete_object(self, *, Bucket: str, Key: str) -> dict[str, Any]:
        self.fail("delete", False)
        self.objects.pop(Key, None)
        return {}

    def get_paginator(self, _: str) -> Bucket:
        return self

    def paginate(self, *, Bucket: str, Prefix: str) -> Iterator[dict[str, Any]]:
        """Give one object a page, so that others may write between two."""
        self.fail("list", False)
        last = ""
        while names := [key for key in sorted(self.objects) if key.startswith(Prefix) and key > last]:
            last = names[0]
            yield {"Contents": [{"Key": last}]}
            self.fail("list", True)


def _tag(data: bytes) -> str:
    return hashlib.md5(data, usedforsecurity=False).hexdigest()


def away(call: str, is_done: bool) -> None:
    """Answer nothing."""
    raise exceptions.EndpointConnectionError(endpoint_url="s3")


def no_failure(call: str, is_done: bool) -> None:
    """Answer all."""


class Machine:
    """A machine with an output folder, whose monitor keeps the site `tower` in a bucket; its workers do by hand."""

    def __init__(self, folder: Path, bucket: Bucket, clock: Clock, *, every_s: float = 5.0) -> None:
        self.folder, self._clock = folder, clock
        (folder / "state").mkdir(parents=True, exist_ok=True)
        (folder / "state" / "lock").touch()
        self.store = SiteStore(
            "s3://bucket/city", "tower", folder, every_s, clock=clock, client=lambda: bucket, sleep=clock.sleep
        )
        self._workers: list[Worker[Any]] = []

    def open(self, *, wait: bool = False) -> Machine:
        """Begin to monitor."""
        with Worker.by_hand(self._clock) as hand:
            self._workers = hand.workers
            self.store.open(wait=wait)
        return self

    def push(self) -> None:
        """Store what has changed, now."""
        self._do("store")

    def renew(self) -> None:
        """Say that it is at work, if it is time."""
        self._do("lease")

    def close(self, state: State = "released") -> None:
        """Store everything and leave the site."""
        self.store.close(state, 1.0)

    def _do(self, name: str) -> None:
        for worker in self._workers:
            if worker.name == name:
                worker.retry.worked()
                worker.wake()
                worker.step()

    def write(self, name: str, data: bytes) -> None:
        """Write a file of the folder as the monitor does: at once."""
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists() and data.startswith(path.read_bytes()):
            with path.open("ab") as file:
                file.write(data[path.stat().st_size :])
            return
        path.with_name(path.name + ".fetched").write_bytes(data)
        path.with_name(path.name + ".fetched").replace(path)

    def content(self) -> dict[str, bytes]:
        """Give what another machine should have of the folder."""
        return content(self.folder)


def content(folder: Path) -> dict[str, bytes]:
    """Give the files of a folder that are stored."""
    files = {path.relative_to(folder).as_posix(): path for path in folder.rglob("*") if path.is_file()}
    own = re.compile(r"state/(lock|owner|history\.db.*)|superseded/.*|.*\.fetched")
    return {name: path.read_bytes() for name, path in files.items() if not own.fullmatch(name)}


def copied(source: Path, target: Path) -> None:
    """Have a folder be what another one was, as a backup and its restoring do."""
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(source, target)
