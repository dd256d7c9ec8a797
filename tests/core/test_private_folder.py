"""A folder that only its user can change: who can write it or a folder above it, links, a race."""

import contextlib
import os
import sys
import threading

import pytest

from echelon.core import private_folder
from echelon.core.private_folder import NotPrivateError, PrivateFolder

pytestmark = pytest.mark.usefixtures("posix")


@pytest.fixture
def posix():
    assert sys.platform != "win32", "these are rules of POSIX; `test_by_path` is Windows's"


@pytest.fixture
def base(tmp_path, monkeypatch):
    """A folder under folders that others may enter, so that modes below it count."""
    for folder in (tmp_path, *tmp_path.parents):
        if folder.owner() and folder.stat().st_uid == os.geteuid() and folder != folder.parent:
            with contextlib.suppress(OSError):
                folder.chmod(folder.stat().st_mode | 0o055)
    return tmp_path


def test_what_is_written_is_read_and_damaged_files_of_others_are_not(base):
    folder = PrivateFolder(base / "a" / "compiled")
    folder.write("x-cache", b"mine")
    assert folder.read("x-cache") == b"mine"
    folder.write("x-cache", b"again")
    assert folder.read("x-cache") == b"again" and os.listdir(folder.path) == ["x-cache"]
    assert [each.stat().st_mode & 0o777 for each in (folder.path, folder.path / "x-cache")] == [
        0o700,
        0o600,
    ]
    (folder.path / "x-cache").chmod(0o622)
    with pytest.raises(NotPrivateError):
        folder.read("x-cache")
    (folder.path / "y-cache").symlink_to(base / "elsewhere")
    (base / "elsewhere").write_bytes(b"theirs")
    with pytest.raises(OSError):
        folder.read("y-cache")
    os.mkfifo(folder.path / "z-cache", 0o600)
    with pytest.raises(NotPrivateError):
        folder.read("z-cache")


@pytest.mark.parametrize("mode", [0o770, 0o702, 0o777, 0o1777])
def test_a_folder_that_others_may_write_is_refused(base, mode):
    (base / "compiled").mkdir()
    (base / "compiled").chmod(mode)
    with pytest.raises(NotPrivateError):
        PrivateFolder(base / "compiled")


@pytest.mark.parametrize(("mode", "private"), [(0o770, False), (0o772, False), (0o1777, True)])
def test_nobody_else_may_write_a_folder_above_it(base, mode, private):
    (base / "above" / "inner").mkdir(parents=True)
    (base / "above").chmod(mode)
    context = contextlib.nullcontext() if private else pytest.raises(NotPrivateError)
    with context:
        PrivateFolder(base / "above" / "inner" / "compiled")
    # Below a folder that nobody else can enter, modes do not count.
    base.chmod(0o700)
    PrivateFolder(base / "above" / "inner" / "compiled")


def test_links_are_followed_on_the_way_and_never_at_the_end(base):
    (base / "real").mkdir(mode=0o755)
    (base / "link").symlink_to("real")
    (base / "far").symlink_to(base / "link")
    PrivateFolder(base / "far" / "compiled").write("x-cache", b"x")
    assert (base / "real" / "compiled" / "x-cache").read_bytes() == b"x"
    (base / "compiled").symlink_to(base / "real" / "compiled")
    with pytest.raises(OSError):
        PrivateFolder(base / "compiled")
    (base / "loop").symlink_to("loop")
    with pytest.raises(OSError):
        PrivateFolder(base / "loop" / "compiled")
    (base / "real").chmod(0o777)
    with pytest.raises(NotPrivateError):
        PrivateFolder(base / "far" / "compiled")


def test_somebody_else_s_folder_or_link_is_refused(base, monkeypatch):
    (base / "compiled").mkdir()
    with monkeypatch.context() as at:
        at.setattr(os, "geteuid", lambda: os.getuid() + 1)
        with pytest.raises(NotPrivateError):
            PrivateFolder(base / "compiled")
    PrivateFolder(base / "compiled")


def test_the_oldest_files_go_first_and_no_others(base):
    folder = PrivateFolder(base / "compiled")
    for age, name in enumerate(["new-cache", "old-cache", "oldest-cache", "not-ours"]):
        folder.write(name, bytes(10))
        os.utime(folder.path / name, (1000 - age, 1000 - age))
    (base / "theirs").write_bytes(bytes(100))
    (folder.path / "linked-cache").symlink_to(base / "theirs")
    folder.remove_oldest("-cache", 25)
    assert {*os.listdir(folder.path)} == {"new-cache", "old-cache", "not-ours", "linked-cache"}
    assert (base / "theirs").exists()


def test_another_folder_in_its_place_is_never_read(base):
    """A thread swaps the folder and another one all the time, as who may write above it could."""
    mine, theirs, aside = base / "compiled", base / "theirs", base / "aside"
    for folder, content in ((mine, b"mine"), (theirs, b"theirs")):
        PrivateFolder(folder).write("x-cache", content)
    folder, ended, swaps = PrivateFolder(mine), threading.Event(), []

    def swap():
        while not ended.is_set():
            for source, target in ((mine, aside), (theirs, mine), (mine, theirs), (aside, mine)):
                os.rename(source, target)
            swaps.append(1)

    thread = threading.Thread(target=swap)
    thread.start()
    try:
        for _ in range(2000):
            assert folder.read("x-cache") == b"mine"
            folder.write("x-cache", b"mine")
    finally:
        ended.set()
        thread.join()
    assert len(swaps) > 10
    assert (theirs / "x-cache").read_bytes() == b"theirs"


def test_by_path_where_there_are_no_handles_as_on_windows(tmp_path, monkeypatch):
    monkeypatch.setattr(private_folder, "_BY_HANDLE", False)
    folder = PrivateFolder(tmp_path / "a" / "compiled")
    folder.write("x-cache", b"mine")
    assert folder.read("x-cache") == b"mine"
    folder.write("x-cache", b"again")
    folder.remove_oldest("-cache", 0)
    assert os.listdir(folder.path) == []
