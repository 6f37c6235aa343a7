"""The model fitted to landmarks in images: one image, several views of one moment, or a sequence."""
