"""Objects of one site in object storage, reached by botocore."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import Any

from monitor.core import import_extra

OBJECT_BYTES = 4 << 20
"""Longest object. [bytes; cost: it is held in memory]"""
_TIMEOUT_S = 5.0
"""Longest wait for a connection, or for an answer. [s; judgement]"""
_CONNECTIONS = 32
"""Most connections of the process at the same time. [1; cost]"""
_NONE = {"PreconditionFailed", "ConditionalRequestConflict", "NoSuchKey", "404"}
"""Answers that say that a condition fails, or that there is no such object. [words; S3's]"""


class Objects:
    """Objects below ``s3://BUCKET/NAME``; every call raises OSError where the storage does not answer."""

    def __init__(self, url: str, client: Callable[[], Any] | None = None) -> None:
        self._bucket, _, prefix = url.removeprefix("s3://").partition("/")
        self._prefix, self._client = f"{prefix}/", client or _client

    def get(self, name: str, span: tuple[int, int] | None = None) -> tuple[bytes, str] | None:
        """Return an object, or `span` = (offset, length) of it, and its ETag; None where there is none."""
        where = {} if span is None else {"Range": f"bytes={span[0]}-{sum(span) - 1}"}
        return self._ask("get_object", Key=name, **where)

    def put(self, name: str, data: bytes) -> None:
        """Store an object."""
        self._ask("put_object", Key=name, Body=data)

    def replace(self, name: str, data: bytes, tag: str | None) -> str | None:
        """Store an object where that with this ETag is (None: none), and return the new ETag; None where another one is."""
        condition = {"IfNoneMatch": "*"} if tag is None else {"IfMatch": tag}
        answer = self._ask("put_object", Key=name, Body=data, **condition)
        return None if answer is None else answer[1]

    def delete(self, names: Iterable[str]) -> None:
        """Delete objects."""
        for name in names:
            self._ask("delete_object", Key=name)

    def names(self) -> Iterator[str]:
        """List the objects."""
        with _told():
            pages = self._client().get_paginator("list_objects_v2").paginate(Bucket=self._bucket, Prefix=self._prefix)
            for page in pages:
                yield from (entry["Key"].removeprefix(self._prefix) for entry in page.get("Contents", ()))

    def _ask(self, what: str, *, Key: str, **options: Any) -> tuple[bytes, str] | None:  # noqa: N803 - the name of the interface
        """Call the storage; return body and ETag of the answer, None where there is no such object or the condition fails."""
        with _told():
            try:
                answer = getattr(self._client(), what)(Bucket=self._bucket, Key=self._prefix + Key, **options)
            except self._client().exceptions.ClientError as error:
                if error.response["Error"]["Code"] in _NONE:
                    return None
                raise
            return answer["Body"].read() if "Body" in answer else b"", answer.get("ETag", "")


@lru_cache(1)
def _client() -> Any:
    """Return the process's client of the storage; access is by the usual ``AWS_`` variables or ``~/.aws``."""
    what = "output.store"
    config = import_extra("botocore.config", what).Config(
        connect_timeout=_TIMEOUT_S,
        read_timeout=_TIMEOUT_S,
        max_pool_connections=_CONNECTIONS,
        retries={"total_max_attempts": 1},  # the next attempt is the next interval's
    )
    return import_extra("botocore.session", what).get_session().create_client("s3", config=config)


@lru_cache(1)
def _errors() -> tuple[type[Exception], ...]:
    """Return the errors of the storage; they are looked for once, for a disk may hang."""
    errors = import_extra("botocore.exceptions", "output.store")
    return errors.BotoCoreError, errors.ClientError


@contextmanager
def _told() -> Iterator[None]:
    """Turn errors of the storage into OSError with one line."""
    try:
        yield
    except _errors() as error:
        raise OSError(" ".join(str(error).split())) from error
