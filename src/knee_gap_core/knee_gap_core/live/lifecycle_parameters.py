"""The parameter of every managed node."""

from dataclasses import dataclass, field


@dataclass(frozen=True)
class LifecycleParameters:
    """Whether a node activates itself."""

    autostart: bool = field(
        default=True,
        metadata={
            "description": "Configure and activate the node at its start; false leaves that to the caller of "
            "change_state"
        },
    )
