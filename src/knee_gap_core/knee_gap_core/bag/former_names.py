"""Former names of topics, message types, fields and parameters, and what they are called today.

A bag recorded under them stays readable: its topics and types appear under their names of today. A parameter
file that uses one is refused with the name of today.
"""

import re
from collections.abc import Iterable

# The last parts of a topic's name, after its namespace.
TOPICS = {"scope_turn": "scope_rotation", "scope_turn_body/pose": "scope_rotation_body/pose"}
TYPES = {"knee_gap_msgs/msg/ScopeTurn": "knee_gap_msgs/msg/ScopeRotation"}
# Fields by the type's name of today: only a name was changed, the bytes mean the same.
FIELDS = {"knee_gap_msgs/msg/ScopeCalibration": {"turn_followed": "rotation_followed"}}
PARAMETERS = {
    "scope_turn_notch": "scope_rotation_notch",
    "scope_turn_body": "scope_rotation_body",
    "depth_drift": "scale_drift",
    "lasting_share": "correlated_error_share",
}


def topic_today(name: str) -> str:
    """Name of a topic today, in any namespace; `name` itself unless it was renamed."""
    for former, today in TOPICS.items():
        if name == former or name.endswith(f"/{former}"):
            return name.removesuffix(former) + today
    return name


def type_today(msgtype: str) -> str:
    """Name of a message type today; `msgtype` itself unless it was renamed."""
    return TYPES.get(msgtype, msgtype)


def former_definition(msgtype: str, text: str) -> tuple[str, str] | None:
    """Former name and former text of today's definition of a type; None unless something was renamed."""
    name = next((former for former, today in TYPES.items() if today == msgtype), msgtype)
    before = text
    for former, today in FIELDS.get(msgtype, {}).items():
        before = re.sub(rf"\b{today}\b", former, before)
    return None if (name, before) == (msgtype, text) else (name, before)


def renamed_parameters(names: Iterable[str]) -> str:
    """Names of today of those parameters that were renamed, to be put behind a message; empty without any."""
    words = [f"{name} is called {PARAMETERS[name]} today" for name in names if name in PARAMETERS]
    return f" ({', '.join(words)})" if words else ""
