"""Message types without ROS: definitions, type hashes, and empty messages.

Types come from the Jazzy store of rosbags; any other, `knee_gap_msgs` first, from its `.msg` file in the
ament index, or from this source tree where no workspace is set up.
"""

import os
from collections.abc import Callable
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, cast

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from knee_gap_core.bag import former_names
from knee_gap_core.bag.errors import BagError

_SOURCE_TREE = Path(__file__).resolve().parents[3]

# A type stands behind those that it holds.
OWN_TYPES = (
    "GapSection",
    "GapEdges",
    "GapEstimate",
    "GapProfile",
    "MotionAdvice",
    "ScopeCalibration",
    "ScopeNotch",
    "ScopeRotation",
)

_NUMPY_NAMES = {
    "float32",
    "float64",
    "int8",
    "int16",
    "int32",
    "int64",
    "uint8",
    "uint16",
    "uint32",
    "uint64",
}
_NUMPY_ALIASES = {"bool": "bool", "byte": "uint8", "octet": "uint8", "char": "uint8"}

# rosbags' definitions carry no default values; of the messages in common use only the quaternion has any.
_DEFAULTS: dict[str, dict[str, float]] = {"geometry_msgs/msg/Quaternion": {"w": 1.0}}


@cache
def typestore() -> Typestore:
    """Return the shared store of Jazzy's types and those of knee_gap_msgs.

    Raises BagError where the definitions of knee_gap_msgs are not found.
    """
    store = get_typestore(Stores.ROS2_JAZZY)
    for name in OWN_TYPES:
        _register(store, f"knee_gap_msgs/msg/{name}")
    return store


def known_type(msgtype: str) -> str:
    """Return `msgtype` as `package/msg/Name`, loading its definition into `typestore()` if need be.

    Raises BagError for a name that is not a message type or whose definition is not found.
    """
    name = full_name(msgtype)
    if name.count("/") != 2:
        raise BagError(f"'{msgtype}' is not a message type; expected package/msg/Name")
    _register(typestore(), name)
    return name


def full_name(msgtype: str) -> str:
    """Return `package/Name` as `package/msg/Name`, any other name unchanged."""
    package, _, name = msgtype.rpartition("/")
    return msgtype if not package or "/" in package else f"{package}/msg/{name}"


def blank(msgtype: str) -> Any:
    """Return a default-constructed message of `msgtype`, with the values that rclpy would give it."""
    return _maker(msgtype)()


def _register(store: Typestore, msgtype: str) -> None:
    if msgtype in store.fielddefs:
        return
    path = _definition_file(msgtype)
    try:
        parsed = get_types_from_msg(path.read_text(encoding="utf-8"), msgtype)
    except TypesysError as error:
        raise BagError(f"{path} cannot be read as a message definition: {error}") from None
    for needed in _referenced_types(parsed[msgtype][1]):
        _register(store, needed)
    store.register(parsed)


def _definition_file(msgtype: str) -> Path:
    package, _, name = msgtype.split("/")
    prefixes = [
        Path(prefix) for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if prefix
    ]
    folders = [prefix / "share" / package / "msg" for prefix in prefixes]
    for folder in (*folders, _SOURCE_TREE / package / "msg"):
        if (path := folder / f"{name}.msg").is_file():
            return path
    raise BagError(f"the definition of {msgtype} is not found; is its workspace set up (AMENT_PREFIX_PATH)?")


def _referenced_types(fields: Any) -> set[str]:
    names = set()
    for _, (node, value) in fields:
        if node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            node, value = value[0]
        if node == Nodetype.NAME:
            names.add(value)
    return names


@cache
def _maker(msgtype: str) -> Callable[[], Any]:
    """Return what makes empty messages of a type; values that cannot be changed are made once."""
    store, name = typestore(), known_type(msgtype)
    kind = store.types[name]
    constants: dict[str, Any] = {}
    makers: list[tuple[str, Callable[[], Any]]] = []
    for field, (node, value) in store.fielddefs[name][1]:
        make = _field_maker(node, value)
        if node == Nodetype.BASE:
            constants[field] = make()
        else:
            makers.append((field, make))
    constants.update(_DEFAULTS.get(name, {}))
    return lambda: kind(**constants, **{field: make() for field, make in makers})


def _field_maker(node: int, value: Any) -> Callable[[], Any]:
    if node == Nodetype.NAME:
        return _maker(value)
    if node == Nodetype.BASE:
        constant = "" if value[0] in ("string", "wstring") else _numpy_type(value[0]).type(0).item()
        return lambda: constant
    (item_node, item_value), length = value
    count = length if node == Nodetype.ARRAY else 0
    if item_node == Nodetype.BASE and item_value[0] not in ("string", "wstring"):
        dtype = _numpy_type(item_value[0])
        return lambda: np.zeros(count, dtype)
    make = _field_maker(item_node, item_value)
    return lambda: [make() for _ in range(count)]


def _numpy_type(name: str) -> "np.dtype[Any]":
    return np.dtype(name if name in _NUMPY_NAMES else _NUMPY_ALIASES[name])


def message_class(msgtype: str) -> type:
    """Return the Python class that ROS generated for `msgtype`; raises BagError where it is not installed."""
    package, _, name = full_name(msgtype).partition("/msg/")
    try:
        return cast(type, getattr(import_module(f"{package}.msg"), name))
    except (ImportError, AttributeError, ValueError):
        raise BagError(f"type {msgtype} is not installed") from None


def check_type_hash(msgtype: str, type_hash: str) -> None:
    """Raise BagError if `type_hash` is known and is not that of the definition installed here.

    Bytes of another version of a type would be read as wrong numbers. A version in which only names differ is
    accepted.
    """
    if not type_hash:
        return
    here = typestore().hash_rihs01(known_type(msgtype))
    if type_hash not in (here, _former_hash(full_name(msgtype))):
        raise BagError(
            f"its {msgtype} is of another version than the one installed ({type_hash}, not {here})"
        )


@cache
def _former_hash(msgtype: str) -> str:
    """Hash of today's definition under its former names; empty unless something was renamed."""
    if msgtype not in (*former_names.TYPES.values(), *former_names.FIELDS):
        return ""
    text = _definition_file(msgtype).read_text(encoding="utf-8")
    before = former_names.former_definition(msgtype, text)
    if before is None:
        return ""
    name, definition = before
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(definition, name))
    return str(store.hash_rihs01(name))
