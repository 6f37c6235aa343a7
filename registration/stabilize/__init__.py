"""Remove the head's rigid motion from a subject's expressions."""
