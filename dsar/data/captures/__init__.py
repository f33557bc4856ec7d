"""Captures: one reader per format, all of which present a `MultiViewCapture`."""
