"""A node with ROS's lifecycle: configure, activate, deactivate, clean up. By default it activates itself."""

import functools
from collections.abc import Callable
from typing import Any

from lifecycle_msgs.srv import ChangeState
from rclpy.lifecycle import LifecycleNodeMixin, LifecycleState, TransitionCallbackReturn

from knee_gap_core.live.base_node import BaseNode
from knee_gap_core.live.lifecycle_parameters import LifecycleParameters
from knee_gap_core.node.seam import Fault
from knee_gap_core.node.wiring import Health

# Received in every state: what is published once, and time.
ALWAYS_RECEIVED = ("camera_info", "scope_calibration", "/clock")
FORGOTTEN = Fault("what was received before", "Deactivated", "", "this node", "")


class ManagedNode(LifecycleNodeMixin, BaseNode):
    """Receives its inputs, and publishes results, only while it is active.

    Parameters and the calibration are read when the process starts, so that a mistake ends it at once. A node
    that is deactivated forgets all that it received: after an activation nothing of before is continued. It
    reports its state in the diagnostics.
    """

    def __init__(self, name: str, *, health: Callable[[], Health]) -> None:
        self.is_active = False
        BaseNode.__init__(self, name, health=lambda: self._health_by_state(health))
        LifecycleNodeMixin.__init__(self)
        for service in self.services:
            if service.srv_type is ChangeState:
                service.callback = self._survived(service.callback)
        self._autostart = self.declare(LifecycleParameters).autostart

    def start(self) -> None:
        """Begin to measure, unless the parameter autostart leaves that to somebody else."""
        if self._autostart:
            self.trigger_configure()
            self.trigger_activate()

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Callable[..., None], *options: Any, **named: Any
    ) -> Any:
        """Subscribe; messages are received while the node is active."""
        if topic not in ALWAYS_RECEIVED:
            callback = self._while_active(callback)
        return super().create_subscription(msg_type, topic, callback, *options, **named)

    def create_timer(
        self, timer_period_sec: float, callback: Callable[[], None], *options: Any, **named: Any
    ) -> Any:
        """Start a timer; it calls back while the node is active, except for the diagnostics."""
        if callback != self.publish_diagnostics:
            callback = self._while_active(callback)
        return super().create_timer(timer_period_sec, callback, *options, **named)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Receive and publish from now on."""
        self.is_active = True
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Receive and publish nothing from now on, and forget what was received."""
        self._stop()
        return super().on_deactivate(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """As deactivation, from whatever state."""
        self._stop()
        return super().on_shutdown(state)

    def _stop(self) -> None:
        if self.is_active:
            self.is_active = False
            self._recover(FORGOTTEN)

    def _while_active(self, callback: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(callback)
        def active(*arguments: Any, **named: Any) -> None:
            if self.is_active:
                callback(*arguments, **named)

        return active

    def _survived(self, change: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
        """The service change_state, which refuses a transition that the present state does not have.

        rclpy raises in that case, which would end the node.
        """

        def changed(request: Any, response: Any) -> Any:
            try:
                return change(request, response)
            except Exception as error:  # rclpy's class for it is not public
                self.get_logger().warning(f"change_state refused: {' '.join(str(error).split())}")
                response.success = False
                return response

        return changed

    def _health_by_state(self, health: Callable[[], Health]) -> Health:
        if self.is_active:
            return health()
        return False, "not active: call change_state to configure and activate this node", {}
