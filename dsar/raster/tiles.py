"""How memory is laid out, for all kernels: the records of splats, and how the image is cut up.

The image consists of tiles, which have lists of splats, and these of blocks, which fill a register. A block
is 4 pixels wide and as tall as LANES allows. Bit `column * STRIPS + strip` of a set of blocks stands for the
block in that column and strip (row of blocks) of the tile.
"""

from dsar.raster.simd import LANES

RECORD_SIZE = 16
"""Numbers in a splat's record (see kernels_projection): a cache line."""
SUMS_SIZE = 10
"""Numbers in the gradient sums of a splat, or of its pair with a tile (see kernels_compositing)."""
PREFETCH_DISTANCE = 8
"""How many splats before its turn a record is fetched (in order of depth they lie all over the memory): as
long as a trip to the third cache takes."""
TILE_BITS = 4
TILE = 1 << TILE_BITS
"""Pixels along a tile's side."""
BLOCK_WIDTH = 4
BLOCK_HEIGHT = LANES // BLOCK_WIDTH
COLUMNS = TILE // BLOCK_WIDTH
STRIPS = TILE // BLOCK_HEIGHT
BLOCKS = COLUMNS * STRIPS
