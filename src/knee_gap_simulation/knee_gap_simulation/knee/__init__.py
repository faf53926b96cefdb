"""A knee of known gap: scene, camera, difficulty, ground truth."""
