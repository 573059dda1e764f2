"""A disk that hangs and fills on demand: a file system in user space (FUSE) over a folder.

``python -m tests.support.faulty_disk BACKING MOUNTPOINT`` serves it in the foreground; only root may mount it.  While its process
is stopped (SIGSTOP) every call of the file system waits, reads as well as writes, as on a disk that hangs; SIGUSR1 makes the disk
full, SIGUSR2 gives it room again.  The wire format is that of the kernel's ``include/uapi/linux/fuse.h``, version 7.31.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import signal
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

_LIBC = ctypes.CDLL(None, use_errno=True)
_ROOT = 1
_MAX_WRITE = 1 << 17
_BIG_WRITES = 1 << 5
_SIZE, _MODE, _UID, _GID, _HANDLE = 8, 1, 2, 4, 64
_DETACH = 2
_IN, _OUT = struct.Struct("<IIQQIIII"), struct.Struct("<IiQ")
_ATTR = struct.Struct("<6Q10I")


def is_possible() -> bool:
    """Return whether this user may mount such a disk."""
    return os.getuid() == 0 and Path("/dev/fuse").exists()


class Disk:
    """Handle on a mounted disk."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self._process = process

    def hang(self) -> None:
        self._process.send_signal(signal.SIGSTOP)

    def answer(self) -> None:
        self._process.send_signal(signal.SIGCONT)

    def fill(self) -> None:
        self._process.send_signal(signal.SIGUSR1)

    def make_room(self) -> None:
        self._process.send_signal(signal.SIGUSR2)


@contextmanager
def faulty_disk(backing: Path, place: Path) -> Iterator[Disk]:
    """Mount the folder `backing` at the folder `place` while the context lasts."""
    command = [sys.executable, "-m", "tests.support.faulty_disk", str(backing), str(place)]
    process = subprocess.Popen(command, cwd=Path(__file__).parents[2], stdout=subprocess.PIPE)
    try:
        assert process.stdout is not None and process.stdout.readline() == b"mounted\n"
        yield Disk(process)
    finally:
        _LIBC.umount2(os.fsencode(place), _DETACH)
        process.kill()  # what still waits gets an error
        process.communicate()


