"""Interactive pages: the stabilization review, and a fit in 3D."""
