"""Training: networks, rollouts, the algorithms, checkpoints, `lagnet-train` and `lagnet-export`."""
