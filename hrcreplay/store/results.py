"""Folders of results and logs by path or by URL (S3 and the like, with fsspec), for the workers of a cluster.

An entry of a folder of results appears whole: on a file system by renaming it, in an object store by writing its
run.json last.
"""

from __future__ import annotations

import atexit
import hashlib
import json
import shutil
import tempfile
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path, PurePosixPath
from typing import Any

from hrcreplay.errors import LogError, SettingsError
from hrcreplay.store import run_folder

#: Folder inside local results in which entries are written until they are whole.
WORK = ".work"


def is_url(where: str) -> bool:
    """Returns True for a URL such as ``s3://bucket/folder``, False for a path."""
    return "://" in where


def file_system(url: str) -> tuple[Any, str]:
    """Returns the file system of a URL and the path in it.

    Raises:
        SettingsError: fsspec, or the package for this kind of URL, is not installed.
    """
    try:
        import fsspec

        system, path = fsspec.core.url_to_fs(url)
    except (ImportError, ValueError) as error:
        raise SettingsError(
            f"{url}: cannot be reached ({error}); would be right: a path, or a URL whose fsspec package is installed, "
            "as s3fs for s3://"
        ) from error
    return system, str(path)


@dataclass(frozen=True)
class ResultsFolder:
    """A folder of results; its entries are folders with names such as ``runs/walk/a=1``."""

    where: str  #: path or URL

    @property
    def path(self) -> Path | None:
        """The folder on a file system; None for a URL."""
        return None if is_url(self.where) else Path(self.where)

    def read(self, name: str) -> str | None:
        """Returns the text of a file; None if it does not exist."""
        try:
            if self.path is not None:
                return (self.path / name).read_text("utf-8")
            system, root = file_system(self.where)
            text: str = system.cat_file(f"{root}/{name}").decode("utf-8")
        except (FileNotFoundError, NotADirectoryError):
            return None
        return text

    def write(self, name: str, content: str | bytes) -> None:
        """Writes a file whole, in place of an earlier one."""
        data = content.encode("utf-8") if isinstance(content, str) else content
        if self.path is None:
            system, root = file_system(self.where)
            system.makedirs(str(PurePosixPath(root, name).parent), exist_ok=True)
            system.pipe_file(f"{root}/{name}", data)
            return
        target = self.path / name
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary = target.with_name(f".{target.name}.{uuid.uuid4().hex[:12]}")
        temporary.write_bytes(data)
        temporary.replace(target)

    def meta(self, name: str) -> dict[str, Any] | None:
        """Returns run.json of a complete run; None if there is none."""
        text = self.read(f"{name}/run.json")
        try:
            found: dict[str, Any] = json.loads(text or "{}")
        except ValueError:
            return None
        return found if found.get("complete") else None

    @contextmanager
    def workplace(self) -> Iterator[Path]:
        """An empty local folder for one piece of work; in local results, so that an entry can be renamed into place."""
        parent = None
        if self.path is not None:
            parent = self.path / WORK
            parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=parent, ignore_cleanup_errors=True) as folder:
            yield Path(folder)

    def publish(self, folder: Path, name: str) -> None:
        """Moves a complete run into place; one that another worker has published in the meantime stays."""
        if self.path is not None:
            target = self.path / name
            target.parent.mkdir(parents=True, exist_ok=True)
            try:
                folder.rename(target)
            except OSError:
                if self.meta(name) is None:
                    raise
            return
        system, root = file_system(self.where)
        files = sorted(path for path in folder.rglob("*") if path.is_file())
        for path in sorted(files, key=lambda path: path == folder / "run.json"):  # run.json last
            to = f"{root}/{name}/{path.relative_to(folder).as_posix()}"
            system.makedirs(str(PurePosixPath(to).parent), exist_ok=True)
            system.put_file(str(path), to)

    def bring(self, name: str, scratch: Path) -> Path:
        """Returns a local folder with an entry; for a URL a copy of it in ``scratch``."""
        if self.path is not None:
            return self.path / name
        system, root = file_system(self.where)
        target = scratch / "earlier"
        system.get(f"{root}/{name}", str(target), recursive=True)
        return target

    def remove(self, name: str) -> None:
        """Removes an entry, if it exists."""
        if self.path is not None:
            shutil.rmtree(self.path / name, ignore_errors=True)
            return
        system, root = file_system(self.where)
        if system.exists(f"{root}/{name}"):
            system.rm(f"{root}/{name}", recursive=True)


@cache
def _copies() -> Path:
    """Folder for the copies that this process makes of logs; removed at its end."""
    folder = Path(tempfile.mkdtemp(prefix="hrcreplay-logs-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def bring_log(log: str) -> Path:
    """Returns the local path of a log; one given by URL is copied to a temporary folder.

    A process keeps the copy of its latest log only, as the runs on one log follow one another.

    Raises:
        LogError: The log cannot be copied.
        SettingsError: This kind of URL cannot be read.
    """
    if not is_url(log):
        return Path(log)
    system, source = file_system(log)
    keep = _copies() / hashlib.sha256(log.encode()).hexdigest()[:16]
    target = keep / PurePosixPath(source.rstrip("/")).name
    if not target.exists():
        for other in _copies().iterdir():
            shutil.rmtree(other)
        keep.mkdir()
        partial = keep / "partial"
        try:
            system.get(source, str(partial), recursive=system.isdir(source))
        except OSError as error:
            raise LogError(f"{log}: cannot be read ({error}); would be right: a log") from error
        partial.rename(target)
    return target


def digest(path: Path) -> str:
    """SHA-256 of a log.

    Raises:
        LogError: Nothing is there.
    """
    if not path.exists():
        raise LogError(f"{path}: nothing is there; give a log")
    return run_folder.sha256(path)
