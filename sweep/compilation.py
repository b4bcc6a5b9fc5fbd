"""How the numerical inner loops are compiled, and where the compiled code is cached.

Only the functions of this package are affected: Numba's own configuration is read, never changed,
so that functions which a caller compiles are cached where the caller's Numba caches them.
"""

from __future__ import annotations

import contextlib
import gc
import os
import pickle
import stat
import tempfile
from collections.abc import Callable, Iterator
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any, TypeVar, cast

from sweep.errors import RunError

try:
    import numba
    from numba.core.caching import (
        CompileResultCacheImpl,
        FunctionCache,
        IndexDataCacheFile,
        _CacheLocator,
    )
except (ValueError, TypeError) as error:
    # Numba interprets its configuration while it is imported.
    raise RunError(
        f"Numba cannot be imported with its NUMBA_... variables: {type(error).__name__}: {error}"
    ) from None

Function = TypeVar("Function", bound=Callable[..., Any])


@cache
def compiled_sources() -> tuple[Path, ...]:
    """Return the files with compiled functions, and this one, which has the options."""
    package = Path(__file__).parent
    files = sorted([*package.glob("model/*.py"), *package.glob("measure/*.py")])
    return (*(file for file in files if b"\n@compiled" in file.read_bytes()), Path(__file__))


@cache
def sources_digest() -> str:
    """Return a digest of all source that is compiled.

    Numba itself compares a function's own file only, and would go on using what it compiled from
    an older version of a function in another file. A constant that compiled code uses must be
    declared in one of these files, too.
    """
    digest = sha256()
    for path in compiled_sources():
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


@cache
def cache_folder() -> Path | None:
    """Return the folder of the compiled code of these sources; None if no folder is writable.

    In this order: ``NUMBA_CACHE_DIR``, the package's own ``__pycache__``, ``~/.cache/sweep``, a
    private folder among the temporary files.
    """
    name = f"compiled-{sources_digest()}"
    for folder in _folders():
        # `os.path.exists`: what cannot be looked at is not there.
        existing = next(above for above in (folder, *folder.parents) if os.path.exists(above))  # noqa: PTH110
        if existing.is_dir() and os.access(existing, os.W_OK | os.X_OK):
            return folder / name
    private = _private_folder()
    return private and private / name


def _folders() -> Iterator[Path]:
    """Yield the folders that are tried, in order."""
    config: Any = numba.config
    if config.CACHE_DIR:
        yield Path(config.CACHE_DIR).absolute()
    yield Path(__file__).parent.absolute() / "__pycache__"
    try:
        yield Path.home() / ".cache" / "sweep"
    except (RuntimeError, KeyError):
        # Without HOME and without an entry for the user there is no home.
        return


def _private_folder() -> Path | None:
    """Return this user's folder among the temporary files; None if nobody else may be kept out.

    Compiled code is executed: a folder that others can write to, or own, is not used.
    """
    user = os.getuid() if hasattr(os, "getuid") else 0
    try:
        folder = Path(tempfile.gettempdir()) / f"sweep-{user}"
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.lstat()
    except OSError:
        return None
    private = stat.S_ISDIR(status.st_mode) and not status.st_mode & 0o077
    return folder if private and status.st_uid == user else None


class _Locator(_CacheLocator):
    """Where Numba finds the compiled code of one function of this package."""

    def __init__(self, line: int) -> None:
        self._line = line

    def get_cache_path(self) -> str:
        """Return the folder."""
        return str(cache_folder())

    def get_source_stamp(self) -> str:
        """Return the digest of all compiled source."""
        return sources_digest()

    def get_disambiguator(self) -> str:
        """Return what distinguishes functions of one name in one file."""
        return str(self._line)

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> _Locator:  # noqa: ARG003  (Numba's)
        """Return the locator of a function."""
        return cls(py_func.__code__.co_firstlineno)


class _Implementation(CompileResultCacheImpl):
    _locator_classes: Any = (_Locator,)


_CacheFiles: Any = IndexDataCacheFile  # Numba has no type information


class _CacheFile(_CacheFiles):  # type: ignore[misc]
    """The files of one function's compiled code, each headed by a digest of the rest.

    Numba trusts what it reads: a flipped byte of machine code would compute something else. A file
    that cannot be read, or is not as it was written, counts as missing.
    """

    def _load_index(self) -> Any:
        content = _sealed_content(self._index_path)
        if content is None:
            return {}
        stamp, overloads = pickle.loads(content)  # noqa: S301  (what this package has sealed)
        return overloads if stamp == (self._version, self._source_stamp) else {}

    def _save_index(self, overloads: Any) -> None:
        self._seal(self._index_path, ((self._version, self._source_stamp), overloads))

    def _load_data(self, name: str) -> Any:
        content = _sealed_content(self._data_path(name))
        if content is None:
            raise FileNotFoundError(name)
        return pickle.loads(content)  # noqa: S301  (as above)

    def _save_data(self, name: str, data: Any) -> None:
        self._seal(self._data_path(name), data)

    def _seal(self, path: str, content: Any) -> None:
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        encoded = self._dump(content)
        with self._open_for_write(path) as file:
            file.write(sha256(encoded).digest() + encoded)


