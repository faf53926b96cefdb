"""Camera models: projection, intrinsics, errors of bearings, agreement of two models."""
