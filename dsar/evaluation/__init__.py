"""Honest figures from held-out frames."""
