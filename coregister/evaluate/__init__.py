"""Measure models on held-out subjects: generalization, specificity, compactness, confidence intervals."""
