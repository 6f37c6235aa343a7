"""Makes what a capture lacks for a registration: landmarks, masks, labels, depths and normals."""
