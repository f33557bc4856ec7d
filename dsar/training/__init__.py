"""Training: stages, losses, the loop, checkpoints and workers."""
