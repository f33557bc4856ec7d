"""The bake of the embedded capture: choreography, cloth, wardrobe, rendering, packing."""
