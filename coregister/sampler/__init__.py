"""The semantic sampler: coefficients drawn by named categories [GNM, Semantically Sampling GNM]."""
