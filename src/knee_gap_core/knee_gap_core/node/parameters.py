"""ROS parameters declared from a frozen dataclass: a default, its range and its meaning stand in one place.

A field's type gives the parameter's; its metadata gives `description`, and where they apply `range` (low,
high) and `choices`. Parameters are read-only: changing a calibration or an error bound in the middle of a
track would make one estimate out of two.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import Field, fields
from itertools import pairwise
from pathlib import Path
from types import UnionType
from typing import Any, TypeVar, get_origin, get_type_hints

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor

from knee_gap_core.bag.former_names import renamed_parameters
from knee_gap_core.node.errors import ConfigurationError
from knee_gap_core.user_files import MOST_YAML_BYTES, read_bytes

Parameters = TypeVar("Parameters")

# Every node has these without asking; they are no mistake of the user's.
ALWAYS_ALLOWED = frozenset({"use_sim_time", "start_type_description_service"})
_ALLOWED_GROUP = "qos_overrides."


def descriptor_of(field: "Field[Any]", kind: object) -> ParameterDescriptor:
    """Descriptor of one field: what it means and which values it takes."""
    descriptor = ParameterDescriptor(description=str(field.metadata.get("description", "")), read_only=True)
    # A name or a number: the dataclass checks what ROS cannot.
    descriptor.dynamic_typing = isinstance(kind, UnionType)
    choices = field.metadata.get("choices")
    if choices:
        descriptor.additional_constraints = "one of: " + ", ".join(choices)
    limits = field.metadata.get("range")
    if field.metadata.get("nan"):
        # ROS calls NaN outside every range; the dataclass checks it.
        descriptor.additional_constraints = f"in [{limits[0]:g}, {limits[1]:g}], or NaN" if limits else ""
    elif limits and kind is float:
        descriptor.floating_point_range = [
            FloatingPointRange(from_value=float(limits[0]), to_value=float(limits[1]), step=0.0)
        ]
    elif limits and kind is int:
        descriptor.integer_range = [IntegerRange(from_value=int(limits[0]), to_value=int(limits[1]), step=1)]
    return descriptor


def as_ros_default(value: Any) -> Any:
    """ROS knows lists, frozen dataclasses want tuples."""
    return list(value) if isinstance(value, tuple) else value


def declare(node: Any, kind: type[Parameters]) -> Parameters:
    """Declare every field of `kind`, which all have defaults; return the instance that the values make.

    Raises:
        ConfigurationError: a value of the wrong type, outside its range or refused by the dataclass itself.

    """
    hints = get_type_hints(kind)
    values = {}
    for field in fields(kind):  # type: ignore[arg-type]  # any dataclass
        hint = hints[field.name]
        try:
            given = node.declare_parameter(
                field.name, as_ros_default(field.default), descriptor_of(field, hint)
            ).value
        except Exception as error:  # rclpy's own family has no common base but Exception
            raise ConfigurationError(_one_line(field.name, field, hint, error)) from error
        choices = field.metadata.get("choices")
        if choices and given not in choices:
            raise ConfigurationError(
                f"parameter {field.name} is {given!r}; it is one of: {', '.join(choices)}"
            )
        values[field.name] = tuple(given) if get_origin(hint) is tuple else given
    try:
        return kind(**values)
    except ValueError as error:
        raise ConfigurationError(str(error)) from error


def refuse_unknown(node: Any) -> None:
    """Refuse parameters that were given and never declared: a misspelt name would silently do nothing.

    Raises:
        ConfigurationError: names those parameters and the ones there are.

    """
    # rclpy has no public list of what was given or declared; nothing else of ours reads its private names.
    unknown = sorted(
        name
        for name in node._parameter_overrides
        if not node.has_parameter(name) and not _is_always_allowed(name)
    )
    if unknown:
        known = sorted(name for name in node._parameters if not _is_always_allowed(name))
        raise ConfigurationError(
            f"no parameter {', '.join(unknown)}{renamed_parameters(unknown)}; there are: {', '.join(known)}"
        )


@contextmanager
def refused_by_ros() -> Iterator[None]:
    """Turn what rclpy raises while a node is made, for names and values of its own, into ConfigurationError.

    `use_sim_time:=abc` is such a value: rclpy declares it before any parameter of ours.
    """
    try:
        yield
    except Exception as error:  # rclpy's own family has no common base but Exception
        raise ConfigurationError(" ".join(str(error).split())) from error


def require_files(arguments: Sequence[str]) -> None:
    """Raise FileError where `--params-file` names no file: ROS would wait for a FIFO without end."""
    for option, value in pairwise(arguments):
        if option == "--params-file":
            read_bytes(Path(value), MOST_YAML_BYTES)


def _is_always_allowed(name: str) -> bool:
    return name in ALWAYS_ALLOWED or name.startswith(_ALLOWED_GROUP)


def _one_line(name: str, field: "Field[Any]", hint: object, error: Exception) -> str:
    if choices := field.metadata.get("choices"):
        wanted = "one of " + ", ".join(choices)
    else:
        wanted = "a list" if get_origin(hint) is tuple else f"of type {getattr(hint, '__name__', hint)}"
    limits = field.metadata.get("range")
    if limits:
        wanted += f" in [{limits[0]:g}, {limits[1]:g}]"
    return f"parameter {name}: must be {wanted} ({' '.join(str(error).split())})"


def as_rows(counts: Mapping[str, object]) -> list[tuple[str, str]]:
    """Key and value pairs as diagnostics carry them."""
    return [(key, f"{value:g}" if isinstance(value, float) else str(value)) for key, value in counts.items()]
