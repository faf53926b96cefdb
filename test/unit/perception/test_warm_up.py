"""After warming up nothing is compiled any more."""

from knee_gap_core.values.edges import EdgeStatus
from knee_gap_perception.edge_tracking.warm_up import warm_up
from knee_gap_perception.point_tracking import patch_fit


def test_warm_up_follows_a_gap_and_so_compiles_the_kernel() -> None:
    assert warm_up() is EdgeStatus.VALID
    compiled = list(patch_fit.fit_patch.signatures)  # type: ignore[attr-defined]
    assert compiled
    warm_up()
    assert list(patch_fit.fit_patch.signatures) == compiled  # type: ignore[attr-defined]
