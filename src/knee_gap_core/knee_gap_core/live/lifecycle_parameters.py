"""The parameter of every managed node."""

from dataclasses import dataclass, field


@dataclass(frozen=True)
class LifecycleParameters:
    """Whether a node waits for somebody who manages it."""

    autostart: bool = field(
        default=True,
        metadata={
            "description": "Configure and activate the node at its start; false leaves that to whoever calls "
            "change_state"
        },
    )
