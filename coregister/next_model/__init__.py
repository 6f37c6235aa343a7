"""Build a model from registrations and the previous model."""
