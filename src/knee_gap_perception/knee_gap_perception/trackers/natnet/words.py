"""Messages to the user about a NatNet connection without usable data, with the likely causes."""

from math import isfinite

from knee_gap_perception.trackers.natnet.packets import ServerInfo


def no_answer(server: str, seconds: float, fault: str) -> str:
    """Message for a server that does not answer."""
    causes = [
        "Motive does not run or does not stream (Settings > Streaming > Enable)",
        f"{server} is not the address of its local interface there",
        "a firewall on either side stops UDP port 1510",
    ]
    if fault:
        causes.insert(0, f"the packets received are not NatNet ({fault})")
    return f"no answer from {server} for {seconds:.0f} s; likely causes: " + "; ".join(causes)


def no_data(name: str, seconds: float, info: ServerInfo, fault: str, other: str, group: str) -> str:
    """Message for a server that answers but sends no readable frames; `group` was joined here."""
    causes = ["Motive is paused in edit mode, or streams no rigid bodies"]
    if info.multicast:
        causes.append(
            f"this machine receives no multicast {group} (local_address is another interface, or the switch "
            "filters it): try unicast in Motive and here"
        )
    elif info.multicast is False:
        causes.append("a firewall here stops UDP packets from Motive")
    else:
        causes.append("Motive sends by multicast and this machine expects unicast, or the other way round")
    stated = f"{info.multicast_address}:{info.data_port}"
    if info.multicast and stated != group:
        causes.insert(
            0, f"Motive sends to {stated}, but this node joined {group}: set multicast_address and data_port"
        )
    if other:
        causes.insert(0, f"data are received from {other}, which is not the server_address that was set")
    if fault:
        causes.insert(0, f"its packets cannot be read ({fault})")
    return f"connected to {name}, but no data for {seconds:.0f} s; likely causes: " + "; ".join(causes)


def nothing_usable(name: str, names_known: bool, clock_error_ns: float | None, renamed: str = "") -> str:
    """Message for frames that are received but cannot be used.

    `clock_error_ns` is None if the clock is good enough; `renamed` is a body in view whose name was moved.
    """
    if clock_error_ns is not None and isfinite(clock_error_ns):
        return (
            f"frames received from {name}, but echoes take {clock_error_ns / 5e5:.1f} ms: the time of "
            f"exposure is known to {clock_error_ns / 1e6:.1f} ms only, worse than max_clock_error"
        )
    if clock_error_ns is not None:
        return f"frames received from {name}, but no echoes: the time of exposure is not known"
    if not names_known and renamed:
        return (
            f"frames received from {name}, but its model definitions give the name of {renamed}, which is in "
            "view, to another body, so they are ignored; if this is intended, cover the bodies for seconds"
        )
    if not names_known:
        return f"frames received from {name}, but no model definitions: Motive has no rigid bodies"
    return f"frames received from {name}, but with impossible times: its clock contradicts its echoes"
