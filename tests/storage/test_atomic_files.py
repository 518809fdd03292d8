import os
import subprocess
import sys
from pathlib import Path

import pytest

from visadapt.storage.atomic_files import DiskFullError, NotWrittenError, check_writable, replacing


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_file_takes_its_name_when_it_is_whole(tmp_path):
    path = tmp_path / "new" / "film.mp4"
    with replacing(path) as temporary:
        temporary.write_text("frames")
        assert temporary.parent == path.parent
        assert temporary.suffix == ".mp4"
        assert not path.exists()
    assert path.read_text() == "frames"
    assert names(path.parent) == ["film.mp4"]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_a_failure_leaves_what_was_there(tmp_path, error):
    path = tmp_path / "film.mp4"
    path.write_text("old")

    def write():
        with replacing(path) as temporary:
            temporary.write_text("half")
            raise error

    with pytest.raises(error):
        write()
    assert path.read_text() == "old"
    assert names(tmp_path) == ["film.mp4"]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
@pytest.mark.parametrize("quoted", [False, True])
def test_a_full_disk_is_one_line_that_names_the_file(tmp_path, quoted):
    path = tmp_path / "film.mp4"

    def write():
        with replacing(path) as temporary:
            temporary.write_text("half")
            try:
                Path("/dev/full").write_text("the rest")
            except OSError as error:
                if quoted:
                    raise RuntimeError(f"the encoder failed: {error}") from None
                raise

    with pytest.raises(DiskFullError, match="disk full") as caught:
        write()
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert names(tmp_path) == []


def write(path, text="new"):
    with replacing(path) as temporary:
        temporary.write_text(text)


def test_a_file_may_be_read_by_whom_the_umask_lets_whatever_wrote_it(tmp_path):
    path = tmp_path / "weights.safetensors"
    with replacing(path) as temporary:
        temporary.touch(0o600)
    (tmp_path / "usual").touch()
    assert path.stat().st_mode == (tmp_path / "usual").stat().st_mode


def test_a_link_is_followed_and_a_mode_is_kept(tmp_path):
    path, link = tmp_path / "a" / "private.json", tmp_path / "link.json"
    path.parent.mkdir()
    path.write_text("old")
    path.chmod(0o600)
    link.symlink_to(path)
    write(link)
    assert link.is_symlink()
    assert path.read_text() == "new"
    assert path.stat().st_mode & 0o777 == 0o600


def test_a_pipe_is_written_to_and_not_replaced(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        write(pipe)
        assert os.read(reader, 100) == b"new"
    finally:
        os.close(reader)
    assert pipe.is_fifo()
    assert names(tmp_path) == ["pipe"]


def test_what_a_killed_process_left_is_removed_and_no_more(tmp_path):
    path = tmp_path / "film.mp4"
    code = f"""
import os, signal
from visadapt.storage.atomic_files import replacing
with replacing({str(path)!r}) as temporary:
    temporary.write_text("half")
    os.kill(os.getpid(), signal.SIGKILL)
"""
    subprocess.run([sys.executable, "-c", code], check=False)
    assert len(names(tmp_path)) == 1
    with replacing(path) as first, replacing(path) as second:
        first.write_text("first")
        assert names(tmp_path) == [first.name]
        second.write_text("second")
        assert first.exists()
    assert path.read_text() == "first"
    assert names(tmp_path) == ["film.mp4"]


def test_a_name_as_long_as_the_system_allows(tmp_path):
    path = tmp_path / (80 * "\u6a5f" + ".h5")
    with replacing(path) as temporary:
        temporary.write_text("whole")
    assert names(tmp_path) == [path.name]


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("folder", "it is a folder"),
        ("file/a.json", "Not a directory"),
        ("file/b/a.json", "Not a directory"),
        ("a" * 300, "File name too long"),
    ],
)
def test_what_cannot_be_written_is_told_before_and_by_its_cause(tmp_path, name, says):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("old")
    before = names(tmp_path)
    with pytest.raises(NotWrittenError, match=f"cannot be written: {says}"):
        check_writable(tmp_path / name)
    with pytest.raises(NotWrittenError, match="was not written: ") as caught:
        write(tmp_path / name)
    assert "disk full" not in str(caught.value)
    assert names(tmp_path) == before


def test_a_check_leaves_nothing_behind(tmp_path):
    check_writable(tmp_path / "new" / "a.json")
    check_writable(tmp_path / "b.json")
    assert names(tmp_path) == []
