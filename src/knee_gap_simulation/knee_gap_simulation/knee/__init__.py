"""The simulated knee of known gap: scene, camera, difficulty, ground truth."""
