"""SMPL-X-format bodies: the embedded CC0 one or a licensed file, and linear blend skinning."""
