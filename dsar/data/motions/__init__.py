"""Motion files, brought to SMPL-X in a world with Y up, and what is known of a motion."""
