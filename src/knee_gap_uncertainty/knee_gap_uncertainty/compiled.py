"""Compiling the numerical kernels, with a cache on disk that follows every kernel's source."""

import re
from collections.abc import Callable
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

import numba

# What `fastmath` lets the compiler assume: no NaN, and sums in any order. Infinities stay infinities.
FAST = {"nnan", "nsz", "reassoc", "contract"}

IMPORTED = re.compile(r"^from knee_gap_uncertainty\.(\w+) import", re.MULTILINE)


@cache
def sources(module: str) -> frozenset[Path]:
    """Source files of a module of this package and of all those of this package it is built on."""
    path = Path(__file__).with_name(f"{module}.py")
    found = {path}
    for imported in IMPORTED.findall(path.read_text(encoding="utf-8")):
        found |= sources(imported)
    return frozenset(found)


@cache
def sources_digest(module: str) -> str:
    """Digest of everything that the compiled functions of a module of this package are made from."""
    return sha256(b"".join(path.read_bytes() for path in sorted(sources(module)))).hexdigest()[:12]


def compiled(
    function: Callable[..., Any] | None = None, *, fastmath: bool = False, inlined: bool = False
) -> Any:
    """Decorate a function to be compiled by numba at its first call and kept on disk for the next process.

    numba renews a cached function only when its own file changes, although it holds the code of all the
    functions it calls; with the digest of all sources in its name, an edit of any of them renews it. Where
    nothing is writable the function is compiled anew in each process.

    `fastmath` lets sums be reordered; `inlined` copies the function into its callers, for the innermost ones
    that are handed many arrays.
    """
    if function is None:
        return lambda decorated: compiled(decorated, fastmath=fastmath, inlined=inlined)
    function.__qualname__ += f"_{sources_digest(Path(function.__code__.co_filename).stem)}"
    options: dict[str, Any] = {
        "error_model": "numpy",
        "fastmath": FAST if fastmath else False,
        "inline": "always" if inlined else "never",
    }
    try:
        return numba.njit(cache=True, **options)(function)
    except RuntimeError:
        return numba.njit(**options)(function)
