"""The drawn joint of the tests of perception."""

import importlib.util
from pathlib import Path
from typing import Any

import pytest

_PATH = Path(__file__).parents[1] / "perception" / "conftest.py"
_SPEC = importlib.util.spec_from_file_location("drawn_joint", _PATH)
assert _SPEC is not None
assert _SPEC.loader is not None
_DRAWN = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(_DRAWN)


@pytest.fixture(scope="session")
def joint() -> Any:
    """As in the tests of perception."""
    camera = _DRAWN.FisheyeCamera(1280, 720, 458.4, 458.4, 640.0, 360.0)
    return _DRAWN.Joint(camera, _DRAWN._texture(4))
