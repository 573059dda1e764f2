"""What is written: a link stays and what it leads to is replaced; what is no regular file is refused and stays."""

from __future__ import annotations

import os
import socket
import stat
from collections.abc import Callable
from pathlib import Path

import pytest

from monitor.core import MissingInputError, demand_place, write_atomically
from tests.support.commands import assert_refused
from tests.support.samples import Cli


def a_pipe(path: Path) -> None:
    os.mkfifo(path)


def a_socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as one:
        one.bind(str(path))


def a_link_to_a_pipe(path: Path) -> None:
    os.mkfifo(path.with_name("pipe"))
    path.symlink_to("pipe")


def a_link_to_itself(path: Path) -> None:
    path.symlink_to(path.name)


SPECIAL = [a_pipe, a_socket, a_link_to_a_pipe, a_link_to_itself]


def linked(folder: Path) -> tuple[Path, Path]:
    """A link, by way of another, to a file in another folder."""
    (folder / "store").mkdir()
    target, link = folder / "store" / "target", folder / "link"
    target.write_text("old")
    (folder / "between").symlink_to("store/target")
    link.symlink_to(folder / "between")
    return link, target


def test_a_file_is_written_where_the_link_leads_and_the_link_stays(tmp_path: Path) -> None:
    link, target = linked(tmp_path)
    begun = target.open()
    demand_place(link)
    write_atomically(link, "new")
    assert begun.read() == "old", "replaced as a whole"
    begun.close()
    assert target.read_text() == "new" and link.is_symlink() and not target.is_symlink()
    assert sorted(os.listdir(tmp_path)) == ["between", "link", "store"] and os.listdir(target.parent) == ["target"]


def test_a_link_to_what_is_not_there_yet_is_followed(tmp_path: Path) -> None:
    link = tmp_path / "link"
    link.symlink_to("later/target")
    demand_place(link)
    write_atomically(link, "new")
    assert (tmp_path / "later" / "target").read_text() == "new" and link.is_symlink()


@pytest.mark.parametrize("make", SPECIAL)
def test_what_is_no_regular_file_is_refused_and_stays(tmp_path: Path, make: Callable[[Path], None]) -> None:
    place = tmp_path / "place"
    make(place)
    before = place.lstat()
    with pytest.raises(MissingInputError, match="place: cannot be written: is no regular file"):
        demand_place(place)
    with pytest.raises(OSError, match="no regular file"):
        write_atomically(place, "new")
    assert (before.st_ino, before.st_mode) == (place.lstat().st_ino, place.lstat().st_mode)
    assert not list(tmp_path.glob("*.part"))


def test_a_pipe_under_the_name_of_the_unfinished_file_is_refused_and_stays(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "place.part")
    with pytest.raises(OSError, match=r"no regular file; remove it: .*place\.part"):
        write_atomically(tmp_path / "place", "new")
    assert os.listdir(tmp_path) == ["place.part"]


@pytest.fixture
def commands(tmp_path: Path, frame_text: str) -> Callable[[Path], list[list[object]]]:
    """Commands that write a file each."""
    structure, table = tmp_path / "structure.toml", tmp_path / "table.csv"
    structure.write_text(frame_text)
    table.write_text("t,a1 [m/s^2]\n" + "".join(f"{k / 100:.2f},{(-1) ** k}\n" for k in range(300)))
    return lambda out: [
        ["simulate", "--structure", structure, "--out", out, "--duration", 2],
        ["import", table, "--out", out],
    ]


def test_commands_follow_a_link_and_refuse_a_pipe_with_66(
    tmp_path: Path, main: Cli, commands: Callable[[Path], list[list[object]]]
) -> None:
    link, target = linked(tmp_path)
    pipe = tmp_path / "out.mcap"
    os.mkfifo(pipe)
    for command in commands(link):
        target.write_text("old")
        done = main(*command)
        assert done.returncode == 0, done.stderr
        assert link.is_symlink() and target.read_bytes().startswith(b"\x89MCAP")
    for command in commands(pipe):
        assert_refused(main(*command), {66}, f"{pipe}: cannot be written: is no regular file")
    assert stat.S_ISFIFO(pipe.lstat().st_mode)
    assert not list(tmp_path.rglob("*.part"))
