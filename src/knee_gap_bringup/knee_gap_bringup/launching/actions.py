"""Conversion of a plan to actions of the ROS package `launch`, for the launch files.

launch is imported inside the functions, so that this module can be imported if launch is not installed.
"""

import atexit
import logging
import os
import subprocess
import sys
from collections.abc import Callable, Iterable

from knee_gap_bringup.launching.plan import (
    DRAIN,
    RESPAWN_DELAY,
    SUITE,
    Next,
    PlannedProcess,
    Role,
    reaction,
)

# A signal that arrives before a node can handle it stays pending until its entry point unblocks it.
SIGNALS_WAIT = ("env", "--block-signal=INT", "--block-signal=TERM")


def prefix() -> str:
    """Prefix of a node's command: `SIGNALS_WAIT` if this machine's `env` supports it."""
    can = subprocess.run([*SIGNALS_WAIT, "true"], capture_output=True, check=False).returncode == 0
    return " ".join(SIGNALS_WAIT) if can else ""


def refuse(problem: str) -> None:
    """End the launch with 1 and one line if there is a problem."""
    if problem:
        # launch prints the message of an exception in one line.
        raise RuntimeError(problem)


def actions(plan: Iterable[PlannedProcess], respawn_delay: float = RESPAWN_DELAY) -> list[object]:
    """Actions for each process and for its end."""
    from launch.actions import RegisterEventHandler
    from launch.event_handlers import OnProcessExit

    result: list[object] = []
    for process in plan:
        node = _node(process, respawn_delay)
        result += [RegisterEventHandler(OnProcessExit(target_action=node, on_exit=_on_exit(process))), node]
    return result


def _node(process: PlannedProcess, respawn_delay: float) -> object:
    from launch_ros.actions import Node

    is_node = process.role is Role.NODE
    # A name would be that of every node in the process.
    named = {} if process.executable in SUITE else {"name": process.executable}
    return Node(
        package=process.package,
        executable=process.executable,
        # Player and recorder take absolute topics and set their own node names.
        **({**named, "namespace": process.namespace} if is_node else {}),
        parameters=[*process.parameters] if is_node else None,
        arguments=[*process.arguments],
        output="screen",
        prefix=prefix(),
        exec_name=process.executable,
        respawn=process.respawn,
        respawn_delay=respawn_delay,
    )


def _on_exit(process: PlannedProcess) -> Callable[[object, object], list[object]]:
    from launch.actions import EmitEvent, LogInfo, TimerAction
    from launch.events import Shutdown

    def follow(event: object, context: object) -> list[object]:
        ending = bool(getattr(context, "is_shutdown", False))
        answer = reaction(process, int(getattr(event, "returncode", 1)), ending=ending)
        if answer.code:
            leave_with(answer.code)
        if answer.next is Next.END_AFTER_DRAIN:
            return [TimerAction(period=DRAIN, actions=[EmitEvent(event=Shutdown(reason=answer.words))])]
        if answer.next is Next.END:
            return [
                LogInfo(msg=f"{answer.words}; stopping all"),
                EmitEvent(event=Shutdown(reason=answer.words)),
            ]
        return []

    return follow


_codes: list[int] = []


def leave_with(code: int) -> None:
    """Make `ros2 launch` exit with a code: by itself it returns 0, or 1 for its own exceptions."""
    if not _codes:
        atexit.register(_leave)
    _codes.append(code)


def _leave() -> None:
    logging.shutdown()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(_codes[0])
