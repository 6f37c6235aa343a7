"""What the losses compare a rendering with: lists of pixels at several resolutions."""
