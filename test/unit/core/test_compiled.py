"""The cache of compiled kernels follows every source that a kernel is built on, also in sub-packages."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from knee_gap_core.compiled import sources
from knee_gap_uncertainty.two_view import gap_range

KERNEL = """
from knee_gap_core.compiled import compiled
{imports}

@compiled
def kernel():
    return {call}
"""

CALLED = """
from knee_gap_core.compiled import compiled

@compiled
def called():
    return {value}
"""

FORMS = {
    "from package.sub.module import name": ("from somewhere.lower.called import called", "called()"),
    "from package.sub import module": ("from somewhere.lower import called as other", "other.called()"),
    "import package.sub.module": (
        "import somewhere.lower.called\nfar = somewhere.lower.called.called",
        "far()",
    ),
    "import in parentheses": ("from somewhere.lower.called import (\n    called,\n)", "called()"),
    "relative, next door": ("from ..lower.called import called", "called()"),
    "relative, of a module": ("from ..lower import called as other", "other.called()"),
    "through a third module": ("from somewhere.upper.between import called", "called()"),
    "through a package that passes it on": ("from somewhere.passing import called", "called()"),
}


def write_package(folder: Path, form: str) -> Path:
    """A package whose kernel in one sub-package calls a function in another; path of the kernel's file."""
    imports, call = FORMS[form]
    for name in ("", "upper", "lower", "passing"):
        (folder / "somewhere" / name).mkdir(parents=True, exist_ok=True)
        (folder / "somewhere" / name / "__init__.py").write_text("")
    (folder / "somewhere/passing/__init__.py").write_text("from somewhere.lower.called import called\n")
    (folder / "somewhere/upper/between.py").write_text("from somewhere.lower.called import called\n")
    (folder / "somewhere/upper/unused.py").write_text("import somewhere.upper.kernel\n")
    (folder / "somewhere/lower/called.py").write_text(CALLED.format(value=1))
    kernel = folder / "somewhere/upper/kernel.py"
    kernel.write_text(KERNEL.format(imports=imports, call=call))
    return kernel


def run(folder: Path) -> str:
    program = (
        "from somewhere.upper.kernel import kernel\nprint(kernel(), sum(kernel.stats.cache_hits.values()))"
    )
    environment = {**os.environ, "PYTHONPATH": f"{folder}:{os.environ.get('PYTHONPATH', '')}"}
    done = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True
    )
    return done.stdout.strip()


@pytest.mark.parametrize("form", FORMS)
def test_sources_are_followed_through_every_form_of_import(tmp_path, form):
    found = sources(write_package(tmp_path, form))
    assert tmp_path / "somewhere/lower/called.py" in found
    assert tmp_path / "somewhere/upper/unused.py" not in found


def test_modules_that_import_each_other_end(tmp_path):
    kernel = write_package(tmp_path, "relative, next door")
    called = tmp_path / "somewhere/lower/called.py"
    called.write_text("import somewhere.upper.kernel\n" + called.read_text())
    assert sources(kernel) == sources(called)


def test_an_edit_in_another_sub_package_renews_the_kernel_on_disk(tmp_path):
    write_package(tmp_path, "through a third module")
    assert run(tmp_path) == "1 0"
    assert run(tmp_path) == "1 1"
    (tmp_path / "somewhere/lower/called.py").write_text(CALLED.format(value=2))
    assert run(tmp_path) == "2 0"


def test_the_gap_range_is_built_on_the_vectors_and_on_the_way_of_compiling() -> None:
    names = {path.stem for path in sources(Path(gap_range.__file__))}
    assert {"gap_range", "error_cloud", "slices", "vectors", "compiled"} <= names
    assert "uncertainty_node" not in names
