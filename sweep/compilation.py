"""How the numerical inner loops are compiled: one set of Numba options for all of them."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., Any])


def _cache_folder() -> str:
    """Return a folder for compiled code that is named by the digest of all source it is made of.

    Numba itself checks a function's own file only, and would continue to use code that it compiled
    from an older version of a function in another file. Empty, so Numba's own choice, if no folder
    can be written.
    """
    package = Path(__file__).parent
    digest = sha256()
    for path in sorted([*package.glob("model/*.py"), *package.glob("measure/*.py")]):
        digest.update(path.read_bytes())
    config: Any = numba.config
    kept = Path(config.CACHE_DIR or package / "__pycache__")
    for folder in (kept.absolute(), Path.home() / ".cache" / "sweep"):
        there = next(above for above in (folder, *folder.parents) if above.exists())
        if os.access(there, os.W_OK):
            return str(folder / f"compiled-{digest.hexdigest()[:16]}")
    return str(config.CACHE_DIR)


CACHE_FOLDER = _cache_folder()


def compiled(function: Function) -> Function:
    """Compile ``function`` to machine code on its first call and cache it on disk.

    IEEE arithmetic is kept in source order (no ``fastmath``), so that results do not depend on
    how loops were vectorised; the global interpreter lock is released while it runs.
    """
    config: Any = numba.config
    before = config.CACHE_DIR
    config.CACHE_DIR = CACHE_FOLDER  # Numba reads it here; the caller's functions have their own
    try:
        return cast("Function", numba.njit(cache=True, nogil=True, error_model="numpy")(function))
    finally:
        config.CACHE_DIR = before


@cache
def processor() -> str:
    """Return a short name of what last bits of the numbers depend on in this machine.

    The routines that OpenCV and NumPy choose by the processor's features, and what the
    mathematical and the linear algebra libraries give for fixed numbers: none of them shows in the
    others, and code that Numba compiles gives the same bits on all.
    """
    import platform  # noqa: PLC0415  (what is compiled needs none of these)

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
