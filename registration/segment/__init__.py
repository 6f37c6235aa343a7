"""Masks and labels without a face parser: from landmarks, depths, the fitted model and the image itself."""
