"""Loss functions: image, landmark, regularization, self-intersection, SSIM in uv space."""
