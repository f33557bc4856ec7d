"""The bake of the embedded captures: choreography, cloth, wardrobe, rendering, packing."""
