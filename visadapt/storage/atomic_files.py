"""Atomic writing: a file appears under its name only once it is complete."""

from __future__ import annotations

import errno
import glob
import os
import shutil
import socket
import stat
import tempfile
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

FULL_DISK_BYTES = 2**18
"""With fewer bytes free than this, a write that failed without naming its cause is taken to have filled the disk."""


class NotWrittenError(OSError):
    """A file cannot be written; the message is one line that names it and says why."""


class DiskFullError(NotWrittenError):
    """The disk has no room for a file; the message is one line that names it."""


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Gives a temporary path beside `path` to write to; the file is renamed to `path` when the block ends.

        with replacing("film.mp4") as temporary:
            write_film(temporary, frames)

    The temporary file is hidden and keeps the suffix, since many writers choose a format by it. Missing folders are
    made. If the block raises or is interrupted, the temporary file is removed and a file at `path` stays as it was.
    The temporary file of a process that was killed while it wrote the same file is removed too. Links are followed, and
    a file that is replaced keeps its mode. What is no regular file, such as a pipe or a device, is never replaced: the
    content is written to it.

    Raises:
        DiskFullError: the disk, or the user's quota on it, is full.
        NotWrittenError: the file cannot be written for another reason of the system's.
        Exception: whatever else the block raised.
    """
    final = Path(os.path.realpath(path))
    through = _is_device(path)
    folder = Path(tempfile.gettempdir()) if through else final.parent
    stem = f".{final.stem.encode()[:100].decode(errors='ignore')}.{socket.gethostname()[:50]}"
    temporary = folder / f"{stem}.{os.getpid()}-{uuid.uuid4().hex[:8]}{final.suffix}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for other in folder.glob(f"{glob.escape(stem)}.*-????????{glob.escape(final.suffix)}"):
            if not _is_running(int(other.name[len(stem) + 1 :].partition("-")[0])):
                other.unlink(missing_ok=True)
        yield temporary
        if through:
            with Path(path).open("ab") as device:  # appended: standard output may be a file that holds more
                device.write(temporary.read_bytes())
            temporary.unlink()
            return
        # Onto the disk first, so that a full disk or a power cut cannot cost the old file.
        with temporary.open("rb") as file:
            os.fsync(file.fileno())
        # Some writers make files that nobody else may read.
        temporary.chmod(stat.S_IMODE(final.stat().st_mode) if final.exists() else 0o666 & ~_umask())
        temporary.replace(final)
    except BaseException as error:
        # Before the temporary file, which may be what fills the disk, is removed.
        full = isinstance(error, Exception) and _is_full(error, folder)
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        if full:
            raise DiskFullError(f"{path} was not written: disk full; free some space and run again") from error
        own = map(str, (path, temporary, final, *final.parents))
        if isinstance(error, OSError) and error.strerror and error.filename in own:
            raise NotWrittenError(f"{path} was not written: {error.strerror}") from error
        raise


def check_writable(path: str | os.PathLike[str]) -> None:
    """Raises NotWrittenError where `replacing` could not write: before long work whose result is to stand there."""
    final = Path(os.path.realpath(path))
    try:
        if final.is_dir():
            raise IsADirectoryError(errno.EISDIR, "it is a folder; the name of a file is right")
        if _is_device(path):
            return  # to open one may already change it
        with suppress(FileNotFoundError):
            final.lstat()  # raises where the name is too long, or a file stands where a folder is needed
        folder = next(parent for parent in final.parents if parent.exists())
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise NotWrittenError(f"{path} cannot be written: {error.strerror}") from error


def _umask() -> int:
    """The bits of a file's mode that the process does not give to new files."""
    mask = os.umask(0o077)
    os.umask(mask)
    return mask


def _is_running(process: int) -> bool:
    """Whether there is a process of that number on this machine."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:  # it is another user's
        return True
    return True


def _is_device(path: str | os.PathLike[str]) -> bool:
    """Whether `path` exists, is no folder, and is either no regular file or lies in /dev, as `/dev/stdout` does."""
    path = Path(path)
    with suppress(OSError):
        exists = path.exists() and not path.is_dir()
        return exists and (not path.is_file() or Path("/dev") in path.absolute().parents)
    return False


def _is_full(error: BaseException, folder: Path) -> bool:
    """Whether the disk was full. Some libraries chain the system's error, some quote it, some report neither."""
    codes = {errno.ENOSPC, errno.EDQUOT}
    link: BaseException | None = error
    while link is not None:
        if getattr(link, "errno", None) in codes or any(os.strerror(code) in str(link) for code in codes):
            return True
        link = link.__cause__ or link.__context__
    # torch.save reports "unexpected pos", ffmpeg a broken pipe. An error with another number has another cause.
    if isinstance(error, OSError | RuntimeError) and not getattr(error, "errno", None):
        with suppress(OSError):
            return shutil.disk_usage(folder).free < FULL_DISK_BYTES
    return False
