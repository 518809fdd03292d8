from pathlib import Path

import pytest

from visadapt.storage.atomic_files import DiskFullError, replacing


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
