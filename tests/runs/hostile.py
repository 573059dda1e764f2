"""Hostile files within bounds, and readers that take a process of their own in a copy of this one, which begins at once."""

from __future__ import annotations

import contextlib
import faulthandler
import importlib
import os
import resource
import signal
import subprocess
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

from drivers.base import ACCELERATION, SampleBlock
from monitor.runs.readers import own_process
from monitor.runs.recordings import read_topics

_ROOM_BYTES = 2 << 30
"""Memory that a file may take."""
_LONGEST_S = 3
"""CPU time after which the copy is ended, as the process is after a time of its own: HDF5 waits for ever on some damage."""


def _addresses() -> int:
    return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()


@contextlib.contextmanager
def with_room() -> Iterator[None]:
    """Bound the memory of this process: what needs more than it has now and a file may take raises MemoryError."""
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (_addresses() + _ROOM_BYTES, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


@contextlib.contextmanager
def forked(*, apart: bool = True) -> Iterator[None]:
    """Let what is read `apart` be read by a copy of this process, with the same bounds; a crash is the copy's."""
    with patch.object(own_process.subprocess, "run", _run) if apart else contextlib.nullcontext():
        yield


_started = subprocess.run


def _run(command: list[str], **how: Any) -> subprocess.CompletedProcess[str]:
    if "-m" not in command:  # h5py asks for the machine's name
        return _started(command, **how)
    _, module, path, out, *rest = command[command.index("-m") + 1 :]
    read, told = importlib.import_module(module).read, Path(out).with_name("told")
    told.touch()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        child = os.fork()
    if not child:
        code = 1
        try:
            faulthandler.disable()
            warnings.simplefilter("ignore")
            resource.setrlimit(resource.RLIMIT_CPU, (_LONGEST_S, _LONGEST_S))
            quiet = os.open(os.devnull, os.O_WRONLY)
            os.dup2(quiet, 1)
            os.dup2(quiet, 2)
            with (
                told.open("w") as file,
                contextlib.redirect_stdout(file),
                patch.object(own_process, "_PROGRAM_BYTES", _addresses() + _ROOM_BYTES),
            ):
                code = own_process.hand_over(read, path, out, *rest)
        finally:
            os._exit(code)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if code in (-signal.SIGXCPU, -signal.SIGKILL):
        raise subprocess.TimeoutExpired(command, _LONGEST_S)
    return subprocess.CompletedProcess(command, code, told.read_text(errors="replace"), "")


def imu_topics(path: Path) -> Iterator[SampleBlock]:
    """The topics /i1 and /i2 of a ROS 2 recording."""
    return read_topics([path], (ACCELERATION,), lambda _: None, topic_map={"/i1": "a1", "/i2": "a2"})