class _Server:
    """Answers the kernel's requests from a folder."""

    def __init__(self, backing: Path, device: int) -> None:
        self._device = device
        self._paths = {_ROOT: os.fspath(backing)}
        self.full = False
        self._calls: dict[int, Callable[[int, bytes], bytes]] = {
            1: lambda node, body: self._entry(self._in(node, body[:-1])),
            3: self._getattr,
            4: self._setattr,
            9: self._mkdir,
            10: lambda node, body: self._done(os.unlink(self._in(node, body[:-1]))),
            11: lambda node, body: self._done(os.rmdir(self._in(node, body[:-1]))),
            12: lambda node, body: self._rename(node, struct.unpack_from("<Q", body)[0], body[8:]),
            14: self._open,
            15: self._read,
            16: self._write,
            17: self._statfs,
            18: lambda _, body: self._done(os.close(struct.unpack_from("<Q", body)[0])),
            20: lambda _, body: self._done(os.fsync(struct.unpack_from("<Q", body)[0])),
            26: lambda *_: struct.pack("<IIIIHHIIHH8I", 7, 31, 0, _BIG_WRITES, 12, 9, _MAX_WRITE, 1, 0, 0, *[0] * 8),
            27: lambda *_: bytes(16),
            28: self._readdir,
            29: lambda *_: b"",
            30: lambda *_: b"",
            35: self._create,
            45: lambda node, body: self._rename(node, struct.unpack_from("<Q", body)[0], body[16:]),
        }

    def serve(self) -> None:
        """Answer until the disk is unmounted."""
        while True:
            try:
                request = os.read(self._device, _MAX_WRITE + 4096)
            except InterruptedError:
                continue
            except OSError:
                return
            _, opcode, unique, node, *_ = _IN.unpack_from(request)
            if opcode in {2, 36, 42}:  # forgotten nodes and interrupts have no answer
                continue
            error, answer = 0, b""
            try:
                answer = self._call(opcode)(node, request[_IN.size :])
            except OSError as failure:
                error = failure.errno or errno.EIO
            with contextlib.suppress(OSError):  # who asked may be gone
                os.write(self._device, _OUT.pack(_OUT.size + len(answer), -error, unique) + answer)

    def _call(self, opcode: int) -> Callable[[int, bytes], bytes]:
        if opcode not in self._calls:
            raise OSError(errno.ENOSYS, "")
        if self.full and opcode in {9, 16, 35}:
            raise OSError(errno.ENOSPC, "")
        return self._calls[opcode]

    def _in(self, node: int, name: bytes) -> str:
        return os.path.join(self._paths[node], os.fsdecode(name))

    @staticmethod
    def _done(_: None) -> bytes:
        return b""

    @staticmethod
    def _attr(status: os.stat_result) -> bytes:
        whole, rest = zip(
            *(divmod(ns, 10**9) for ns in (status.st_atime_ns, status.st_mtime_ns, status.st_ctime_ns)), strict=True
        )
        numbers = (status.st_mode, status.st_nlink, status.st_uid, status.st_gid, 0, 4096, 0)
        return _ATTR.pack(status.st_ino, status.st_size, status.st_blocks, *whole, *rest, *numbers)

    def _entry(self, path: str) -> bytes:
        status = os.lstat(path)
        self._paths[status.st_ino] = path
        return struct.pack("<QQQQII", status.st_ino, 0, 0, 0, 0, 0) + self._attr(status)

    def _getattr(self, node: int, body: bytes) -> bytes:
        flags, _, handle = struct.unpack_from("<IIQ", body)
        return bytes(16) + self._attr(os.fstat(handle) if flags & 1 else os.lstat(self._paths[node]))

    def _setattr(self, node: int, body: bytes) -> bytes:
        valid, _, handle, size = struct.unpack_from("<IIQQ", body)
        mode, _, uid, gid = struct.unpack_from("<4I", body, 68)
        at: int | str = handle if valid & _HANDLE else self._paths[node]
        if valid & _SIZE:
            os.truncate(at, size)
        if valid & _MODE:
            os.chmod(at, mode)
        if valid & (_UID | _GID):
            os.chown(at, uid if valid & _UID else -1, gid if valid & _GID else -1)
        return bytes(16) + self._attr(os.stat(at))

    def _mkdir(self, node: int, body: bytes) -> bytes:
        path = self._in(node, body[8:-1])
        os.mkdir(path, struct.unpack_from("<I", body)[0])
        return self._entry(path)

    def _rename(self, node: int, to: int, names: bytes) -> bytes:
        old, new, _ = names.split(b"\0")
        source, target = self._in(node, old), self._in(to, new)
        os.replace(source, target)
        for number, path in self._paths.items():
            if path == source or path.startswith(source + "/"):
                self._paths[number] = target + path[len(source) :]
        return b""

    def _handle(self, path: str, flags: int, mode: int = 0) -> bytes:
        handle = os.open(path, flags & ~(os.O_APPEND | os.O_DIRECT) | os.O_CLOEXEC, mode)
        return struct.pack("<QII", handle, 0, 0)

    def _open(self, node: int, body: bytes) -> bytes:
        return self._handle(self._paths[node], struct.unpack_from("<I", body)[0])

    def _create(self, node: int, body: bytes) -> bytes:
        flags, mode = struct.unpack_from("<II", body)
        path = self._in(node, body[16:-1])
        handle = self._handle(path, flags | os.O_CREAT, mode)
        return self._entry(path) + handle

    def _read(self, _: int, body: bytes) -> bytes:
        handle, offset, size = struct.unpack_from("<QQI", body)
        return os.pread(handle, size, offset)

    def _write(self, _: int, body: bytes) -> bytes:
        handle, offset, size = struct.unpack_from("<QQI", body)
        return struct.pack("<II", os.pwrite(handle, body[40 : 40 + size], offset), 0)

    def _statfs(self, *_: object) -> bytes:
        s = os.statvfs(self._paths[_ROOT])
        free = (0, 0) if self.full else (s.f_bfree, s.f_bavail)
        return struct.pack("<5Q4I6I", s.f_blocks, *free, s.f_files, s.f_ffree, s.f_bsize, 255, s.f_frsize, 0, *[0] * 6)

    def _readdir(self, node: int, body: bytes) -> bytes:
        _, offset, size = struct.unpack_from("<QQI", body)
        found = b""
        for number, entry in enumerate(sorted(os.scandir(self._paths[node]), key=lambda e: e.name), start=1):
            name = os.fsencode(entry.name)
            row = struct.pack("<QQII", entry.inode(), number, len(name), 0) + name
            row += bytes(-len(row) % 8)
            if number > offset:
                if len(found) + len(row) > size:
                    break
                found += row
        return found


def main(backing: Path, place: Path) -> None:
    """Mount the disk and serve it."""
    os.umask(0)
    device = os.open("/dev/fuse", os.O_RDWR)
    options = f"fd={device},rootmode=40000,user_id=0,group_id=0,allow_other,default_permissions".encode()
    if _LIBC.mount(b"faulty", os.fsencode(place), b"fuse", 0, options):
        raise OSError(ctypes.get_errno(), f"cannot be mounted: {place}")
    server = _Server(backing, device)
    signal.signal(signal.SIGUSR1, lambda *_: setattr(server, "full", True))
    signal.signal(signal.SIGUSR2, lambda *_: setattr(server, "full", False))
    print("mounted", flush=True)
    server.serve()


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
