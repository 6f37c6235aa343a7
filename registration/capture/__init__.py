"""Read and write captures."""
