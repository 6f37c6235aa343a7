"""Mathematics of meshes and point sets, without knowledge of heads."""
