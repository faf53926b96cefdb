"""Settings of the estimator, each with its meaning and the values it takes."""

from dataclasses import dataclass, field
from typing import Any, Literal

from knee_gap_core.node.parameter_rules import broken_rule
from knee_gap_core.values.errors import MeasurementError

# Of a scope that is known exactly, as a simulated one is: nothing of it is uncalibrated.
EXACT_SCOPE: dict[str, Any] = dict.fromkeys(
    ("clock_error", "lens_position_error", "lens_rotation_error", "camera_error"), 0.0
)


@dataclass(frozen=True)
class EstimatorParameters:
    """Settings of GapEstimator, validated where they are built; SI units."""

    interval: Literal["worst_case", "paper"] = field(
        default="worst_case",
        metadata={
            "description": "error model of gap_min, gap_max and snr: worst_case is the safety interval, "
            "paper the published one",
            "choices": ("worst_case", "paper"),
        },
    )
    apex: Literal["first", "second", "best"] = field(
        default="best",
        metadata={
            "description": "view whose rays carry the error clouds; best: the higher signal-to-noise ratio",
            "choices": ("first", "second", "best"),
        },
    )
    tracker_bound: float = field(
        default=3.0,
        metadata={
            "description": "bound of the tracked errors as a multiple of their RMS [-]; the paper takes 1",
            "range": (1.0, 10.0),
        },
    )
    confidence_level: float = field(
        default=0.95,
        metadata={
            "description": "share of cases the confidence interval holds the truth in [-]",
            "range": (0.5, 0.999),
        },
    )
    common_share: float = field(
        default=0.5,
        metadata={
            "description": "share of the bearings' variance that is common to all views of a track [-]",
            "range": (0.0, 1.0),
        },
    )
    scale_drift: float = field(
        default=0.002,
        metadata={
            "description": "standard deviation of a point's scale drift: the fraction of its parallax by "
            "which tracking over- or undershoots, constant over a track, beyond the covariances [-]",
            "range": (0.0, 0.1),
        },
    )
    correlated_error_share: float = field(
        default=1.0,
        metadata={
            "description": "share of the bearings' variance along the parallax that lasts over a track: at 1 "
            "a depth is known no better than from the best single views, however many there are; "
            "in addition to common_share [-]",
            "range": (0.0, 1.0),
        },
    )
    max_pose_age: float = field(
        default=0.025,
        metadata={
            "description": "how far from the image's stamp the lens poses on either side may lie [s]",
            "range": (0.001, 1.0),
        },
    )
    max_pose_wait: float = field(
        default=0.02,
        metadata={
            "description": "how long an image waits for the lens pose after it, while poses come, before "
            "tracking is lost [s]",
            "range": (0.0, 1.0),
        },
    )
    max_edges_silence: float = field(
        default=0.03,
        metadata={
            "description": "time beyond the usual interval between images after which NO_EDGES is "
            "published [s]",
            "range": (0.01, 10.0),
        },
    )

    max_delay: float = field(
        default=0.5,
        metadata={
            "description": "largest delay of an image relative to the lens poses, by its stamp, with which "
            "an estimate can be VALID [s]",
            "range": (0.05, 10.0),
        },
    )
    largest_gap: float = field(
        default=0.03,
        metadata={
            "description": "gap above which an estimate is taken for a mistake: no joint opens so far [m]",
            "range": (0.001, 1.0),
        },
    )
    longest_unseen_edges: float = field(
        default=0.7,
        metadata={
            "description": "how long the edges of the opening are carried on, with growing errors, while no "
            "image shows them beside the points [s]",
            "range": (0.0, 10.0),
        },
    )
    least_baseline: float = field(
        default=0.5e-3,
        metadata={
            "description": "baseline that a gap needs to be valid [m]",
            "range": (0.0, 0.1),
        },
    )
    least_baseline_share: float = field(
        default=0.1,
        metadata={
            "description": "the same as a share of the distance of the farther point: 1 mm at 10 mm [-]",
            "range": (0.0, 1.0),
        },
    )
    max_clock_offset: float = field(
        default=10.0,
        metadata={
            "description": "how far an image's stamp may be from this node's clock; beyond it an image is "
            "out of sync, unless it is more than a day old and so of a recording [s]",
            "range": (0.1, 1e6),
        },
    )
    tracker_drift: float = field(
        default=0.05e-3,
        metadata={
            "description": "RMS rate at which the tracked body creeps on the scope, at the lens: markers "
            "on a clamp that its cable pulls, three millimetres a minute [m/s]",
            "range": (0.0, 0.01),
        },
    )
    unproven_drift: float = field(
        default=0.4e-3,
        metadata={
            "description": "the same, per axis, until a track has shown that the body does not creep: a "
            "loose clamp slips a millimetre a second; 0 takes tracker_drift from the start [m/s]",
            "range": (0.0, 0.01),
        },
    )
    tracker_angular_drift: float = field(
        default=1e-4,
        metadata={
            "description": "RMS rate at which the tracked body turns on the scope: a third of a degree a "
            "minute [rad/s]",
            "range": (0.0, 0.1),
        },
    )
    tracker_scale: float = field(
        default=0.01,
        metadata={
            "description": "relative standard error of the tracker's scale: of a calibration wand that was "
            "not measured again; images cannot show it [-]",
            "range": (0.0, 0.2),
        },
    )
    clock_error: float = field(
        default=0.035,
        metadata={
            "description": "standard error of the offset between the clocks of images and tracker if it was "
            "not calibrated: drivers stamp pictures up to a tenth of a second after exposure [s]",
            "range": (0.0, 1.0),
        },
    )
    lens_position_error: float = field(
        default=2e-3,
        metadata={
            "description": "RMS error of the lens's position on the body if it was not calibrated [m]",
            "range": (0.0, 0.1),
        },
    )
    lens_rotation_error: float = field(
        default=0.01,
        metadata={
            "description": "RMS error of the lens's rotation on the body if it was not calibrated [rad]",
            "range": (0.0, 1.0),
        },
    )
    camera_error: float = field(
        default=0.02,
        metadata={
            "description": "relative standard error of the focal length if the camera was not calibrated [-]",
            "range": (0.0, 0.5),
        },
    )
    leg_motion: float = field(
        default=0.0,
        metadata={
            "description": "how far, at the lens, the body of leg_body/pose may move within a track before "
            "it ends with JOINT_MOVED; 0 listens to no such body [m]",
            "range": (0.0, 0.01),
        },
    )

    def __post_init__(self) -> None:
        """Refuse what the metadata does not allow, in code as on the command line."""
        if rule := broken_rule(self):
            raise MeasurementError(rule)
