"""Launch plans: the processes to start, checks before the start, and reactions to the end of a process.

They are plain data and functions. The launch files convert a plan to actions of launch; if launch is not
installed, `supervisor` runs it. Both use these functions, so they behave alike.
"""

import math
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import NamedTuple

from knee_gap_core.bag.bag import BagReader
from knee_gap_core.bag.bag_paths import missing_bag
from knee_gap_core.bag.errors import BagError

NODES = {
    "segmentation_node": "knee_gap_perception",
    "tracking_node": "knee_gap_perception",
    "uncertainty_node": "knee_gap_uncertainty",
}
SUITE = {"suite_node": "knee_gap_bringup"}
# Of a bag with both, the compressed images are played.
IMAGES = {"compressed": "image_raw/compressed", "raw": "image_raw"}
OTHER_INPUTS = ("camera_info", "scope_body/pose")
OUTPUTS = (
    "gap_edges",
    "scope_pose",
    "scope_rotation",
    "scope_notch",
    "scope_calibration",
    "gap",
    "gap/min",
    "gap/max",
    "gap/snr",
    "gap_profile",
    "motion_advice",
)
CALIBRATION_FILE = "calibration.yaml"
# Time allowed for the last image to pass through the nodes [s].
DRAIN = 1.0
# Pause before a node that ended is restarted [s].
RESPAWN_DELAY = 1.0
# Exit code of a node that refuses its parameters: after a restart it would refuse them again.
REFUSED_SETTINGS = 2


class Role(Enum):
    """Role of a process, which determines the reaction to its end."""

    NODE = "node"
    PLAYER = "player"
    RECORDER = "recorder"


class Next(Enum):
    """Reaction to the end of a process."""

    START_AGAIN = "start again"
    END_AFTER_DRAIN = "end after the last image"
    END = "end"
    NOTHING = "nothing"


class Reaction(NamedTuple):
    """Reaction, exit code of the launch, and reason."""

    next: Next
    code: int
    words: str


@dataclass(frozen=True)
class PlannedProcess:
    """One process; `parameters` are files and mappings, as in launch."""

    package: str
    executable: str
    role: Role = Role.NODE
    arguments: tuple[str, ...] = ()
    namespace: str = ""
    parameters: tuple[str | Mapping[str, object], ...] = ()
    respawn: bool = False

    @property
    def ros_arguments(self) -> tuple[str, ...]:
        """Command line arguments that set a node's namespace and parameters."""
        if self.role is not Role.NODE:
            return ()
        given = ("--ros-args", "-r", f"__ns:={absolute(self.namespace)}")
        return (*given, *parameter_arguments(self.parameters))


def parameter_arguments(given: Iterable[str | Mapping[str, object]]) -> Iterator[str]:
    """Command line arguments, after --ros-args, of parameter files and of mappings of parameters."""
    for parameters in given:
        if isinstance(parameters, str):
            yield from ("--params-file", parameters)
        else:
            for name, value in parameters.items():
                yield from ("-p", f"{name}:={value}")


def live_plan(
    params: str, namespace: str, *, respawn: bool = True, one_process: bool = False
) -> tuple[PlannedProcess, ...]:
    """Plan of the three nodes with one parameter file; with `respawn`, nodes that end are restarted.

    With `one_process` they are those of suite_node.
    """
    return tuple(
        PlannedProcess(package, name, namespace=namespace, parameters=(params,), respawn=respawn)
        for name, package in (SUITE if one_process else NODES).items()
    )


def replay_plan(
    bag: str, out: str, *, rate: str = "1.0", params: str = "", namespace: str = "knee_gap"
) -> tuple[PlannedProcess, ...]:
    """Plan of the three nodes, a recorder if `out` is given, and the player, whose end ends the launch."""
    space = absolute(namespace)
    transport = image_transport(Path(bag), space)
    inputs = [f"{space}/{topic}" for topic in (IMAGES[transport], *OTHER_INPUTS)]
    given = (params,) if params else ()
    own: dict[str, tuple[str | Mapping[str, object], ...]] = {
        name: given or scope_parameters(Path(bag), name) for name in NODES
    }
    # Of a recording every image is wanted, however late it is answered.
    own["segmentation_node"] += ({"image_transport": transport, "max_image_lag": 0.0},)
    plan = [
        PlannedProcess(package, name, namespace=namespace, parameters=own[name])
        for name, package in NODES.items()
    ]
    if out:
        topics = (f"{space}/{topic}" for topic in OUTPUTS)
        plan.append(PlannedProcess("knee_gap_replay", "record", Role.RECORDER, (out, *topics)))
    play = (bag, "--rate", rate, "--topics", *inputs, "--wait-for", *inputs, "--delay", "1")
    plan.append(PlannedProcess("knee_gap_replay", "play", Role.PLAYER, play))
    return tuple(plan)


