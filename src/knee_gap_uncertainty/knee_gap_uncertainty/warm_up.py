"""Everything compiled that a live estimate runs, compiled or loaded from disk before the first image."""

from knee_gap_uncertainty import gap_range, joint_motion, multi_view


def warm_up() -> None:
    """Compile what is not on disk yet, and load the rest."""
    gap_range.warm_up()
    multi_view.warm_up()
    joint_motion.warm_up()


if __name__ == "__main__":
    warm_up()
