"""The cranium where hair, a cap or missing cameras hide it, from the face and an auxiliary model of whole heads."""
