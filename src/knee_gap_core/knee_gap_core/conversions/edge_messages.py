"""Conversion of gap edges from and to knee_gap_msgs/GapEdges, by field name, for any class of message."""

from collections.abc import Callable
from enum import IntEnum
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from knee_gap_core.values.edges import EdgeKind, EdgeState, EdgeStatus, GapEdges, SectionEdges
from knee_gap_core.values.stamps import set_stamp, stamp_ns

Code = TypeVar("Code", bound=IntEnum)
Floats = npt.NDArray[np.float64]

# Columns of the message for errors of the camera.
MOST_CAMERA_ERRORS = 9


def edges_from_message(message: Any) -> GapEdges:
    """Edges of a knee_gap_msgs/GapEdges; a code that is not among its constants is UNKNOWN."""
    return GapEdges(
        stamp_ns=stamp_ns(message.header),
        frame_id=str(message.header.frame_id),
        status=_code(EdgeStatus, message.status),
        track_id=int(message.track_id),
        bearings=_vectors(message.bearing_0, message.bearing_1),
        pixels=np.array([message.pixel_0, message.pixel_1], dtype=float),
        kinds=(_code(EdgeKind, message.kind_0), _code(EdgeKind, message.kind_1)),
        covariances=np.array([message.covariance_0, message.covariance_1], dtype=float).reshape(2, 3, 3),
        angular_error=float(message.angular_error),
        hidden=(bool(message.hidden_0), bool(message.hidden_1)),
        pose_used=bool(message.pose_used),
        camera_errors=_camera_errors(message),
        section=SectionEdges(
            states=(_code(EdgeState, message.edge_state_0), _code(EdgeState, message.edge_state_1)),
            bearings=_vectors(message.edge_0, message.edge_1),
            deviations=np.array([message.edge_deviation_0, message.edge_deviation_1], dtype=float),
            error=float(message.edge_error),
            pixels=np.array([message.edge_pixel_0, message.edge_pixel_1], dtype=float),
        ),
        sections=tuple(_section(section) for section in message.sections),
    )


def fill_gap_edges(message: Any, edges: GapEdges, blank_section: Callable[[], Any]) -> Any:
    """Set every field of a default-constructed knee_gap_msgs/GapEdges from edges; returns the message.

    `blank_section` makes a default-constructed knee_gap_msgs/GapSection of the same kind.
    """
    set_stamp(message.header, edges.stamp_ns)
    message.header.frame_id = edges.frame_id
    message.status = int(edges.status)
    message.track_id = int(edges.track_id)
    for index in (0, 1):
        bearing = getattr(message, f"bearing_{index}")
        bearing.x, bearing.y, bearing.z = (float(value) for value in edges.bearings[index])
        setattr(message, f"pixel_{index}", np.array(edges.pixels[index], dtype=np.float64))
        setattr(message, f"kind_{index}", int(edges.kinds[index]))
        setattr(message, f"hidden_{index}", bool(edges.hidden[index]))
        setattr(
            message, f"covariance_{index}", np.array(edges.covariances[index], dtype=np.float64).reshape(9)
        )
        setattr(message, f"camera_error_{index}", _camera_error(edges.camera_errors[index]))
        setattr(message, f"edge_state_{index}", int(edges.section.states[index]))
        setattr(message, f"edge_pixel_{index}", np.array(edges.section.pixels[index], dtype=np.float64))
        setattr(message, f"edge_deviation_{index}", float(edges.section.deviations[index]))
    _fill_section(message, edges.section)
    message.sections = [_fill_section(blank_section(), section) for section in edges.sections]
    message.pose_used = bool(edges.pose_used)
    message.angular_error = float(edges.angular_error)
    return message


def _code(kind: type[Code], value: Any) -> Code:
    try:
        return kind(int(value))
    except ValueError:
        return kind(0)


def _vectors(*vectors: Any) -> Floats:
    return np.array([[vector.x, vector.y, vector.z] for vector in vectors], dtype=float)


def _section(message: Any) -> SectionEdges:
    """Edges of a knee_gap_msgs/GapSection, of which the message holds the bound of the errors only."""
    bearings, error = _vectors(message.edge_0, message.edge_1), float(message.edge_error)
    state = EdgeState.SEEN if np.isfinite(bearings).all() and np.isfinite(error) else EdgeState.UNKNOWN
    return SectionEdges((state, state), bearings, np.full(2, error / 3.0), error)


def _fill_section(message: Any, section: SectionEdges) -> Any:
    """Set the bearings of both edges and the bound of their errors."""
    for index in (0, 1):
        edge = getattr(message, f"edge_{index}")
        edge.x, edge.y, edge.z = (float(value) for value in section.bearings[index])
    message.edge_error = float(section.error)
    return message


def _camera_errors(message: Any) -> Floats:
    """Errors (2, 3, k) of the camera; k is 0 if they are not known."""
    errors = np.array([message.camera_error_0, message.camera_error_1], dtype=float)
    errors = errors.reshape(2, 3, MOST_CAMERA_ERRORS)
    return errors[:, :, :0] if np.isnan(errors).all() else errors


def _camera_error(errors: Floats) -> Floats:
    """Displacements (3, k), at most nine, in the message's layout (27,); NaN if there are none."""
    count = errors.shape[1]
    padded = np.full((3, MOST_CAMERA_ERRORS), 0.0 if count else np.nan)
    padded[:, :count] = errors
    return padded.ravel()
