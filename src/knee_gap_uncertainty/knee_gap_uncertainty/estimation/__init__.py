"""The estimate of each image: its track, the rules of refusal, the estimator, and the core of the node."""
