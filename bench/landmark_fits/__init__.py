"""The experiments of `bench.landmark_fit`, one module each, and the synthetic pictures they share."""
