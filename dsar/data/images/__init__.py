"""Image files: decoded, checked and brought to sRGB with a mask of 8 bits."""
