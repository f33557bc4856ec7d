"""The motion prior: a coarse simulation of a loose garment, driven by the motion alone (extension)."""
