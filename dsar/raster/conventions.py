"""The constants that decide which Gaussian reaches which pixel: those of gsplat 1.5.3.

Every backend uses exactly these, so that an image does not depend on the machine that made it.
"""

EPS_2D = 0.3
"""Added to both diagonal entries of the image-plane covariance, pixels²: no splat is thinner than a pixel.
Callers may choose another (`rasterize(dilation=)`)."""
ALPHA_MAX = 0.999
"""A single Gaussian never hides what is behind it completely."""
ALPHA_MIN = 1 / 255
"""Fragments fainter than one 8-bit step are skipped."""
TRANSMITTANCE_MIN = 1e-4
"""The fragment that would bring a pixel's transmittance to this or below ends the pixel and is left out."""
NEAR = 0.01
"""Gaussians whose centre is nearer than this (camera z, metres) are not drawn."""
FRUSTUM_MARGIN = 0.3
"""How far outside the image the projection is linearised at most, as a share of the image's half-size."""
