"""Where stores are: local paths and URLs, and how Zarr reaches them."""

from __future__ import annotations

import contextlib
import json
import os
import re
import weakref
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import unquote, urlsplit

import zarr
import zarr.errors
from zarr.abc.store import Store
from zarr.storage import FsspecStore, LocalStore

from sweep.errors import StoreError
from sweep.messages import nearest_file, plain
from sweep.store.files import check_folder_writable, read_files

# --------------------------------------------------------------------------------------------------
# Where stores lie: their URLs, the folder that a run holds, and a remote store's pointer.
#
# No path is written by two runs. On this machine, a run holds its store by the folder that it
# opened, wherever that is moved; a remote store's data lie under the run's id, to which the
# store's URL points.

#: Attribute at a remote store's URL: the id of the run whose data are the store's.
POINTER = "sweep_run"


def is_remote(url: str) -> bool:
    """Return whether a store is not a local path."""
    return "://" in url


def not_a_store(url: str) -> str:
    """Return the message for something that ``sweep run`` did not create."""
    if not is_remote(url) and Path(url).is_file() and Path(url).suffix.lower() == ".toml":
        return (
            f"{url}: not a sweep store, but a pipeline file; `sweep run {plain(url)}` makes its "
            f"store, by default runs/{plain(Path(url).stem)}.zarr"
        )
    return f"{url}: not a sweep store, which `sweep run FILE.toml` makes; choose another path"


@contextlib.contextmanager
def translate_errors(url: str, action: str) -> Iterator[None]:
    """Turn errors of a disk or a server into a StoreError: ``url: cannot be <action>: reason``."""
    try:
        yield
    except (StoreError, zarr.errors.BaseZarrError):
        raise
    except Exception as error:
        # The libraries of remote stores raise errors of many kinds that are no OSError.
        own = type(error).__module__.partition(".")[0] in ("sweep", "zarr", "builtins", "numpy")
        if not isinstance(error, OSError) and (own or not is_remote(url)):
            raise
        raise StoreError(f"{url}: cannot be {action}: {reason_of(error)}") from None


def reason_of(error: BaseException) -> str:
    """Return an error's reason in one short line."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return " ".join(str(error).split())[:200] or type(error).__name__


def checked_url(url: str) -> str:
    """Return a store's path or URL.

    Raises
    ------
    StoreError
        If it holds what must not be recorded or printed, or names a place that other processes
        cannot see or that a path names.
    """
    scheme, colon, _ = url.lower().partition(":")
    problem = ""
    if not url.strip():
        problem = "expected the path or URL of a store"
    elif colon and scheme in ("file", "local"):
        problem = f"a store on this machine is named by its path: {unquote(urlsplit(url).path)}"
    elif colon and scheme == "memory":
        problem = "no other process sees this one's memory; choose a path or s3://"
    elif url.partition("/")[0] == "~":
        problem = (f"~ is not expanded here; expected {Path(url).expanduser()}, or ./{url} for a "
                   "folder of that name")
    if problem:
        raise StoreError(f"{url if url.strip() else repr(url)}: {problem}")
    scheme, _, rest = url.partition("://")
    if rest and ("::" in scheme or any(sign in rest for sign in ("@", "?", "#", "://", "::"))):
        raise StoreError(
            f"{scheme}://...: a store's URL is printed and recorded: expected no credentials "
            "or options in it; pass them in the environment (AWS_ACCESS_KEY_ID, ...)"
        )
    return url.rstrip("/") if is_remote(url) else url


def absolute_url(url: str) -> str:
    """Return a store's address as every process of this machine understands it."""
    return url if is_remote(checked_url(url)) else str(Path(url).absolute())


def storage_at(url: str, *, read_only: bool) -> Store:
    """Return the Zarr storage at a URL, whatever lies there."""
    if not is_remote(url):
        # Absolute: a lazy dataset may be read by another process, in another working folder.
        return LocalStore(Path(url).absolute(), read_only=read_only)
    try:
        # Without a cache of listings: others write the store at the same time.
        return FsspecStore.from_url(
            url, storage_options={"use_listings_cache": False}, read_only=read_only
        )
    except Exception as error:
        # Each protocol's library raises its own: of github:// a TypeError without a repository.
        raise StoreError(f"{url}: cannot be reached: {reason_of(error)}") from None


