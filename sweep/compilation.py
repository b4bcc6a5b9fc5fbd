"""How the numerical inner loops are compiled: one set of Numba options for all of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function) -> Function:
    """Compile ``function`` to machine code on its first call and cache it on disk.

    IEEE arithmetic is kept in source order (no ``fastmath``), so that results do not depend on
    how loops were vectorised; the global interpreter lock is released while it runs.
    """
    return cast("Function", numba.njit(cache=True, nogil=True, error_model="numpy")(function))
