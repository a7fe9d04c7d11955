"""How three instruments stand to each other: clocks, rotation, lever arm and scale, from their data alone."""
