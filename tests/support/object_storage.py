"""A server on loopback that speaks S3, and the variables by which programs reach it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from botocore.session import get_session
from moto.server import ThreadedMotoServer


@contextmanager
def object_storage(bucket: str) -> Iterator[int]:
    """Give the port of a server with one bucket; within the block the ``AWS_`` variables lead to it."""
    server = ThreadedMotoServer("127.0.0.1", 0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    try:
        with pytest.MonkeyPatch.context() as patch:
            for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
                patch.setenv(name, "testing")
            patch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
            patch.setenv("AWS_DEFAULT_REGION", "us-east-1")
            get_session().create_client("s3").create_bucket(Bucket=bucket)
            yield port
    finally:
        server.stop()
