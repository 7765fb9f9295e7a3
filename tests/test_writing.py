"""Files are replaced whole or not at all; links, devices, pipes and permissions stay what they are."""

import os
import socket
import stat
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from mtsp_env.writing import atomic_write, lock, remove_leftovers

ROOT = Path(__file__).parent.parent


def write(path, text="new"):
    with atomic_write(path) as temporary:
        temporary.write_text(text)


def mode(path):
    return stat.S_IMODE(os.stat(path).st_mode)


@pytest.fixture
def umask():
    """Restores the process's umask."""
    old = os.umask(0o022)
    yield
    os.umask(old)


def test_a_file_is_replaced_whole_or_not_at_all(tmp_path):
    path = tmp_path / "a"
    write(path, "old")
    with pytest.raises(RuntimeError), atomic_write(path) as temporary:
        temporary.write_text("half")
        assert path.read_text() == "old"
        raise RuntimeError
    assert path.read_text() == "old"
    write(path)
    assert path.read_text() == "new"
    assert [file.name for file in tmp_path.iterdir()] == ["a"]


def test_a_link_stays_a_link_and_its_target_is_written(tmp_path):
    (tmp_path / "there").mkdir()
    target = tmp_path / "there" / "target"
    for number in range(2):  # the target is missing the first time
        link = tmp_path / f"link{number}"
        link.symlink_to(Path("there") / "target")
        write(link, str(number))
        assert link.is_symlink() and not target.is_symlink() and target.read_text() == str(number)
    (tmp_path / "chain").symlink_to("link0")
    write(tmp_path / "chain", "by two links")
    assert target.read_text() == "by two links" and (tmp_path / "link0").is_symlink()


def test_loops_and_folders_are_refused(tmp_path):
    (tmp_path / "one").symlink_to("two")
    (tmp_path / "two").symlink_to("one")
    (tmp_path / "folder").mkdir()
    for name in ("one", "folder", "missing/file"):
        with pytest.raises(OSError, match=name.partition("/")[0]):
            write(tmp_path / name)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["folder", "one", "two"]


def test_a_socket_is_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # the path of a socket is short
    with socket.socket(socket.AF_UNIX) as server:
        server.bind("socket")
        with pytest.raises(OSError, match="neither a regular file nor a pipe or character device"):
            write("socket")
        assert stat.S_ISSOCK(os.stat("socket").st_mode)


def test_a_pipe_receives_the_content_and_stays_a_pipe(tmp_path):
    fifo, received = tmp_path / "fifo", []
    os.mkfifo(fifo)
    reader = threading.Thread(target=lambda: received.append(fifo.read_text()))
    reader.start()
    write(fifo, "x" * 200_000)  # more than a pipe holds
    reader.join()
    assert received == ["x" * 200_000] and stat.S_ISFIFO(os.stat(fifo).st_mode)


def test_a_device_is_written_and_stays_a_device(tmp_path):
    link = tmp_path / "null"
    link.symlink_to("/dev/null")
    for path in ("/dev/null", link):
        write(path)
        assert stat.S_ISCHR(os.stat(path).st_mode)
    with pytest.raises(OSError, match="No space left on device"):
        write("/dev/full")
    assert os.listdir(tmp_path) == ["null"]


@pytest.mark.parametrize("path", ["/dev/stdout", "/dev/fd/1", "/proc/self/fd/1", "link"])
@pytest.mark.parametrize("to_file", [True, False], ids=["file", "pipe"])
@pytest.mark.slow
def test_standard_output_is_written_where_it_stands(tmp_path, path, to_file):
    """Between what is printed before and after, also if a shell has redirected it to a file."""
    if not os.path.exists("/proc/self/fd"):
        pytest.skip("needs /proc")
    (tmp_path / "link").symlink_to("/dev/stdout")
    code = f"""
from mtsp_env.writing import atomic_write
print("before")
with atomic_write({path!r}) as temporary:
    temporary.write_text("content\\n")
print("after")
"""
    with open(tmp_path / "out", "w+") as out:
        done = subprocess.run(
            [sys.executable, "-c", code],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            stdout=out if to_file else subprocess.PIPE,
            text=True,
            check=True,
        )
    printed = (tmp_path / "out").read_text() if to_file else done.stdout
    assert printed == "before\ncontent\nafter\n"


@pytest.mark.parametrize("mask", [0o022, 0o077, 0o002])
def test_a_new_file_has_the_permissions_that_open_gives(tmp_path, umask, mask):
    os.umask(mask)
    (tmp_path / "any").write_text("")
    write(tmp_path / "new")
    assert mode(tmp_path / "new") == mode(tmp_path / "any") == 0o666 & ~mask


@pytest.mark.parametrize("permissions", [0o600, 0o640, 0o666, 0o755])
def test_an_existing_file_keeps_its_permissions(tmp_path, umask, permissions):
    path = tmp_path / "a"
    path.write_text("old")
    path.chmod(permissions)
    write(path)
    assert path.read_text() == "new" and mode(path) == permissions


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root gives files away")
def test_an_existing_file_keeps_its_owner(tmp_path):
    path = tmp_path / "a"
    path.write_text("old")
    os.chown(path, 1234, 4321)
    write(path)
    assert (os.stat(path).st_uid, os.stat(path).st_gid) == (1234, 4321)


def test_a_file_that_may_not_be_written_is_not_replaced(tmp_path, monkeypatch):
    path = tmp_path / "a"
    path.write_text("old")
    path.chmod(0o444)
    if os.access(path, os.W_OK):  # root may write anything
        monkeypatch.setattr("builtins.open", lambda file, *_: (_ for _ in ()).throw(PermissionError(13, "", str(file))))
    with pytest.raises(PermissionError):
        write(path)
    assert path.read_text() == "old" and os.listdir(tmp_path) == ["a"]


def test_a_long_name_can_be_written(tmp_path):
    write(tmp_path / ("ü" * 127))
    assert (tmp_path / ("ü" * 127)).read_text() == "new"


@pytest.mark.slow
def test_what_a_killed_writer_leaves_is_removed(tmp_path):
    code = "import os; from mtsp_env.writing import atomic_write\nwith atomic_write('a') as _: os.kill(os.getpid(), 9)"
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    assert subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment).returncode == -9
    (tmp_path / "b").write_text("kept")
    assert len(os.listdir(tmp_path)) == 2
    remove_leftovers(tmp_path)
    assert os.listdir(tmp_path) == ["b"]


def test_a_lock_is_held_by_one_and_ends_with_the_file(tmp_path):
    with open(tmp_path / "lock", "a") as one, open(tmp_path / "lock", "a") as other:
        lock(one)
        with pytest.raises(BlockingIOError):
            lock(other)
        one.close()
        lock(other)
