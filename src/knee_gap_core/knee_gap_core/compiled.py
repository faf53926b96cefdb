"""Compilation of the numerical kernels, with a cache on disk that follows every kernel's source."""

import ast
import sys
from collections.abc import Callable, Iterator
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any, TypeVar, overload

import numba

# What `fastmath` lets the compiler assume: no NaN, and sums in any order. Infinities stay infinities.
FAST = {"nnan", "nsz", "reassoc", "contract"}

# Packages whose sources a kernel may be built on; everything else has a version and does not change in place.
OURS = "knee_gap_"

Function = TypeVar("Function", bound=Callable[..., Any])


@cache
def sources(path: Path) -> frozenset[Path]:
    """Source files that a module is built on: its own, and those of our packages that it imports, and so on.

    Imports are followed by their dotted names from the root of each package, in every form that Python has,
    wherever in the file they stand.
    """
    found: set[Path] = set()
    waiting = [path]
    while waiting:
        current = waiting.pop()
        if current not in found:
            found.add(current)
            waiting += _imported_files(current)
    return frozenset(found)


@cache
def sources_digest(path: Path) -> str:
    """Digest of everything that the compiled functions of a module are made from."""
    return sha256(b"".join(source.read_bytes() for source in sorted(sources(path)))).hexdigest()[:12]


@cache
def _imported_files(path: Path) -> tuple[Path, ...]:
    """Files of our packages that a file imports itself."""
    package = _package_of(path)
    files = (_file_of(name, path) for name in _imported_names(ast.parse(path.read_bytes()), package))
    return tuple(dict.fromkeys(file for file in files if file is not None))


def _imported_names(tree: ast.Module, package: tuple[str, ...]) -> Iterator[str]:
    """Dotted names that may be modules: `from a import b` imports `a`, and `a.b` if that is one."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else ()
            module = ".".join([*above, *([node.module] if node.module else [])])
            yield module
            yield from (f"{module}.{alias.name}" for alias in node.names)


def _package_of(path: Path) -> tuple[str, ...]:
    """Names of the packages that a file lies in, the outermost first."""
    names: list[str] = []
    folder = path.parent
    while (folder / "__init__.py").is_file():
        names.insert(0, folder.name)
        folder = folder.parent
    return tuple(names)


def _file_of(name: str, importer: Path) -> Path | None:
    """Source file of a module of our packages by its dotted name; None for anything else."""
    top, *rest = name.split(".")
    own = _package_of(importer)
    if own and top == own[0]:
        root = importer.parents[len(own) - 1]
    elif top.startswith(OURS) and getattr(sys.modules.get(top), "__file__", None):
        root = Path(str(sys.modules[top].__file__)).parent
    else:
        return None
    stem = root.joinpath(*rest)
    return next((file for file in (stem.with_suffix(".py"), stem / "__init__.py") if file.is_file()), None)


@overload
def compiled(function: Function, /) -> Function: ...
@overload
def compiled(
    *, fastmath: bool = False, inlined: bool = False, nogil: bool = False
) -> Callable[[Function], Function]: ...
def compiled(
    function: Callable[..., Any] | None = None,
    *,
    fastmath: bool = False,
    inlined: bool = False,
    nogil: bool = False,
) -> Any:
    """Decorate a function to be compiled by numba at its first call and kept on disk for the next process.

    numba renews a cached function only if its own file changes, although it holds the code of all the
    functions it calls; with the digest of all sources in its name, an edit of any of them renews it. Where
    nothing is writable the function is compiled again in each process.

    `fastmath` lets sums be reordered; `inlined` copies the function into its callers, for the innermost ones
    that receive many arrays; `nogil` lets other threads run meanwhile.
    """
    options: dict[str, Any] = {
        "error_model": "numpy",
        "fastmath": FAST if fastmath else False,
        "inline": "always" if inlined else "never",
        "nogil": nogil,
    }

    def decorate(function: Callable[..., Any]) -> Any:
        function.__qualname__ += f"_{sources_digest(Path(function.__code__.co_filename))}"
        try:
            return numba.njit(cache=True, **options)(function)
        except RuntimeError:
            return numba.njit(**options)(function)

    return decorate if function is None else decorate(function)
