"""Depths, normals and confidences from photographs: rectified pairs, then a search around a fitted head."""
