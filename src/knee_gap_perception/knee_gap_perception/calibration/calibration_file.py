"""Calibration file of one scope (YAML), with a hash that identifies the calibration in results."""

import contextlib
import os
from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml import YAML

from knee_gap_core.user_files import FileError, read_yaml
from knee_gap_core.values.arrays import Array
from knee_gap_perception.calibration.calibration import (
    Calibration,
    Clock,
    LensOnBody,
    Oblique,
    Tip,
    content_of,
)
from knee_gap_perception.calibration.calibration_rules import broken_rule
from knee_gap_perception.camera.intrinsics import Intrinsics
from knee_gap_perception.camera.medium import AIR, medium_of
from knee_gap_perception.errors import PerceptionError
from knee_gap_perception.scope_rotation.notch import NotchShape
from knee_gap_perception.scope_rotation.shaft_axis import Mount, ShaftAxis

FORMAT = "knee_gap_calibration 1"


def save_calibration(calibration: Calibration, path: Path) -> None:
    """Write a calibration; the file is written completely or not at all.

    Raises PerceptionError if the calibration would not be valid when read, or if it cannot be written.
    """
    if flaw := broken_rule(calibration):
        raise PerceptionError(f"this calibration cannot be used: {flaw}; record again")
    content = {"format": FORMAT, "hash": calibration.hash, **content_of(calibration)}
    partial = path.with_name(path.name + ".part")
    yaml = YAML()
    yaml.default_flow_style = None
    yaml.width = 200
    try:
        with partial.open("w", encoding="utf-8") as file:
            yaml.dump(content, file)
        partial.replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):
            partial.unlink()
        raise PerceptionError(f"{path} cannot be written: {error.strerror}") from None


def require_place(path: Path) -> None:
    """Raise PerceptionError if a calibration cannot be written there, before minutes of computation."""
    is_other = os.path.lexists(path) and not path.is_file()
    if is_other or not path.parent.is_dir() or not os.access(path.parent, os.W_OK):
        raise PerceptionError(f"{path} cannot be written: name a file in a writable folder")


def load_calibration(path: Path) -> Calibration:
    """Read a calibration.

    Raises PerceptionError if the file is missing, not a calibration, incomplete, or was changed by hand.
    """
    try:
        content = read_yaml(path)
    except FileError as error:
        raise PerceptionError(f"the calibration cannot be read: {error}") from None
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise PerceptionError(f"{path} is not a calibration: its format must be '{FORMAT}'")
    try:
        calibration = _from_dict(content)
    except KeyError as error:
        raise PerceptionError(f"the calibration {path} is incomplete: {error} is missing") from None
    except (TypeError, ValueError, AttributeError, OverflowError) as error:
        reason = " ".join(str(error).split())
        raise PerceptionError(f"the calibration {path} is incomplete or malformed: {reason}") from None
    if calibration.hash != content.get("hash"):
        raise PerceptionError(
            f"the calibration {path} does not match its hash: it was changed by hand or damaged; calibrate "
            "again"
        )
    if flaw := broken_rule(calibration):
        raise PerceptionError(f"the calibration {path} cannot be used: {flaw}; calibrate again")
    return calibration


def _from_dict(content: dict[str, Any]) -> Calibration:
    image = content["image"]
    width, height = int(image["width_px"]), int(image["height_px"])
    return Calibration(
        width,
        height,
        _camera(content["camera"], width, height) if "camera" in content else None,
        _lens(content["lens"]) if "lens" in content else None,
        _oblique(content["oblique"]) if "oblique" in content else None,
        _tip(content["tip"]) if "tip" in content else None,
        _clock(content["clock"]) if "clock" in content else None,
        medium_of(content["medium"], "its medium") if "medium" in content else AIR,
    )


def _camera(values: dict[str, Any], width: int, height: int) -> Intrinsics:
    k, d = (tuple(float(value) for value in values[name]) for name in ("k", "d"))
    size = 4 + len(d)
    return Intrinsics(
        width=width,
        height=height,
        distortion_model=str(values["distortion_model"]),
        k=k,
        d=d,
        covariance=_array(values["covariance"], size, size),
        rms_px=float(values["rms_px"]),
        sigma_px=float(values["sigma_px"]),
        design_effect=float(values["design_effect"]),
        view_count=int(values["view_count"]),
        point_count=int(values["point_count"]),
    )


def _lens(values: dict[str, Any]) -> LensOnBody:
    return LensOnBody(
        translation=_array(values["translation"], 3),
        quaternion_xyzw=_array(values["quaternion_xyzw"], 4),
        covariance=_array(values["covariance"], 6, 6),
        mount=Mount(values["mount"]),
        rotation_error=float(values["rotation_error"]),
        translation_error=float(values["translation_error"]),
        left_out_rms_px=float(values["left_out_rms_px"]),
        view_count=int(values["view_count"]),
    )


def _oblique(values: dict[str, Any]) -> Oblique:
    axis = None
    if values["axis_direction"] is not None:
        axis = ShaftAxis(_array(values["axis_direction"], 3), _array(values["axis_point"], 3))
    sigmas = float(values["axis_tilt_sigma"]), float(values["axis_shift_sigma"])
    second = values["T_head_scope"]
    T_head_scope = _array(second, 4, 4) if second is not None else None
    shape = None
    if "notch_depth" in values:
        shape = NotchShape(float(values["notch_depth"]), float(values["notch_width"]))
    return Oblique(float(values["notch_angle"]), axis, *sigmas, T_head_scope, shape)


def _tip(values: dict[str, Any]) -> Tip:
    return Tip(_array(values["position"], 3), _array(values["covariance"], 3, 3), float(values["rms"]))


def _clock(values: dict[str, Any]) -> Clock:
    return Clock(float(values["time_offset"]), float(values["sigma"]), str(values["source"]))


def _array(values: Any, *shape: int) -> Array:
    return np.array([float(value) for value in values]).reshape(shape)
