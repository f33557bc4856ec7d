"""Rotations, cameras and spherical harmonics: formulas without state."""
