"""ROS parameter files, read without ROS, for the cores behind the nodes that the files name."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, get_origin, get_type_hints

from knee_gap_core.bag.errors import BagError
from knee_gap_core.bag.former_names import renamed_parameters
from knee_gap_core.user_files import FileError, read_yaml

_PARAMETERS = "ros__parameters"
_EVERY_NODE = frozenset({"*", "**"})
# What every node, or the shell around a core, takes beside the core's own parameters.
_NOT_OF_CORES = frozenset(
    {
        "use_sim_time",
        "image_transport",
        "max_image_lag",
        "picture_rate",
        "publish_tf",
        "body_frame_id",
        "autostart",
    }
)


class ParametersFile:
    """The parameters of one file, by node; `ParametersFile(None)` has none, so that defaults hold.

    Raises BagError where the file cannot be read or is no ROS parameter file.
    """

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._by_node: list[tuple[str, dict[str, Any]]] = []
        if path is None:
            return
        try:
            tree = read_yaml(path)
        except FileError as error:
            raise BagError(str(error)) from None
        self._by_node = list(_nodes(tree))
        if not self._by_node:
            raise BagError(f"{path} is not a ROS parameter file: nothing in it is called {_PARAMETERS}")

    @classmethod
    def with_calibration(cls, path: Path) -> "ParametersFile":
        """Parameters that name nothing but a calibration file, for the nodes that use one."""
        made = cls(None)
        made._path = path
        given = {"calibration_file": str(path)}
        made._by_node = [("segmentation_node", given), ("tracking_node", given)]
        return made

    def build(self, node: str, kinds: Sequence[type]) -> list[Any]:
        """Return one instance of each dataclass of `kinds`, which are the parameters of `node`.

        Raises BagError for a parameter that none of them has and for a value that one of them refuses.
        """
        own = _merged(values for name, values in self._by_node if name == node)
        given = {**_merged(values for name, values in self._by_node if name in _EVERY_NODE), **own}
        known = {field.name for kind in kinds for field in fields(kind)}
        if unknown := sorted(own.keys() - known - _NOT_OF_CORES):
            choices = ", ".join(sorted(known))
            words = f"{', '.join(unknown)}{renamed_parameters(unknown)}"
            raise BagError(f"{self._path}: no parameter {words} of {node}; there are: {choices}")
        try:
            return [_instance(kind, given) for kind in kinds]
        except (ValueError, TypeError) as error:
            raise BagError(f"{self._path}: {node}: {error}") from None

    def refuse_unknown(self, nodes: Mapping[str, Sequence[type]]) -> None:
        """Raise BagError for a parameter of every node that none of `nodes` has."""
        known = {field.name for kinds in nodes.values() for kind in kinds for field in fields(kind)}
        given = _merged(values for name, values in self._by_node if name in _EVERY_NODE)
        if unknown := sorted(given.keys() - known - _NOT_OF_CORES):
            words = f"{', '.join(unknown)}{renamed_parameters(unknown)}"
            raise BagError(f"{self._path}: no node has a parameter {words}")


def _nodes(tree: Any, name: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the last part of each node's name, with its parameters."""
    if not isinstance(tree, Mapping):
        return
    for key, value in tree.items():
        if key == _PARAMETERS:
            yield name.rpartition("/")[2], dict(_flat(value))
        else:
            yield from _nodes(value, str(key))


def _flat(tree: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield parameters of groups as ROS names them, `group.name`."""
    for key, value in tree.items() if isinstance(tree, Mapping) else ():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _merged(dictionaries: Iterator[dict[str, Any]]) -> dict[str, Any]:
    return {name: value for dictionary in dictionaries for name, value in dictionary.items()}


def _instance(kind: type, given: Mapping[str, Any]) -> Any:
    hints = get_type_hints(kind)
    values = {field.name: given[field.name] for field in fields(kind) if field.name in given}
    return kind(**{name: _converted(hints[name], value) for name, value in values.items()})


def _converted(hint: Any, value: Any) -> Any:
    """Lists become the tuples of frozen dataclasses, whole numbers the floats they stand for."""
    if get_origin(hint) is tuple:
        return tuple(float(number) if isinstance(number, int) else number for number in value)
    return float(value) if hint is float and isinstance(value, int) else value
