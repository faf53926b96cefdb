"""Rewrite the builder's include paths in ROS's wheels to those of this interpreter.

The wheels' exported CMake targets name the Python and numpy headers of the machine that compiled them, and
CMake refuses to configure against folders that do not exist.
"""

import re
import sys
import sysconfig
from pathlib import Path

import numpy

FOREIGN_NUMPY = re.compile(r'[^;"\s]*/(?:site|dist)-packages/numpy/(?:_core|core)/include')
FOREIGN_PYTHON = re.compile(r'/opt/python/[^;"\s]*/include/python3\.\d+')


def mend(prefix: Path) -> int:
    """Mend every exported CMake file below `prefix`; return how many were changed."""
    changed = 0
    for path in sorted(prefix.glob("share/*/cmake/*.cmake")):
        text = path.read_text()
        mended = FOREIGN_NUMPY.sub(numpy.get_include(), text)
        mended = FOREIGN_PYTHON.sub(sysconfig.get_path("include"), mended)
        if mended != text:
            # A new file, because this one may be a hard link into the installer's cache.
            fresh = path.with_suffix(".mended")
            fresh.write_text(mended)
            fresh.replace(path)
            changed += 1
    return changed


if __name__ == "__main__":
    print(f"setup: mended {mend(Path(sys.argv[1]))} exported CMake files of the ROS wheels")
