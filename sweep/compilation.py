"""How the numerical inner loops are compiled, and where Numba caches the compiled code.

That is the folder that `NUMBA_CACHE_DIR` names, else `__pycache__` beside the source, or the user's
cache folder where the package cannot be written to.
"""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Callable
from functools import cache, partial
from hashlib import sha256
from pathlib import Path
from typing import Any, TypeVar, cast

from sweep.errors import MachineFaultError, RunError, local_fault

try:
    numba: Any = importlib.import_module("numba")  # whose types lack options
except (ValueError, TypeError) as error:  # it reads its configuration while it is imported
    raise RunError(f"Numba cannot be imported with its NUMBA_... variables: {error}") from None

#: Rooms with compiled functions.
ROOMS = ("model", "measure", "fitting")

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function, *, forceinline: bool = False, packed: bool = False) -> Function:
    """Compile ``function`` to machine code on its first call and cache it on disk.

    IEEE arithmetic is kept in source order (no ``fastmath``), so that results do not depend on
    how loops were vectorised; the global interpreter lock is released while it runs.
    """
    dispatcher: Any = numba.njit(
        function, nogil=True, error_model="numpy", forceinline=forceinline, no_cfunc_wrapper=True
    )
    # Compilation may be switched off (AttributeError); where no folder can be written to
    # (RuntimeError), each process compiles for itself.
    with contextlib.suppress(AttributeError, RuntimeError):
        # One thread at a time, as in Numba: it changes Numba's configuration.
        alone = numba.core.compiler_lock.global_compiler_lock(_compile)
        dispatcher.compile = partial(alone, packed, dispatcher, dispatcher.compile)
        dispatcher.enable_caching()
        # Numba compares a function's own file only. It would go on using code in which a function
        # of another file is inlined as that was.
        dispatcher._cache._cache_file._source_stamp = _sources()  # noqa: SLF001
    return cast("Function", dispatcher)


#: As :func:`compiled`, for small functions that loops call: inlined in every caller. LLVM by itself
#: does not always do so, and a call costs as much as such a function: 5 to 20 ns. The arithmetic
#: stays the same.
compiled_inline = partial(compiled, forceinline=True)

#: As :func:`compiled`; several like statements on neighbours in memory are computed at once (LLVM's
#: SLP vectoriser, which Numba leaves out). The arithmetic stays the same.
compiled_packed = partial(compiled, packed=True)


def _compile(packed: bool, dispatcher: Any, compile_signature: Any, signature: Any) -> Any:
    """Compile or load a function for a signature.

    Constants of a caller count as integers: not once for each constant.
    """
    config = numba.config
    before, config.SLP_VECTORIZE = config.SLP_VECTORIZE, packed
    try:
        return compile_signature(tuple(map(numba.types.unliteral, signature)))
    except (numba.errors.NumbaError, MachineFaultError):
        raise
    except Exception as error:
        raise local_fault(
            f"compiled code in {dispatcher.stats.cache_path} cannot be loaded or saved "
            f"({type(error).__name__}: {error}): delete its .nbi and .nbc files"
        ) from error
    finally:
        config.SLP_VECTORIZE = before  # a caller's, whose compilation compiles what it calls


@cache
def _sources() -> str:
    """Return a digest of all files that may have compiled functions, and of this one.

    A constant that compiled code uses must be declared in one of these, too.
    """
    files = (each for room in ROOMS for each in sorted(Path(__file__).parent.glob(f"{room}/*.py")))
    return sha256(b"".join(each.read_bytes() for each in (*files, Path(__file__)))).hexdigest()
