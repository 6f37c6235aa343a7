"""Make captures from scans without photographs: virtual cameras that render them."""