def image_transport(bag: Path, space: str) -> str:
    """Transport of the images in a bag: raw if no compressed ones are; play reports what cannot be read."""
    try:
        with BagReader(bag) as reader:
            topics = set(reader.topics)
    except (BagError, OSError):
        return "compressed"
    return next((name for name, topic in IMAGES.items() if f"{space}/{topic}" in topics), "compressed")


def scope_parameters(bag: Path, node: str) -> tuple[str | Mapping[str, object], ...]:
    """Parameters that describe the scope to a node, in a simulated bag's folder or beside its file.

    They are the bag's calibration, or the nominal scope; a bag that is not simulated has none.
    """
    folder = bag if bag.is_dir() else bag.parent
    calibration, nominal = folder / CALIBRATION_FILE, folder / "scope.yaml"
    if calibration.is_file():
        # uncertainty_node receives it from the two others.
        return () if node == "uncertainty_node" else ({"calibration_file": str(calibration.resolve())},)
    # The medium of the camera model is in it as well as the pose of the lens.
    return (str(nominal),) if node != "uncertainty_node" and nominal.is_file() else ()


def live_problem(params: str, respawn_delay: str = str(RESPAWN_DELAY)) -> str:
    """Why the nodes cannot be started, in one line; empty if they can."""
    if problem := _number_problem("respawn_delay", respawn_delay, lowest=0.1):
        return problem
    return _file_problem("params", params)


def replay_problem(bag: str, out: str, *, rate: str = "1.0", params: str = "") -> str:
    """Why a bag cannot be replayed, in one line; empty if it can. To be called before anything is started."""
    if missing := missing_bag(Path(bag)):
        return f"bag: {missing}"
    if out and os.path.lexists(out):
        return f"out: {out} exists already; choose another name or remove it"
    if problem := _number_problem("rate", rate):
        return problem
    return _file_problem("params", params) if params else ""


def reaction(process: PlannedProcess, code: int, *, ending: bool = False) -> Reaction:
    """Reaction to a process that ended with `code`, negative for a signal; `ending`: shutdown has begun."""
    name, exit_code = process.executable, exit_code_of(code)
    words = f"{name} ended with exit code {code}" if code >= 0 else f"{name} was ended by signal {-code}"
    if process.role is Role.RECORDER and code != 0:
        # The recording is incomplete, whatever ended the launch.
        return Reaction(Next.NOTHING if ending else Next.END, exit_code, words)
    if ending:
        return Reaction(Next.NOTHING, 0, words)
    if process.role is Role.PLAYER and code == 0:
        return Reaction(Next.END_AFTER_DRAIN, 0, "the bag has ended")
    if process.respawn and code != REFUSED_SETTINGS:
        return Reaction(Next.START_AGAIN, 0, words)
    return Reaction(Next.END, exit_code, words)


def exit_code_of(code: int) -> int:
    """Exit code of a process as a shell reports it: 128 plus the signal if a signal ended it."""
    return code if code >= 0 else 128 - code


def absolute(namespace: str) -> str:
    """A namespace in the form that topics have."""
    return "/" + namespace.strip("/")


def _file_problem(name: str, path: str) -> str:
    if not os.path.exists(path):
        return f"{name}: {path} does not exist"
    return "" if os.path.isfile(path) else f"{name}: {path} is not a file"


def _number_problem(name: str, text: str, lowest: float = 1e-6) -> str:
    try:
        number = float(text)
    except ValueError:
        return f"{name}: '{text}' is not a number"
    if not math.isfinite(number) or number < lowest:
        return f"{name}: must be a finite number of at least {lowest:g}, is {text}"
    return ""
