"""Compiling the numerical kernels, with a cache on disk that follows every kernel's source."""

from collections.abc import Callable
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

import numba

MARK = "@compiled"
# What `fastmath` lets the compiler assume: no NaN, and sums in any order. Infinities stay infinities.
FAST = {"nnan", "nsz", "reassoc", "contract"}


@cache
def sources_digest() -> str:
    """Digest of all modules of this package that hold compiled functions."""
    sources = [path.read_bytes() for path in sorted(Path(__file__).parent.glob("*.py"))]
    return sha256(b"".join(source for source in sources if MARK.encode() in source)).hexdigest()[:12]


def compiled(function: Callable[..., Any] | None = None, *, fastmath: bool = False) -> Any:
    """Decorate a function to be compiled by numba at its first call and kept on disk for the next process.

    numba renews a cached function only when its own file changes, although it holds the code of all the
    functions it calls; with the digest of all sources in its name, an edit of any of them renews it. Where
    nothing is writable the function is compiled anew in each process.
    """
    if function is None:
        return lambda decorated: compiled(decorated, fastmath=fastmath)
    function.__qualname__ += f"_{sources_digest()}"
    options: dict[str, Any] = {"error_model": "numpy", "fastmath": FAST if fastmath else False}
    try:
        return numba.njit(cache=True, **options)(function)
    except RuntimeError:
        return numba.njit(**options)(function)