def remote_run_id(url: str) -> str | None:
    """Return the id of the run that a remote store's URL points to; None if there is no store."""
    storage = storage_at(url, read_only=True)
    try:
        content = read_files(storage, ["zarr.json"])[0]
    except Exception as error:
        # Also a ValueError: of a port that is no port, say.
        raise StoreError(f"{url}: cannot be reached: {reason_of(error)}") from None
    if content is None:
        return None
    with contextlib.suppress(ValueError, KeyError, TypeError):
        run_id = json.loads(content)["attributes"][POINTER]
        if re.fullmatch("[0-9a-f]{32}", run_id):
            return str(run_id)
    raise StoreError(not_a_store(url))


def exists(url: str) -> bool:
    """Return whether anything lies at a store's URL.

    Raises
    ------
    StoreError
        If that cannot be told: a folder cannot be searched, a name is too long, a server is away.
    """
    if is_remote(checked_url(url)):
        return remote_run_id(url) is not None
    try:
        os.lstat(url)
        with contextlib.suppress(FileNotFoundError):  # a link to nothing lies there, too
            os.stat(url)  # noqa: PTH116  (as os.lstat)
    except (FileNotFoundError, NotADirectoryError):
        return False
    except (OSError, ValueError) as error:  # of a name with a zero byte
        raise StoreError(f"{plain(url, 300)}: cannot be read: {reason_of(error)}") from None
    return True


def open_storage(url: str, mode: str = "r") -> Store:
    """Return the storage that holds a store's files.

    With ``mode`` "r+" a local store is held by its folder: writes go to that folder even if
    another store has since taken its path.

    Raises
    ------
    StoreError
        If there is no store.
    """
    url = checked_url(url)
    if not exists(url):
        raise StoreError(f"{url}: store not found{_similar(url)}")
    if is_remote(url):
        return storage_at(f"{url}/{remote_run_id(url)}", read_only=mode == "r")
    with translate_errors(url, "read"):
        if not Path(url).is_dir():
            raise StoreError(not_a_store(url))
        if mode == "r":
            return storage_at(url, read_only=True)
        # The folder is held open as long as the storage lives.
        descriptor = os.open(url, os.O_RDONLY | os.O_DIRECTORY)
        storage = LocalStore(f"/proc/self/fd/{descriptor}")
        weakref.finalize(storage, os.close, descriptor)
        return storage


def _similar(url: str) -> str:
    """Return the store that may be meant where there is none, or how one is made."""
    if not is_remote(url):
        for other in (f"{url}.zarr", f"runs/{Path(url).name}", f"runs/{Path(url).name}.zarr"):
            if (Path(other) / "zarr.json").is_file():
                return f"; did you mean {plain(other)}?"
        if similar := nearest_file(url) or nearest_file(Path("runs") / Path(url).name):
            return similar
    return "; create one with `sweep run`"


def enclosing_store(path: Path) -> Path | None:
    """Return the outermost store that a local path is, or lies in; None if there is none."""
    resolved = Path(os.path.realpath(path))
    folders = (*reversed(resolved.parents), resolved)
    return next((folder for folder in folders if (folder / "zarr.json").is_file()), None)


def check_writable(url: str) -> None:
    """Check that a store can be created at a URL, before any work is done for it.

    Raises
    ------
    StoreError
        If nothing can be written there, or it is inside another store.
    """
    if is_remote(checked_url(url)):
        if url.partition("://")[0].lower() in ("http", "https"):
            raise StoreError(f"{url}: can only be read; choose a path or s3://")
        return
    with translate_errors(url, "written"):
        around = enclosing_store(Path(url).absolute().parent)
        if around is not None:
            raise StoreError(f"{url}: cannot be written: it is inside the store {around}")
        with contextlib.suppress(FileExistsError):  # a file, which cannot hold a folder
            Path(url).parent.mkdir(parents=True, exist_ok=True)
        check_folder_writable(Path(url).parent)
