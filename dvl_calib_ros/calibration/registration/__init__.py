"""Clock offsets, rotation, lever arm and scale of the three instruments, from their data alone."""
