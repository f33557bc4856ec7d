"""Captures and motions: one reader per format behind `dsar.types.Capture` and `dsar.types.Motion`."""