def _sealed_content(path: str) -> bytes | None:
    """Return what a file holds behind its digest; None if it is missing or changed."""
    try:
        sealed = Path(path).read_bytes()
    except OSError:
        return None
    size = sha256().digest_size
    return sealed[size:] if sha256(sealed[size:]).digest() == sealed[:size] else None


_FunctionCache: Any = FunctionCache


class _Cache(_FunctionCache):  # type: ignore[misc]
    """Numba's cache of one function, in this package's folder.

    A file that cannot be read or written costs a compilation, never the result. If the folder
    cannot be used (it is full, say), one among the temporary files takes its place.
    """

    _impl_class = _Implementation

    def __init__(self, function: Any) -> None:
        super().__init__(function)
        self._cache_file = self._file(self._cache_path)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the compiled code for a signature; None if it is not cached."""
        target_context.refresh()
        key = self._index_key(sig, target_context.codegen())
        for file in self._files(create=False):
            try:
                data = file.load(key)
                if data is not None:
                    return self._impl.rebuild(target_context, data)
            except Exception:  # noqa: S112  (an old version of a library may have written it)
                continue
        return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Save the compiled code for a signature, if it can be."""
        if not self._impl.check_cachable(data):
            return
        key, reduced = self._index_key(sig, data.codegen), self._impl.reduce(data)
        for file in self._files(create=True):
            with contextlib.suppress(Exception):
                file.save(key, reduced)
                return

    def _file(self, folder: str) -> Any:
        return _CacheFile(folder, self._impl.filename_base, self._impl.locator.get_source_stamp())

    def _files(self, *, create: bool) -> Iterator[Any]:
        """Yield where the code may be: in the package's folder, or in the one in its place."""
        yield self._cache_file
        private = _substitute_folder()
        if create or private.exists():
            folder = _private_folder()
            if folder is not None and str(private) != self._cache_path:
                yield self._file(str(private))


def _substitute_folder() -> Path:
    """Return the folder among the temporary files; it need not exist."""
    user = os.getuid() if hasattr(os, "getuid") else 0
    return Path(tempfile.gettempdir()) / f"sweep-{user}" / f"compiled-{sources_digest()}"


def is_compiled(name: str) -> bool:
    """Return whether a function, as ``"module.function"``, is in the cache of these sources."""
    folders = {cache_folder(), _substitute_folder()} - {None}
    return any(any(folder.glob(f"{name}-*.nbi")) for folder in folders if folder is not None)


def compiled(function: Function) -> Function:
    """Compile ``function`` to machine code on its first call and cache it on disk.

    IEEE arithmetic is kept in source order (no ``fastmath``), so that results do not depend on
    how loops were vectorised; the global interpreter lock is released while it runs.
    """
    return _compiled(function, forceinline=False)


def compiled_inline(function: Function) -> Function:
    """As :func:`compiled`, for small functions that loops call: inlined in every caller.

    LLVM by itself does not always do so, and a call costs as much as such a function: 5 to 20 ns.
    The arithmetic stays the same.
    """
    return _compiled(function, forceinline=True)


def _compiled(function: Function, forceinline: bool) -> Function:
    """Return a compiled function, cached in this package's folder."""
    njit: Any = numba.njit
    dispatcher: Any = njit(
        nogil=True, error_model="numpy", forceinline=forceinline, no_cfunc_wrapper=True
    )(function)
    if not hasattr(dispatcher, "enable_caching"):
        return cast("Function", dispatcher)  # compilation is switched off
    if cache_folder() is not None:
        # What `cache=True` does, with a folder of the package's own.
        dispatcher._cache = _Cache(function)  # noqa: SLF001
    compile_signature = dispatcher.compile

    def compile_quickly(signature: Any) -> Any:
        """Compile for integers where a caller has constants: not once for each constant.

        The collector of garbage waits meanwhile: it would take a tenth of the time.
        """
        collecting = gc.isenabled()
        gc.disable()
        try:
            return compile_signature(tuple(map(numba.types.unliteral, signature)))
        finally:
            if collecting:
                gc.enable()

    dispatcher.compile = compile_quickly
    return cast("Function", dispatcher)


@cache
def processor() -> str:
    """Return a short name of everything in this machine that the last bits of results depend on.

    It covers the routines that OpenCV and NumPy choose by the processor's features, and the
    results of the mathematical and linear algebra libraries for fixed numbers: none of them shows
    in the others, and code that Numba compiles gives the same bits on all.
    """
    import platform  # noqa: PLC0415  (slow to import; compiled code needs none of these)

    import cv2  # noqa: PLC0415
    import numpy as np  # noqa: PLC0415

    x = np.linspace(-3.0, 3.0, 64 * 64).reshape(64, 64)
    parts = [
        platform.machine(),
        cv2.getCPUFeaturesLine(),
        cv2.ipp.getIppVersion(),
        str(np.lib.introspect.opt_func_info(func_name="^(sin|cos|tan|exp|arctan)$")),
        *(f(x).tobytes().hex() for f in (np.sin, np.cos, np.tan, np.arctan, np.exp)),
        (np.sin(x) @ np.cos(x)).tobytes().hex(),
        cv2.solve(np.sin(x * x), np.cos(x), flags=cv2.DECOMP_LU)[1].tobytes().hex(),
    ]
    return sha256("\n".join(parts).encode()).hexdigest()[:12]
